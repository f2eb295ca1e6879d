"""The recipe of drawn states: every code wanted is drawn until it is accepted, wave by wave.

In the staging folder stand, until it is finished,

    drawn.json      counters, and the names of the files below; written last
    wave-{k}.npz    the states accepted in that wave, column by column, written once
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import mujoco
import numpy as np

import knotgym
from knotgym.common.atomic_files import atomic_write, sha256
from knotgym.common.configuration import as_json
from knotgym.common.streams import Stream, generator
from knotgym.generate.states import state_folder
from knotgym.generate.states.curation import is_near_duplicate
from knotgym.generate.states.drawn_states import (
    DrawnOnes,
    DrawnState,
    DrawnStatesConfig,
    DrawnUnit,
    draw_states,
    key_of,
)
from knotgym.generate.states.generate_config import InvalidGenerateConfig
from knotgym.generate.states.state_recipe import SpoiltCheckpoint
from knotgym.quality.measures import UNITS, Quality
from knotgym.rendering.picture import draw_many
from knotgym.rope.model import RopeConfig
from knotgym.runs.engine import CHECKPOINT, Batch, run
from knotgym.runs.progress import Progress, Status
from knotgym.runs.run_options import NotEnough, RunOptions
from knotgym.runs.sealed_json import read_sealed, write_sealed
from knotgym.runs.shards import Shard
from knotgym.states.schema import DRAWING
from knotgym.states.splits import kept_together, split
from knotgym.states.state_file import States, write_states
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import based_diagrams, diagram_of, type_of
from knotgym.topology.knots import LISTED_NX, codes_of, knot_type, shows
from knotgym.topology.uniform_codes import uniform_code

_RARE = 20_000  # codes drawn at random, one of which should be of the knot
_RUN = "drawn.json"


def draw_state_set(
    config: DrawnStatesConfig, out: Path, options: RunOptions, *, progress: Progress | None = None
) -> Path:
    """Make drawn states in the new folder `out`, or in that of the shard, and return it.

    Args:
        config: what is wanted.
        out: the folder of the whole run.
        options: how it is done.
        progress: to show it on.

    Raises:
        Occupied, InvalidRun: as of `runs.engine.run`.
        InvalidGenerateConfig: nothing of the kind can be made.
        NotEnough: the attempts allowed were spent.
    """
    recipe = DrawnStatesRecipe(config, options.shard)
    return run(recipe, options.shard.folder(out), options, progress)


class DrawnStatesRecipe:
    """Drawn states, see `runs.engine.Recipe`."""

    flexible: tuple[str, ...] = ("attempts", "cycles")

    def __init__(self, config: DrawnStatesConfig, shard: Shard) -> None:
        self.config, self.shard = config, shard
        self.codes = {nx: CodeOrder(config, shard, nx) for nx in config.nx}
        self.accepted: dict[int, list[DrawnState]] = {nx: [] for nx in config.nx}
        self.have: Counter[tuple[int, int]] = Counter()  # (nx, index of the code) -> states
        self.tried: Counter[tuple[int, int]] = Counter()  # the same -> drawings
        self.rejected: dict[int, Counter[str]] = {nx: Counter() for nx in config.nx}
        self.waves: list[dict[str, Any]] = []  # files saved: name, checksum
        self.saved: Counter[int] = Counter()  # nx -> states in those files
        self.cycle = 0

    def request(self) -> dict[str, Any]:
        return {"config": as_json(self.config), "source": DRAWING}

    def begin(self) -> None:
        for nx, codes in self.codes.items():
            if codes.listed is not None and not len(codes.listed):
                raise InvalidGenerateConfig(f"no diagram of {self.config.knot} has {nx} crossings")

    def batches(self, folder: Path) -> Iterator[Batch]:
        while not self.config.cycles or self.cycle < self.config.cycles:
            units = self._units()
            if not units:
                break
            yield Batch(work=draw_states, units=units, absorb=self._absorb)
            self.cycle += 1
            yield CHECKPOINT
        lacking = {nx: self.codes[nx].wanted - len(self.accepted[nx]) for nx in self.config.nx}
        if not self.config.cycles and any(lacking.values()):
            said = ", ".join(f"{count} with nx = {nx}" for nx, count in lacking.items() if count)
            raise NotEnough(
                f"states lack: {said}; use --resume and more --attempts, or --cycles"
                f" {self.cycle} to keep what there is"
            )
        if not any(self.accepted.values()):
            raise NotEnough("no drawing was accepted; allow more --cycles")

    def save(self, folder: Path) -> None:
        fresh = [one for nx in self.config.nx for one in self.accepted[nx][self.saved[nx] :]]
        if fresh:
            name = f"wave-{self.cycle:06d}.npz"
            with atomic_write(folder / name) as temporary, open(temporary, "wb") as file:
                np.savez(file, **_columns(fresh))
            self.waves.append({"name": name, "sha256": sha256(folder / name)})
            self.saved = Counter({nx: len(ones) for nx, ones in self.accepted.items()})
        counters = {
            "cycle": self.cycle,
            "tried": [[*which, count] for which, count in self.tried.items()],
            "rejected": {str(nx): dict(reasons) for nx, reasons in self.rejected.items()},
            "waves": self.waves,
        }
        write_sealed(folder / _RUN, counters)

    def load(self, folder: Path) -> bool:
        if not (folder / _RUN).is_file():
            return False
        try:
            said = read_sealed(folder / _RUN)
            for wave in said["waves"]:
                if sha256(folder / wave["name"]) != wave["sha256"]:
                    raise ValueError(f"SHA-256 of {wave['name']} differs")
                with np.load(folder / wave["name"], allow_pickle=False) as file:
                    for one in _rows(file):
                        self._accept(one)
            self.cycle, self.waves = int(said["cycle"]), said["waves"]
            self.saved = Counter({nx: len(ones) for nx, ones in self.accepted.items()})
            self.tried = Counter({(nx, index): count for nx, index, count in said["tried"]})
            self.rejected = {nx: Counter(said["rejected"][str(nx)]) for nx in self.config.nx}
        except (OSError, ValueError, KeyError, TypeError, AttributeError, BadZipFile) as error:
            raise SpoiltCheckpoint(folder, error) from error
        return True

    def status(self) -> Status:
        rejected: Counter[str] = sum(self.rejected.values(), Counter())
        common = ", ".join(f"{reason} {count}" for reason, count in rejected.most_common(4))
        facts = {
            "drawings": f"{self.tried.total()}",
            "states by nx": ", ".join(f"{nx}: {len(ones)}" for nx, ones in self.accepted.items()),
            "rejected": common or "none",
        }
        total = sum(codes.wanted for codes in self.codes.values())
        return Status(sum(map(len, self.accepted.values())), total, "states accepted", facts)

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        folder.mkdir(parents=True)
        states = self._states()
        write_states(folder / "states.h5", states)
        state_folder.finish(folder, states, self.report(), request)
        return folder

    def summary(self) -> str:
        codes = {one.code.plain for ones in self.accepted.values() for one in ones}
        return f"{sum(map(len, self.accepted.values()))} states of {len(codes)} codes"

    def report(self) -> dict[str, Any]:
        """What the run did, JSON-able and the same for the same configuration."""
        return {
            "version": knotgym.__version__,
            "mujoco": mujoco.__version__,
            "source": DRAWING,
            "knot": self.config.knot,
            "existing_codes": {str(nx): codes.existing for nx, codes in self.codes.items()},
            "attempts": self.tried.total(),
            "actions": 0,
            "rejected": {str(nx): dict(sorted(each.items())) for nx, each in self.rejected.items()},
            "passed_over": {
                str(nx): [
                    str(codes[index])
                    for index in sorted(i for n, i in self.tried if n == nx)
                    if self.have[nx, index] < codes.share(index)
                ]
                for nx, codes in self.codes.items()
            },
        }

    def _units(self) -> list[DrawnUnit]:
        """The next wave: codes that lack states, in their order, and aren't given up."""
        units: list[DrawnUnit] = []
        for nx, codes in self.codes.items():
            left, position = codes.wanted - len(self.accepted[nx]), 0
            while left > 0 and len(units) < self.config.wave:
                index = codes.index(position)
                if index is None:
                    break
                position += 1
                lacking = codes.share(index) - self.have[nx, index]
                tried = self.tried[nx, index]
                drawings = min(self.config.batch, self.config.attempts * codes.share(index) - tried)
                if lacking <= 0 or drawings <= 0:
                    continue
                wanted = min(lacking, left)
                left -= wanted
                units.append(DrawnUnit(self.config, codes[index], index, tried, drawings, wanted))
        return units

    def _absorb(self, unit: DrawnUnit, made: DrawnOnes) -> None:
        nx = unit.code.nx
        self.tried[nx, unit.which] += made.drawings
        self.rejected[nx].update(made.rejected)
        for one in made.states:
            if is_near_duplicate(one.points, [other.points for other in self.accepted[nx]]):
                self.rejected[nx]["near-duplicate"] += 1
            else:
                self._accept(one)

    def _accept(self, one: DrawnState) -> None:
        self.accepted[one.code.nx].append(one)
        self.have[one.code.nx, one.index] += 1

    def _states(self) -> States:
        """The accepted states as rows, by nx and code."""
        config = self.config
        rows = [
            one
            for nx in config.nx
            for one in sorted(self.accepted[nx], key=lambda one: (one.index, one.number))
        ]
        splits: list[str] = []
        for nx in config.nx:
            codes = [one.code for one in rows if one.code.nx == nx]
            rng = generator(Stream.SPLIT, config.seed, nx)
            splits += split(codes, config.split_by, config.train_share, rng).tolist()
        columns = _columns(rows)
        return States(
            qpos=columns["qpos"],
            points=columns["points"],
            image=draw_many(columns["points"]),
            gauss_code=np.array([str(one.code) for one in rows]),
            gauss_code_chiral=columns["code"],
            knot=np.array([knot_type(one.code) for one in rows]),
            nx=np.array([one.code.nx for one in rows], dtype=np.int64),
            split=kept_together(np.array(splits), columns["points"], [one.code for one in rows]),
            quality={
                field.name: np.array([getattr(one.quality, field.name) for one in rows])
                for field in fields(Quality)
            },
            units=dict(UNITS),
            source={
                "start_qpos": columns["start_qpos"],
                "actions": columns["actions"],
                "steps": columns["steps"],
                "seed": np.array(
                    [key_of(config, one.code.nx, one.index, one.number) for one in rows],
                    dtype=np.int64,
                ),
                "policy": np.array([DRAWING] * len(rows)),
                "dataset": np.array([""] * len(rows)),
                "trajectory": columns["number"],
                "step": columns["steps"],
                "drawing": np.array([json.dumps(as_json(config.drawing))] * len(rows)),
            },
            attributes={
                "knotgym": knotgym.__version__,
                "mujoco": mujoco.__version__,
                "rope": RopeConfig().fingerprint,
                "config": json.dumps(asdict(config), sort_keys=True),
            },
        )


