"""The recipe of labelled pictures: from states to a folder of Parquet files.

Walks start from states of an archive or a state file and yield frames (`walks`), in waves until
every quota is full. Frames are chosen one by one (`selection`), and chosen configurations are
measured and drawn, one file of the table at a time (`datasets.image_rows`). Walks and table files
depend only on the configuration, the states and their numbers, and are separate files in the
staging folder, so a resumed run continues from the existing files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import as_json
from knotgym.common.streams import Stream, generator
from knotgym.datasets.image_folder import finish
from knotgym.datasets.image_rows import Row, TableFile, write_table_file
from knotgym.datasets.image_table import arrow, shard_name
from knotgym.generate.images.images_config import (
    ImagesConfig,
    InvalidImagesConfig,
    held_out,
    quotas,
)
from knotgym.generate.images.seed_states import SeedStates, seed_states
from knotgym.generate.images.selection import Chooser, ChosenFrame
from knotgym.generate.images.unit_files import UnitFile, load_frames, walked
from knotgym.generate.images.walks import WALKS, Frames, Unit, Walk
from knotgym.runs.engine import Batch, run
from knotgym.runs.progress import Progress, Status, tell_if_long
from knotgym.runs.run_options import NotEnough, RunOptions
from knotgym.states.splits import IMAGE_SPLITS
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import codes_of

CORE_SECONDS = 0.13  # per picture: 20,000 took 22 minutes on two cores


def make_images(
    config: ImagesConfig,
    out: Path,
    options: RunOptions,
    *,
    archive: Path | None = None,
    states: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Make labelled pictures and return the new folder, which for a shard is the shard's own.

    Args:
        config: which pictures to make.
        out: the folder of the whole run.
        options: how to execute the run.
        archive: archive of a run whose states walks start from.
        states: state file to start from instead; by default the included states.
        progress: where to show progress; a new display by default.

    Raises:
        Occupied, InvalidRun: as in `runs.engine.run`.
        InvalidImagesConfig, NoSeedStates: such pictures can't be made.
        NotEnough: walks from the states don't reach enough different configurations.
    """
    arrow()
    recipe = ImageRecipe(config, options, seed_states(config.nx, archive, states, config.engine))
    if progress is not None:
        wanted = sum(recipe.wanted.values())
        tell_if_long(progress, CORE_SECONDS * wanted, options.workers)
    return run(recipe, options.shard.folder(out), options, progress)


