"""The recipe of labelled pictures: from states to a folder of Parquet files.

Walks start from states of an archive or a state file and yield frames (`walks`), in waves until
every quota is full. WalkFrames are chosen one by one (`selection`), and chosen configurations are
measured and drawn, one file of the table at a time (`datasets.image_rows`). Walks and table files
depend only on the configuration, the states and their numbers, and are separate files in the
staging folder, so a resumed run continues from the existing files.
"""

import itertools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import as_json
from knotgym.common.errors import Failed, InvalidInput
from knotgym.common.streams import Stream, generator
from knotgym.datasets.finished_folders import finish_images, write_used_walks
from knotgym.datasets.image_rows import Row, TableFile, write_table_file
from knotgym.datasets.image_table import arrow, shard_name
from knotgym.generate.images.images_config import ImagesConfig, held_out, quotas
from knotgym.generate.images.seed_states import SeedStates, seed_states
from knotgym.generate.images.selection import Chooser, ChosenFrame
from knotgym.generate.images.unit_files import UnitFile, load_frames, walked
from knotgym.generate.images.walks import WALKS, Unit, Walk, WalkFrames
from knotgym.runs.engine import Batch, Recipe, run
from knotgym.runs.progress import Progress, Status, tell_if_long
from knotgym.runs.run_options import RunOptions
from knotgym.states.splits import IMAGE_SPLITS
from knotgym.topology.knots import codes_of