class CodeOrder:
    """The codes of one nx in the order in which they are drawn, by index.

    Attributes:
        listed: those drawn; None where there are too many. A knot of more than LISTED_NX crossings
            is drawn with these as the table's diagram, from every base.
        existing: how many codes of the nx show the knot; None if nobody counted.
        wanted: states in all.
    """

    def __init__(self, config: DrawnStatesConfig, shard: Shard, nx: int) -> None:
        self._config, self._shard, self._nx = config, shard, nx
        self.listed: Sequence[GaussCode] | None = None
        self.existing: int | None = None
        if config.codes:
            self.listed = [code for code in config.parsed if code.nx == nx]
        elif nx <= LISTED_NX:
            self.listed = codes_of(type_of(config.knot), nx)
        elif nx == diagram_of(config.knot).nx:
            self.listed = based_diagrams(diagram_of(config.knot))
        if self.listed is not None and (config.codes or nx <= LISTED_NX):
            self.existing = len(self.listed)
        if self.listed is None:
            if config.every_code:
                raise InvalidGenerateConfig(
                    f"the codes of {nx} crossings are too many to be listed, so every_code takes"
                    f" nx to {LISTED_NX}; give a count"
                )
            self._each = 1
            self.wanted = len(shard.share(config.count))
            self._rng = generator(Stream.DRAWING_CODES, config.seed, nx)
            self._drawn: dict[GaussCode, None] = {}
            return
        order = generator(Stream.CODE_ORDER, config.seed, nx).permutation(len(self.listed))
        self._order: list[int] = list(shard.dealt(order.tolist()))
        self._each = config.every_code or -(-config.count // max(1, len(self.listed)))
        self.wanted = (
            config.every_code * len(self._order)
            if config.every_code
            else min(len(shard.share(config.count)), self._each * len(self._order))
        )

    def share(self, index: int) -> int:
        """States wanted of a code at most."""
        return self._each

    def index(self, position: int) -> int | None:
        """The index of the code at a position of the order; None past its end."""
        if self.listed is None:
            return self._shard.number - 1 + position * self._shard.of
        return self._order[position] if position < len(self._order) else None

    def __getitem__(self, index: int) -> GaussCode:
        if self.listed is not None:
            return self.listed[index]
        while len(self._drawn) <= index:
            self._drawn.setdefault(self._next())
        return list(self._drawn)[index]

    def _next(self) -> GaussCode:
        """The next code of the knot, drawn at random."""
        knot = self._config.knot
        for _ in range(_RARE):
            code = uniform_code(self._nx, self._rng)
            if shows(code, knot):
                return code
        raise InvalidGenerateConfig(
            f"of {_RARE} codes with {self._nx} crossings drawn at random none shows {knot}"
        )


def _columns(ones: list[DrawnState]) -> dict[str, Any]:
    """States as arrays by name, their actions padded with zeros."""
    longest = max(len(one.actions) for one in ones)
    actions = np.zeros((len(ones), longest, 6), dtype=np.float32)
    for row, one in enumerate(ones):
        actions[row, : len(one.actions)] = one.actions
    return {
        "code": np.array([one.code.chiral for one in ones], dtype=np.str_),
        "index": np.array([one.index for one in ones], dtype=np.int64),
        "number": np.array([one.number for one in ones], dtype=np.int64),
        "start_qpos": np.stack([one.start_qpos for one in ones]),
        "actions": actions,
        "steps": np.array([len(one.actions) for one in ones], dtype=np.int64),
        "qpos": np.stack([one.qpos for one in ones]),
        "points": np.stack([one.points for one in ones]),
        "quality": np.array([json.dumps(asdict(one.quality)) for one in ones]),
    }


def _rows(columns: Any) -> Iterator[DrawnState]:
    """The states that `_columns` made arrays of."""
    names = ("code", "index", "number", "start_qpos", "actions", "steps", "qpos", "points")
    for *row, quality in zip(*(columns[name] for name in (*names, "quality")), strict=True):
        code, index, number, start_qpos, actions, steps, qpos, points = row
        yield DrawnState(
            code=GaussCode.parse(str(code)),
            index=int(index),
            number=int(number),
            start_qpos=start_qpos,
            actions=actions[: int(steps)],
            qpos=qpos,
            points=points,
            quality=Quality(**json.loads(str(quality))),
        )