class ImageRecipe:
    """Recipe for labelled pictures, see `runs.engine.Recipe`."""

    flexible: tuple[str, ...] = ()

    def __init__(self, config: ImagesConfig, options: RunOptions, start: SeedStates) -> None:
        self.config, self.shard, self.start = config, options.shard, start
        codes = {
            nx: sorted({code for knot in start.knots for code in codes_of(knot, nx)}, key=_visits)
            for nx in config.nx
        }
        for nx in config.nx:
            if not codes[nx]:
                raise InvalidImagesConfig(
                    f"no diagram of {' or '.join(start.knots)} has {nx} crossings"
                )
        quota = quotas(config, {nx: len(codes[nx]) for nx in codes})
        shares = {key: self.shard.share(count) for key, count in quota.items()}
        self.wanted = {key: len(share) for key, share in shares.items() if share}
        if not self.wanted:
            raise InvalidImagesConfig(
                f"shard {self.shard} has no picture to make: split the run into fewer shards"
            )
        self.split = splits_of(config, start, set(quota))
        self.chooser = Chooser(
            self.wanted,
            held_out(config, codes),
            start.points.shape[1],
            config.selection,
            config.walk.limits,
        )
        self.walked: list[Frames] = []
        self.frames = 0
        self.table = Path()
        self.written: list[Path] = []

    def request(self) -> dict[str, Any]:
        return {"config": as_json(self.config), "source": self.start.source}

    def begin(self) -> None:
        pass

    def load(self, folder: Path) -> bool:
        return False  # finished walks and table files are detected one by one

    def save(self, folder: Path) -> None:
        pass

    def batches(self, folder: Path) -> Iterator[Batch]:
        yield from self._choose(folder / "units")
        self.table = folder / "table"
        files = self._table_files()

        def absorb(file: TableFile, path: Path) -> None:
            self.written.append(path)

        yield Batch(write_table_file, files, absorb, "drawing")

    def _choose(self, folder: Path) -> Iterator[Batch]:
        """Make waves of walks and choose among their frames until every quota is full."""
        gave = dict.fromkeys(self.wanted, _Stretch(0, 0))
        wave, idle, first = self.shard.first, 0, self.shard.first
        while lacking := self.chooser.lacking():
            number = first + sum(len(frames.numbers) for frames in self.walked)
            walks, quota_of = _wave(
                self.config, self.start, self.split, lacking, gave, wave, number
            )
            chosen = len(self.chooser.chosen)

            def absorb(
                unit: UnitFile, path: Path, quota_of: dict[int, tuple[str, int]] = quota_of
            ) -> None:
                self._consider(load_frames(path), quota_of, gave)

            units = self._units(walks, quota_of, folder)
            yield Batch(walked, units, absorb, "walking and choosing")
            idle = 0 if len(self.chooser.chosen) > chosen else idle + 1
            wave += 1
            if idle == self.config.idle:
                lacks = ", ".join(
                    f"{count} of {key[0]} with nx {key[1]}"
                    for key, count in sorted(self.chooser.lacking().items())
                )
                raise NotEnough(
                    f"{chosen} of {sum(self.wanted.values())} pictures found, then none in {idle}"
                    f" waves of walks; missing {lacks}"
                )

    def _units(
        self, walks: list[Walk], quota_of: dict[int, tuple[str, int]], folder: Path
    ) -> list[UnitFile]:
        units: list[UnitFile] = []
        for steps, group in _by_steps(self.config, walks, quota_of):
            for begin in range(0, len(group), WALKS):
                some = tuple(group[begin : begin + WALKS])
                unit = Unit(
                    some,
                    self.start.states[[walk.base for walk in some]],
                    self.config.seed,
                    steps,
                    self.config.stride,
                    max(self.config.nx),
                    self.config.engine,
                    self.config.walk,
                )
                path = folder / f"{len(self.walked) + len(units):06d}.npz"
                units.append(UnitFile(path, unit))
        return units

    def _consider(
        self,
        frames: Frames,
        quota_of: dict[int, tuple[str, int]],
        gave: dict[tuple[str, int], _Stretch],
    ) -> None:
        """Offer the frames of a unit to the chooser, one by one."""
        self.walked.append(frames)
        for points, number, ease in zip(
            frames.points, frames.walk.tolist(), frames.ease.tolist(), strict=True
        ):
            quota = quota_of[number]
            rng = generator(Stream.IMAGE_CHOICE, self.config.seed, self.shard.first + self.frames)
            if self.chooser.consider(points, quota[0], ease, self.frames, rng):
                gave[quota] = gave[quota]._replace(chosen=gave[quota].chosen + 1)
            self.frames += 1

    def _table_files(self) -> list[TableFile]:
        """Return the files of the table; each split's rows are in random order."""
        config, rows = self.config, _Provenance(self.start, self.walked, self.config.seed)
        files: list[TableFile] = []
        number = self.shard.first
        for place, split in enumerate(IMAGE_SPLITS):
            chosen = [choice for choice in self.chooser.chosen if choice.split == split]
            order = generator(Stream.IMAGE_ORDER, config.seed, place).permutation(len(chosen))
            count = -(-len(chosen) // config.rows_per_file)
            for index in range(count):
                picked = order[index * config.rows_per_file : (index + 1) * config.rows_per_file]
                here = tuple(rows.row(chosen[k], number + at) for at, k in enumerate(picked))
                number += len(here)
                name = shard_name(split, index, count)
                seal = self.table.with_name("seals") / name
                files.append(TableFile(self.table / name, seal, here, config.appearance))
        return files

    def status(self) -> Status:
        facts = {
            "frames met": f"{self.frames}",
            "units of walks": f"{len(self.walked)}",
            "files written": f"{len(self.written)}",
        }
        total = sum(self.wanted.values())
        return Status(len(self.chooser.chosen), total, "configurations chosen", facts)

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        dropped: Counter[str] = Counter()
        for frames in self.walked:
            dropped.update(frames.dropped)
        report = {
            "walks": sum(len(frames.numbers) for frames in self.walked),
            "frames": sum(len(frames.walk) for frames in self.walked),
            "dropped": dict(sorted(dropped.items())),
            "refused": dict(sorted(self.chooser.refused.items())),
        }
        finish(self.table, self.written, request, report, self.start.states, self.walked)
        return self.table

    def summary(self) -> str:
        return f"{len(self.chooser.chosen)} pictures"


class _Stretch(NamedTuple):
    """Walks made for a split and nx, and the frames chosen from them so far."""

    walks: int
    chosen: int


class _Provenance:
    """Makes table rows of chosen frames, with their provenance as `source`."""

    def __init__(self, start: SeedStates, walked: list[Frames], seed: int) -> None:
        self._start, self._seed = start, seed
        self._walk = np.concatenate([frames.walk for frames in walked]).tolist()
        self._steps = np.concatenate([frames.steps for frames in walked]).tolist()
        self._rounds = np.concatenate([frames.rounds for frames in walked]).tolist()
        self._base_of = {
            number: base
            for frames in walked
            for number, base in zip(frames.numbers.tolist(), frames.bases.tolist(), strict=True)
        }

    def row(self, choice: ChosenFrame, number: int) -> Row:
        """Return row `number` of the table; a walk from a plain loop is a family of its own."""
        start, walk = self._start, self._walk[choice.frame]
        base = self._base_of[walk]
        alone = int(start.family.max()) + 1 + walk
        source = {
            "walk": walk,
            "pulls": self._steps[choice.frame],
            "rounds": self._rounds[choice.frame],
            "reflect": choice.symmetry.reflect,
            "switch": choice.symmetry.switch,
            "reverse": choice.symmetry.reverse,
            "base_shift": choice.symmetry.base_shift,
            "family": int(start.family[base]) if start.nx[base] else alone,
            "seed": self._seed,
            "row": number,
        }
        return Row(choice.points, choice.code, choice.split, source)


def splits_of(
    config: ImagesConfig, start: SeedStates, wanted: set[tuple[str, int]]
) -> NDArray[np.str_]:
    """Return the split of each seed state's family, str (n,).

    It is "" for states without crossings, whose walks are families of their own.
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
            # the first family is for training, the next ones for test and test-code
            test = round(config.test_share * len(same)) or int(config.test_share > 0)
            new = round(config.code_share * len(same)) or 1 if ("test-code", nx) in wanted else 0
            if nx > max(config.trained):
                split = "test-nx"
            elif 0 < place <= test:
                split = "test"
            else:
                split = "test-code" if test < place <= test + new else "train"
            out[start.family == family] = split
    out[start.nx == 0] = ""
    return out


def _by_steps(
    config: ImagesConfig, walks: list[Walk], quota_of: dict[int, tuple[str, int]]
) -> list[tuple[int, list[Walk]]]:
    """Group walks by their number of steps."""
    groups: dict[int, list[Walk]] = {}
    for walk in walks:
        nx = quota_of[walk.number][1]
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
    """Return the walks of a wave and the quota of each; update `gave`.

    A walk for nx crossings starts from a class of codes with nx crossings in its split, drawn
    uniformly; if there is none, from the nearest nx that has one.
    """
    # Request 10 % more walks than the yield so far suggests, smoothed by 1 walk and 4 frames.
    rng = generator(Stream.IMAGE_WAVE, config.seed, wave)
    wanted = {
        key: int(np.ceil(1.1 * count * (gave[key].walks + 1) / (gave[key].chosen + 4)))
        for key, count in lacking.items()
    }
    most = config.wave * WALKS
    if sum(wanted.values()) > most:
        total = sum(wanted.values())
        wanted = {key: max(1, count * most // total) for key, count in wanted.items()}
    walks: list[Walk] = []
    quota_of: dict[int, tuple[str, int]] = {}
    for key, count in wanted.items():
        own = np.flatnonzero((start.nx == 0) if key[1] == 0 else (split == key[0]))
        if not len(own):
            own = np.flatnonzero((split == key[0]) if key[1] == 0 else (start.nx == 0))
        if not len(own):
            raise NotEnough(
                f"no family of states is left for {key[0]} with nx {key[1]}; start from more states"
            )
        away = np.abs(start.nx[own] - key[1])
        own = own[away == away.min()]
        kinds = np.unique(start.kind[own])
        for kind in kinds[rng.integers(len(kinds), size=count)]:
            same = own[start.kind[own] == kind]
            number = first + len(walks)
            walks.append(Walk(number, int(same[rng.integers(len(same))])))
            quota_of[number] = key
        gave[key] = gave[key]._replace(walks=gave[key].walks + count)
    return walks, quota_of


def _visits(code: GaussCode) -> tuple[int, ...]:
    return code.visits