Quota = tuple[str, int]  # split and nx
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
        archive: archive of a run whose states walks start from.
        states: state file to start from instead; by default the included states.

    Raises:
        Occupied, InvalidInput: as in `runs.engine.run`.
        InvalidInput, InvalidInput: such pictures can't be made.
        Failed: walks from the states don't reach enough different configurations.
    """
    arrow()
    recipe = ImageRecipe(config, options, seed_states(config.nx, archive, states, config.engine))
    if progress is not None:
        wanted = sum(recipe.wanted.values())
        tell_if_long(progress, CORE_SECONDS * wanted, options.workers)
    return run(recipe, options.shard.folder(out), options, progress)


class ImageRecipe(Recipe):
    """Recipe for labelled pictures; finished walks and table files are detected one by one."""

    def __init__(self, config: ImagesConfig, options: RunOptions, start: SeedStates) -> None:
        self.config, self.shard, self.start = config, options.shard, start
        self.engine = config.engine
        codes = {
            nx: sorted(
                {code for knot in start.knots for code in codes_of(knot, nx)},
                key=lambda code: code.visits,
            )
            for nx in config.nx
        }
        for nx in config.nx:
            if not codes[nx]:
                raise InvalidInput(f"no diagram of {' or '.join(start.knots)} has {nx} crossings")
        quota = quotas(config, {nx: len(codes[nx]) for nx in codes})
        shares = {key: self.shard.share(count) for key, count in quota.items()}
        self.wanted = {key: len(share) for key, share in shares.items() if share}
        if not self.wanted:
            raise InvalidInput(
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
        self.walked: list[WalkFrames] = []
        # by quota: walks made, and frames chosen from them
        self.made, self.gave = Counter[Quota](), Counter[Quota]()
        self.frames = 0
        self.table = Path()
        self.written: list[Path] = []

    def request(self) -> dict[str, Any]:
        return {"config": as_json(self.config), "source": self.start.source}

    def batches(self, folder: Path) -> Iterator[Batch]:
        yield from self._choose(folder / "units")
        self.table = folder / "table"
        files = self._table_files()

        def absorb(file: TableFile, path: Path) -> None:
            self.written.append(path)

        yield Batch(write_table_file, files, absorb, "drawing")

    def _choose(self, folder: Path) -> Iterator[Batch]:
        """Make waves of walks and choose among their frames until every quota is full."""
        wave, idle = self.shard.first, 0
        while lacking := self.chooser.lacking():
            walks, quota_of = self._wave(wave, lacking)
            chosen = len(self.chooser.chosen)

            def absorb(unit: UnitFile, path: Path, quota_of: dict[int, Quota] = quota_of) -> None:
                self._consider(load_frames(path), quota_of)

            units = list(self._units(walks, quota_of, folder))
            yield Batch(walked, units, absorb, "walking and choosing")
            idle = 0 if len(self.chooser.chosen) > chosen else idle + 1
            wave += 1
            if idle == self.config.idle:
                lacks = ", ".join(
                    f"{count} of {key[0]} with nx {key[1]}"
                    for key, count in sorted(self.chooser.lacking().items())
                )
                raise Failed(
                    f"{chosen} of {sum(self.wanted.values())} pictures found, then none in {idle}"
                    f" waves of walks; missing {lacks}"
                )

    def _wave(self, wave: int, lacking: dict[Quota, int]) -> tuple[list[Walk], dict[int, Quota]]:
        """Return the walks of a wave and the quota of each.

        A walk for nx crossings starts from a class of codes with nx crossings in its split, drawn
        uniformly; if there is none, from the nearest nx that has one.
        """
        start, split = self.start, self.split
        rng = generator(Stream.IMAGE_WAVE, self.config.seed, wave)
        # Request 10 % more walks than the yield so far suggests, smoothed by 1 walk and 4 frames.
        wanted = {
            key: int(np.ceil(1.1 * count * (self.made[key] + 1) / (self.gave[key] + 4)))
            for key, count in lacking.items()
        }
        most, total = self.config.wave * WALKS, sum(wanted.values())
        if total > most:
            wanted = {key: max(1, count * most // total) for key, count in wanted.items()}
        number = self.shard.first + sum(len(frames.number) for frames in self.walked)
        walks: list[Walk] = []
        quota_of: dict[int, Quota] = {}
        for key, count in wanted.items():
            # loops are of no split; a quota without crossings prefers them, others their own split
            sides = start.nx == 0, split == key[0]
            first, second = sides if key[1] == 0 else sides[::-1]
            own = np.flatnonzero(first if first.any() else second)
            if not len(own):
                raise Failed(
                    f"no family of states is left for {key[0]} with nx {key[1]}; start from more"
                    " states"
                )
            away = np.abs(start.nx[own] - key[1])
            own = own[away == away.min()]
            kinds = np.unique(start.kind[own])
            for kind in kinds[rng.integers(len(kinds), size=count)]:
                same = own[start.kind[own] == kind]
                walk = Walk(number + len(walks), int(same[rng.integers(len(same))]))
                quota_of[walk.number] = key
                walks.append(walk)
            self.made[key] += count
        return walks, quota_of

    def _units(
        self, walks: list[Walk], quota_of: dict[int, Quota], folder: Path
    ) -> Iterator[UnitFile]:
        """Yield units of walks with equally many steps; many crossings are lost sooner."""
        config = self.config
        groups: dict[int, list[Walk]] = {}
        for walk in walks:
            nx = quota_of[walk.number][1]
            steps = config.steps * (3 if nx == 0 else 2 if nx < 3 else 1) // 3
            groups.setdefault(max(config.stride, steps), []).append(walk)
        done = itertools.count(len(self.walked))
        for steps, group in sorted(groups.items()):
            for begin in range(0, len(group), WALKS):
                some = tuple(group[begin : begin + WALKS])
                states = self.start.states[[walk.base for walk in some]]
                most = max(config.nx)
                length = steps, config.stride
                unit = Unit(some, states, config.seed, *length, most, config.engine, config.walk)
                yield UnitFile(folder / f"{next(done):06d}.npz", unit)

    def _consider(self, frames: WalkFrames, quota_of: dict[int, Quota]) -> None:
        """Offer the frames of a unit to the chooser, one by one."""
        self.walked.append(frames)
        columns = frames.points, frames.walk.tolist(), frames.ease.tolist()
        for points, number, ease in zip(*columns, strict=True):
            quota = quota_of[number]
            rng = generator(Stream.IMAGE_CHOICE, self.config.seed, self.shard.first + self.frames)
            self.gave[quota] += self.chooser.consider(points, quota[0], ease, self.frames, rng)
            self.frames += 1

    def _table_files(self) -> list[TableFile]:
        """Return the files of the table; each split's rows are in random order."""
        config = self.config
        columns = {
            name: np.concatenate([getattr(frames, name) for frames in self.walked]).tolist()
            for name in ("walk", "steps", "rounds", "number", "start")
        }
        base_of = dict(zip(columns["number"], columns["start"], strict=True))
        files: list[TableFile] = []
        number = self.shard.first
        for place, split in enumerate(IMAGE_SPLITS):
            chosen = [choice for choice in self.chooser.chosen if choice.split == split]
            order = generator(Stream.IMAGE_ORDER, config.seed, place).permutation(len(chosen))
            count = -(-len(chosen) // config.rows_per_file)
            for index in range(count):
                picked = order[index * config.rows_per_file : (index + 1) * config.rows_per_file]
                rows = []
                for at, choice in enumerate(chosen[k] for k in picked):
                    walk = columns["walk"][choice.frame]
                    source = {
                        "walk": walk,
                        "pulls": columns["steps"][choice.frame],
                        "rounds": columns["rounds"][choice.frame],
                        **self._origin(choice, walk, base_of[walk]),
                        "seed": config.seed,
                        "row": number + at,
                    }
                    rows.append(Row(choice.points, choice.code, choice.split, source))
                number += len(rows)
                name = shard_name(split, index, count)
                seal = self.table.with_name("seals") / name
                files.append(TableFile(self.table / name, seal, tuple(rows), config.appearance))
        return files

    def _origin(self, choice: ChosenFrame, walk: int, base: int) -> dict[str, Any]:
        """Return the symmetry of a row and its family; a walk from a plain loop is its own."""
        names = ("reflect", "switch", "reverse", "base_shift")
        alone = int(self.start.family.max()) + 1 + walk
        family = int(self.start.family[base]) if self.start.nx[base] else alone
        return {**{name: getattr(choice.symmetry, name) for name in names}, "family": family}

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
            "walks": sum(len(frames.number) for frames in self.walked),
            "frames": sum(len(frames.walk) for frames in self.walked),
            "dropped": dict(sorted(dropped.items())),
            "refused": dict(sorted(self.chooser.refused.items())),
        }
        start, engine = self.start.states, self.config.engine
        write_used_walks(self.table, self.written, start, self.walked, engine)
        finish_images(self.table, self.written, report, request)
        return self.table

    def summary(self) -> str:
        return f"{len(self.chooser.chosen)} pictures"


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
