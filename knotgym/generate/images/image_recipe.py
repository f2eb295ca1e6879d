"""`knotgym images`: perception tables, from states to a folder of Parquet shards.

Walks set out from archived or curated states and meet frames (`stir`), in waves until every quota
is full; frames are chosen one by one (`balance`); chosen configurations are measured and drawn
shard by shard (`image_shards`). Walks and shards are functions of the configuration, the states and
their numbers alone and are files of their own, so any workers give the same bytes and a run that
was killed goes on from the files there are.
"""

from __future__ import annotations

import json
import shutil
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from knotgym.atomic_files import atomic_write
from knotgym.datasets.image_folder import finish
from knotgym.datasets.image_rows import Row, TableFile, write_table_file
from knotgym.datasets.image_table import arrow, shard_name
from knotgym.datasets.splits import IMAGE_SPLITS
from knotgym.errors import KnotgymError
from knotgym.generate.images.seed_states import SeedStates, seed_states
from knotgym.generate.images.selection import Chooser
from knotgym.generate.images.walks import WALKS, Frames, Unit, Walk, stir
from knotgym.generate.states.curation import codes_of
from knotgym.generate.states.curation_run import MOST_NX, NotEnough
from knotgym.rendering.appearance import AppearanceConfig
from knotgym.runs.executors import Pool, engine
from knotgym.runs.shards import Shard
from knotgym.runs.staging import Occupied, staging
from knotgym.streams import Stream, generator
from knotgym.topology.gauss import GaussCode

WAVE = 32  # units in a wave at most
IDLE = 6  # waves without one more picture after which nothing more is expected


class InvalidImagesJob(KnotgymError, ValueError):
    """Pictures that can't be made as asked."""


@dataclass(frozen=True, kw_only=True)
class ImagesConfig:
    """What pictures are wanted.

    Attributes:
        nx: crossing numbers, as many pictures of each.
        count: pictures in all.
        test_nx: those of nx that only split "test-nx" shows, larger than all others; None for the
            largest if there are several.
        test_share: of the other pictures, share of split "test".
        code_share: likewise of split "test-code", and share of the codes that only it shows; nx
            with fewer than 4 codes have none.
        seed: of everything.
        steps: that a walk makes at most; one for nx crossings makes a third of them at nx 3 and
            above, two thirds below, all at 0, for the more crossings there are the sooner they are
            lost.
        stride: steps from one frame to the next.
        rows_per_file: pictures in a file of the table.
        appearance: what varies between pictures.
        part: of the run, which makes its share of each quota; splits and codes held out are those
            of the run.
    """

    nx: tuple[int, ...] = (0, 1, 2, 3, 4)
    count: int = 20_000
    test_nx: tuple[int, ...] | None = None
    test_share: float = 0.15
    code_share: float = 0.15
    seed: int = 0
    steps: int = 12
    stride: int = 2
    rows_per_file: int = 500
    appearance: AppearanceConfig = AppearanceConfig()
    shard: Shard = Shard()

    def __post_init__(self) -> None:
        if (
            not self.nx
            or any(not 0 <= nx <= MOST_NX for nx in self.nx)
            or len(set(self.nx)) != len(self.nx)
        ):
            raise InvalidImagesJob(
                f"nx takes different numbers of crossings from 0 to {MOST_NX}, got"
                f" {', '.join(map(str, self.nx)) or 'none'}"
            )
        if self.test_nx is None:
            object.__setattr__(self, "test_nx", (max(self.nx),) if len(self.nx) > 1 else ())
        rest = self.trained
        if (
            not set(self.held_nx) <= set(self.nx)
            or not rest
            or min(self.held_nx, default=MOST_NX + 1) <= max(rest)
        ):
            raise InvalidImagesJob(
                f"test-nx takes the largest of the nx asked for, {sorted(self.nx)}, and not all of"
                f" them; got {sorted(self.held_nx)}"
            )
        for name in ("count", "steps", "stride", "rows_per_file"):
            if getattr(self, name) < 1:
                raise InvalidImagesJob(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.stride > self.steps:
            raise InvalidImagesJob(f"stride must be at most steps, {self.steps}, got {self.stride}")
        if not (
            0 <= self.test_share and 0 <= self.code_share and self.test_share + self.code_share < 1
        ):
            raise InvalidImagesJob(
                "test and code shares must be at least 0 and below 1 together, got"
                f" {self.test_share} and {self.code_share}"
            )
        if self.seed < 0:
            raise InvalidImagesJob(f"seed must be at least 0, got {self.seed}")

    @property
    def held_nx(self) -> tuple[int, ...]:
        """The crossing numbers of split "test-nx"."""
        return self.test_nx or ()

    @property
    def trained(self) -> tuple[int, ...]:
        """The others."""
        return tuple(nx for nx in self.nx if nx not in self.held_nx)


class _Stretch(NamedTuple):
    """Walks wanted for a split and nx, and what they gave so far."""

    walks: int
    chosen: int


def make(
    config: ImagesConfig,
    out: Path,
    *,
    archive: Path | None,
    states: Path | None,
    workers: int,
    resume: bool,
    quiet: bool,
    console: Console,
    scheduler: str = "",
) -> None:
    """Make the new folder `out`; until it is finished everything stands in `.NAME.partial` beside
    it.

    Raises:
        InvalidImagesJob, NoSeedStates: can't be made as asked.
        Occupied: something is in the way, or another run is at it.
        NotEnough: the states and their walks don't give so many different pictures.
    """
    if workers < 0:
        raise InvalidImagesJob(f"workers must be at least 0, got {workers}")
    arrow()
    began = time.perf_counter()
    start = seed_states(config.nx, archive, states)
    asked = json.loads(json.dumps({"config": asdict(config), "source": start.source}))
    if out.exists():
        if resume and _asked(out / "manifest.json") == asked:
            if not quiet:
                console.print(f"{out} is finished already", soft_wrap=True)
            return
        raise Occupied(f"{out} is there already; choose another --out, or remove it")
    with staging(out, resume) as partial:
        if (partial / "job.json").is_file() and _asked(partial / "job.json") != asked:
            raise InvalidImagesJob(
                f"{partial} holds another job than the one asked for; give the same options again,"
                " or start without --resume"
            )
        with atomic_write(partial / "job.json") as temporary:
            temporary.write_text(json.dumps(asked))
        tell = _Teller(console, quiet)
        with engine(workers, scheduler) as pool:
            chooser, walks, dropped = _choose(config, start, partial, pool, tell)
            written = _draw(config, start, chooser, walks, partial / out.name, pool, tell)
        report = {
            "walks": sum(len(one.numbers) for one in walks),
            "frames": sum(len(one.walk) for one in walks),
        }
        counts = {
            "dropped": dict(sorted(dropped.items())),
            "refused": dict(sorted(chooser.refused.items())),
        }
        finish(partial / out.name, written, asked, {**report, **counts}, start.states, walks)
        (partial / out.name).rename(out)
        shutil.rmtree(partial)
    tell(f"{out}: {len(chooser.chosen)} pictures in {time.perf_counter() - began:.0f} s", now=True)


def quotas(config: ImagesConfig, codes: dict[int, int]) -> dict[tuple[str, int], int]:
    """(split, nx) -> pictures; `codes` says how many codes each nx has."""
    out: dict[tuple[str, int], int] = {}
    for place, nx in enumerate(config.nx):
        here = config.count // len(config.nx) + (place < config.count % len(config.nx))
        if nx in config.held_nx:
            out["test-nx", nx] = here
            continue
        new = round(config.code_share * here) if codes[nx] >= 4 else 0
        test = round(config.test_share * here)
        out.update({("train", nx): here - test - new, ("test", nx): test, ("test-code", nx): new})
    return {key: wanted for key, wanted in out.items() if wanted}


def held_out(config: ImagesConfig, codes: dict[int, list[GaussCode]]) -> frozenset[GaussCode]:
    """The codes, without chirality, that only split "test-code" shows."""
    out: list[GaussCode] = []
    for nx in config.trained:
        if len(codes[nx]) >= 4 and config.code_share > 0:
            order = generator(Stream.IMAGE_CODES, config.seed, nx).permutation(len(codes[nx]))
            out += [
                codes[nx][k] for k in order[: max(1, round(config.code_share * len(codes[nx])))]
            ]
    return frozenset(out)


def splits_of(
    config: ImagesConfig, start: SeedStates, wanted: set[tuple[str, int]]
) -> NDArray[np.str_]:
    """The split of each base, str (n,): that of its family; "" for one without crossings, whose
    walks are families of their own.
    """
    out = np.full(len(start), "", dtype="<U9")
    largest = {
        family: int(start.nx[start.family == family].max()) for family in set(start.family.tolist())
    }
    for nx in sorted(set(largest.values())):
        same = sorted(family for family, most in largest.items() if most == nx)
        same = [
            same[k]
            for k in generator(Stream.IMAGE_FAMILIES, config.seed, nx).permutation(len(same))
        ]
        for place, family in enumerate(same):
            if nx > max(config.trained):
                split = "test-nx"
            # one family in so many to each of the two, by turns, and the first of all to training
            else:
                test = round(config.test_share * len(same)) or int(config.test_share > 0)
                new = (
                    (round(config.code_share * len(same)) or 1)
                    if ("test-code", nx) in wanted
                    else 0
                )
                split = (
                    "test"
                    if 0 < place <= test
                    else "test-code"
                    if test < place <= test + new
                    else "train"
                )
            out[start.family == family] = split
    out[start.nx == 0] = ""
    return out


def _choose(
    config: ImagesConfig, start: SeedStates, partial: Path, pool: Pool, tell: _Teller
) -> tuple[Chooser, list[Frames], Counter[str]]:
    """Make waves of walks and choose among their frames until every quota is full."""
    codes = {
        nx: sorted(
            {code for knot in start.knots for code in codes_of(knot, nx)},
            key=lambda code: code.visits,
        )
        for nx in config.nx
    }
    for nx in config.nx:
        if not codes[nx]:
            raise InvalidImagesJob(f"no diagram of {' or '.join(start.knots)} has {nx} crossings")
    quota = quotas(config, {nx: len(codes[nx]) for nx in codes})
    mine = {key: len(share) for key, count in quota.items() if (share := config.shard.share(count))}
    if not mine:
        raise InvalidImagesJob(
            f"shard {config.shard} has no picture to make: cut the run into fewer shards"
        )
    chooser = Chooser(mine, held_out(config, codes), start.points.shape[1])
    split = splits_of(config, start, set(quota))
    done: list[Frames] = []
    dropped: Counter[str] = Counter()
    gave = dict.fromkeys(mine, _Stretch(0, 0))
    first, wave, idle, frame = config.shard.first, 0, 0, 0
    while lacking := chooser.lacking():
        walks, aims = _wave(
            config,
            start,
            split,
            lacking,
            gave,
            first + wave,
            first + sum(len(one.numbers) for one in done),
        )
        units: list[_UnitFile] = []
        for steps, group in _by_steps(config, walks, aims):
            for begin in range(0, len(group), WALKS):
                some = tuple(group[begin : begin + WALKS])
                unit = Unit(
                    some,
                    start.states[[walk.base for walk in some]],
                    config.seed,
                    steps,
                    config.stride,
                    max(config.nx),
                )
                units.append(
                    _UnitFile(partial / "units" / f"{len(done) + len(units):06d}.npz", unit)
                )
        chosen = len(chooser.chosen)
        for path in pool.map(_stirred, units):
            frames = _load(path)
            done.append(frames)
            dropped.update(frames.dropped)
            for points, number, ease in zip(
                frames.points, frames.walk.tolist(), frames.ease.tolist(), strict=True
            ):
                aim = aims[number]
                rng = generator(Stream.IMAGE_CHOICE, config.seed, first + frame)
                if chooser.consider(points, aim[0], ease, frame, rng):
                    gave[aim] = gave[aim]._replace(chosen=gave[aim].chosen + 1)
                frame += 1
            tell(
                f"{len(chooser.chosen)} of {sum(mine.values())} configurations chosen from {frame}"
                f" frames, {len(done)} units of walks"
            )
        idle = 0 if len(chooser.chosen) > chosen else idle + 1
        wave += 1
        if idle == IDLE:
            lacks = ", ".join(
                f"{count} of {key[0]} with nx {key[1]}"
                for key, count in sorted(chooser.lacking().items())
            )
            raise NotEnough(
                f"{len(chooser.chosen)} of {sum(mine.values())} pictures found, then no more in"
                f" {IDLE} waves of walks; lacking {lacks}"
            )
    return chooser, done, dropped


def _by_steps(
    config: ImagesConfig, walks: list[Walk], aims: dict[int, tuple[str, int]]
) -> list[tuple[int, list[Walk]]]:
    """Walks by the steps they make."""
    groups: dict[int, list[Walk]] = {}
    for walk in walks:
        nx = aims[walk.number][1]
        steps = config.steps * (3 if nx == 0 else 2 if nx < 3 else 1) // 3
        groups.setdefault(max(config.stride, steps), []).append(walk)
    return sorted(groups.items())


def _wave(
    config: ImagesConfig,
    start: SeedStates,
    split: NDArray[np.str_],
    lacking: dict[tuple[str, int], int],
    gave: dict[tuple[str, int], _Stretch],
    wave: int,
    first: int,
) -> tuple[list[Walk], dict[int, tuple[str, int]]]:
    """The walks of a wave and what each is for; `gave` is brought up to date.

    A walk for nx crossings sets out from a class of codes with so many, evenly drawn, in its split;
    where there is none, from the nearest nx that has some.
    """
    rng = generator(Stream.IMAGE_WAVE, config.seed, wave)
    wanted = {
        key: int(np.ceil(1.1 * count * (gave[key].walks + 1) / (gave[key].chosen + 4)))
        for key, count in lacking.items()
    }
    most = WAVE * WALKS
    if sum(wanted.values()) > most:
        total = sum(wanted.values())
        wanted = {key: max(1, count * most // total) for key, count in wanted.items()}
    walks: list[Walk] = []
    aims: dict[int, tuple[str, int]] = {}
    for key, count in wanted.items():
        own = np.flatnonzero((start.nx == 0) if key[1] == 0 else (split == key[0]))
        if not len(own):
            own = np.flatnonzero((split == key[0]) if key[1] == 0 else (start.nx == 0))
        if not len(own):
            raise NotEnough(
                f"no family of states is left for {key[0]} with nx {key[1]}; set out from more"
                " states"
            )
        away = np.abs(start.nx[own] - key[1])
        own = own[away == away.min()]
        kinds = np.unique(start.kind[own])
        for kind in kinds[rng.integers(len(kinds), size=count)]:
            same = own[start.kind[own] == kind]
            number = first + len(walks)
            walks.append(Walk(number, int(same[rng.integers(len(same))])))
            aims[number] = key
        gave[key] = gave[key]._replace(walks=gave[key].walks + count)
    return walks, aims


def _draw(
    config: ImagesConfig,
    start: SeedStates,
    chooser: Chooser,
    walks: list[Frames],
    folder: Path,
    pool: Pool,
    tell: _Teller,
) -> list[Path]:
    """Write the shards: the rows of a split in random order."""
    walk = np.concatenate([one.walk for one in walks]).tolist()
    steps, rounds = (
        np.concatenate([getattr(one, name) for one in walks]).tolist()
        for name in ("steps", "rounds")
    )
    base_of = {
        number: base
        for one in walks
        for number, base in zip(one.numbers.tolist(), one.bases.tolist(), strict=True)
    }
    work: list[TableFile] = []
    number = config.shard.first
    for place, split in enumerate(IMAGE_SPLITS):
        mine = [choice for choice in chooser.chosen if choice.split == split]
        order = generator(Stream.IMAGE_ORDER, config.seed, place).permutation(len(mine))
        count = -(-len(mine) // config.rows_per_file)
        for index in range(count):
            rows = []
            for choice in (
                mine[k]
                for k in order[index * config.rows_per_file : (index + 1) * config.rows_per_file]
            ):
                base = base_of[walk[choice.frame]]
                family = (
                    int(start.family[base])
                    if start.nx[base]
                    else int(start.family.max()) + 1 + walk[choice.frame]
                )
                moved = {
                    "reflect": choice.symmetry.reflect,
                    "switch": choice.symmetry.switch,
                    "reverse": choice.symmetry.reverse,
                    "roll": choice.symmetry.base_shift,
                }
                own = {
                    "walk": walk[choice.frame],
                    "pulls": steps[choice.frame],
                    "rounds": rounds[choice.frame],
                }
                rows.append(
                    Row(
                        choice.points,
                        choice.code,
                        split,
                        {**own, **moved, "family": family, "seed": config.seed, "row": number},
                    )
                )
                number += 1
            name = shard_name(split, index, count)
            work.append(
                TableFile(
                    folder / name, folder.with_name("seals") / name, tuple(rows), config.appearance
                )
            )
    written: list[Path] = []
    for path in pool.map(write_table_file, work):
        written.append(path)
        tell(f"{len(written)} of {len(work)} shards written")
    return written


class _UnitFile(NamedTuple):
    path: Path
    unit: Unit


def _stirred(work: _UnitFile) -> Path:
    """Make a unit's walks and keep them in a file, unless it is there, unspoilt."""
    try:
        _load(work.path)  # the file has checksums
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        frames = stir(work.unit)
        with atomic_write(work.path) as temporary, open(temporary, "wb") as file:
            np.savez(file, **{**vars(frames), "dropped": np.array(json.dumps(frames.dropped))})
    return work.path


def _load(path: Path) -> Frames:
    with np.load(path) as file:
        return Frames(
            **{
                **{name: file[name] for name in file.files},
                "dropped": json.loads(str(file["dropped"])),
            }
        )


def _asked(path: Path) -> object:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return {name: found[name] for name in ("config", "source")}
    except (OSError, ValueError, KeyError):
        return None


class _Teller:
    """Prints where a run stands, now and then."""

    def __init__(self, console: Console, quiet: bool, every: float = 10.0) -> None:
        self._console, self._quiet, self._every = console, quiet, every
        self._began = self._told = time.perf_counter()

    def __call__(self, text: str, now: bool = False) -> None:
        seconds = time.perf_counter()
        if not self._quiet and (now or seconds - self._told > self._every):
            self._told = seconds
            self._console.print(
                text if now else f"{seconds - self._began:5.0f} s  {text}",
                soft_wrap=True,
                highlight=False,
            )
