"""The recipe of `knotgym generate --source random-walk`, with a checkpoint after every wave.

Until the run is finished, the staging folder contains

    walks.json     counters, and the checksum of the file below; written last
    accepted.npz   the accepted states, column by column
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import mujoco
import numpy as np

import knotgym
from knotgym.common.atomic_files import atomic_write, sha256
from knotgym.common.configuration import as_json
from knotgym.generate.states import state_folder
from knotgym.generate.states.random_walk import (
    STARTS,
    RandomWalkConfig,
    Walked,
    WalkState,
    WalkUnit,
    key_of,
    walk,
)
from knotgym.generate.states.state_recipe import SpoiltCheckpoint
from knotgym.quality.measures import UNITS, Quality
from knotgym.rendering.picture import draw_many
from knotgym.rope.model import Array, Rope
from knotgym.runs.engine import CHECKPOINT, Batch, run
from knotgym.runs.progress import Progress, Status
from knotgym.runs.run_options import InvalidRun, NotEnough, RunOptions
from knotgym.runs.sealed_json import read_sealed, write_sealed
from knotgym.states.near_duplicates import pairs_within
from knotgym.states.schema import RANDOM_WALK, STATE_SPLITS
from knotgym.states.state_file import States, write_states
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import codes_of, knot_type

_RUN, _ACCEPTED = "walks.json", "accepted.npz"


def walk_states(
    config: RandomWalkConfig, out: Path, options: RunOptions, *, progress: Progress | None = None
) -> Path:
    """Make states of random walks in the new folder `out`, and return it.

    Args:
        config: which states to make.
        out: the folder.
        options: how to execute the run; shards are not supported.
        progress: where to show progress; a new display by default.

    Raises:
        Occupied, InvalidRun: as in `runs.engine.run`.
        NotEnough: `config.attempts` were used up.
    """
    if not options.shard.is_whole:
        raise InvalidRun("--source random-walk doesn't support --shard: leave it out")
    return run(RandomWalkRecipe(config), out, options, progress)


class RandomWalkRecipe:
    """Recipe for states of random walks, see `runs.engine.Recipe`."""

    flexible: tuple[str, ...] = ("attempts",)

    def __init__(self, config: RandomWalkConfig) -> None:
        self.config = config
        self.walked = 0  # ropes
        self.accepted: list[WalkState] = []
        self.rejected: dict[int, Counter[str]] = {nx: Counter() for nx in config.nx}

    def request(self) -> dict[str, Any]:
        return {"config": as_json(self.config), "source": RANDOM_WALK}

    def begin(self) -> None:
        pass  # nothing to prepare

    def batches(self, folder: Path) -> Iterator[Batch]:
        config = self.config
        most = config.attempts * max(config.count, config.loops)
        while not self.done():
            if self.walked >= most:
                raise NotEnough(
                    f"states are missing for {self._lacking()} after {self.walked} walks; give more"
                    " --attempts"
                )
            yield Batch(
                work=walk,
                units=[
                    WalkUnit(config, self.walked + k * config.batch) for k in range(config.wave)
                ],
                absorb=self._absorb,
                name="walking",
            )
            yield CHECKPOINT

    def done(self) -> bool:
        """Whether all requested states are made."""
        return not self._lacking()

    def save(self, folder: Path) -> None:
        with atomic_write(folder / _ACCEPTED) as temporary, open(temporary, "wb") as file:
            np.savez(
                file,
                rope=np.array([one.rope for one in self.accepted], dtype=np.int64),
                step=np.array([one.step for one in self.accepted], dtype=np.int64),
                code=np.array([one.code.chiral for one in self.accepted], dtype=np.str_),
                qpos=np.array([one.qpos for one in self.accepted]),
                points=np.array([one.points for one in self.accepted]),
                quality=np.array([json.dumps(asdict(one.quality)) for one in self.accepted]),
            )
        counters = {
            "walked": self.walked,
            "rejected": {str(nx): dict(reasons) for nx, reasons in self.rejected.items()},
            "sha256": sha256(folder / _ACCEPTED),
        }
        write_sealed(folder / _RUN, counters)

    def load(self, folder: Path) -> bool:
        if not (folder / _RUN).is_file():
            return False
        try:
            said = read_sealed(folder / _RUN)
            if sha256(folder / _ACCEPTED) != said["sha256"]:
                raise ValueError(f"SHA-256 of {_ACCEPTED} differs")
            with np.load(folder / _ACCEPTED, allow_pickle=False) as file:
                columns = [file[field.name] for field in fields(WalkState)]
            self.accepted = [
                WalkState(
                    rope=int(rope),
                    step=int(step),
                    code=GaussCode.parse(str(code)),
                    qpos=qpos,
                    points=points,
                    quality=Quality(**json.loads(str(quality))),
                )
                for rope, step, code, qpos, points, quality in zip(*columns, strict=True)
            ]
            self.walked = int(said["walked"])
            self.rejected = {nx: Counter(said["rejected"][str(nx)]) for nx in self.config.nx}
        except (OSError, ValueError, KeyError, TypeError, AttributeError, BadZipFile) as error:
            raise SpoiltCheckpoint(folder, error) from error
        return True

    def status(self) -> Status:
        wanted = [self.config.wanted(nx, split) for nx in self.config.nx for split in STATE_SPLITS]
        have = self._have()
        facts = {
            "ropes walked": f"{self.walked}",
            "states by nx": ", ".join(
                f"{nx}: {sum(have[nx, split] for split in STATE_SPLITS)}" for nx in self.config.nx
            ),
        }
        return Status(len(self.accepted), sum(wanted), "states accepted", facts)

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        folder.mkdir(parents=True)
        states = states_of(self.config, self.accepted)
        write_states(folder / "states.h5", states)
        state_folder.finish(folder, states, self.report(), request)
        return folder

    def summary(self) -> str:
        codes = len({one.code.plain for one in self.accepted})
        return f"{len(self.accepted)} states of {codes} codes"

    def report(self) -> dict[str, Any]:
        """Return the run's counts as JSON; the same configuration gives the same report."""
        rejected = {str(nx): dict(sorted(each.items())) for nx, each in self.rejected.items()}
        return {
            "version": knotgym.__version__,
            "mujoco": mujoco.__version__,
            "source": RANDOM_WALK,
            "knot": "0_1",
            "existing_codes": {str(nx): len(codes_of("0_1", nx)) for nx in self.config.nx},
            "attempts": self.walked,
            "actions": self.walked * self.config.longest,
            "rejected": rejected,
        }

    def _absorb(self, unit: WalkUnit, walked: Walked) -> None:
        """Accept the states that are still needed, in the order of the ropes."""
        self.walked = unit.first + self.config.batch
        for nx, reasons in walked.rejected.items():
            self.rejected[nx].update(reasons)
        have = self._have()
        for state in walked.states:
            kind = state.code.nx, self.config.split(state.rope)
            if have[kind] >= self.config.wanted(*kind):
                continue
            if self._is_near(state.points):
                self.rejected[state.code.nx]["near-duplicate"] += 1
                continue
            have[kind] += 1
            self.accepted.append(state)

    def _is_near(self, points: Array) -> bool:
        """Whether a configuration is a near-duplicate, up to symmetry, of an accepted one.

        Both splits count, since a rope's split is fixed before it walks.
        """
        accepted = [one.points for one in self.accepted]
        return bool(accepted) and bool(pairs_within(points[None], np.stack(accepted)))

    def _have(self) -> Counter[tuple[int, str]]:
        return Counter((one.code.nx, self.config.split(one.rope)) for one in self.accepted)

    def _lacking(self) -> str:
        """Name the crossing numbers and splits with missing states; "" if none."""
        have = self._have()
        return ", ".join(
            f"nx {nx} {split}"
            for nx in self.config.nx
            for split in STATE_SPLITS
            if have[nx, split] < self.config.wanted(nx, split)
        )


def states_of(config: RandomWalkConfig, accepted: list[WalkState]) -> States:
    """Return the accepted states as rows, sorted by nx and then by rope."""
    order = {nx: index for index, nx in enumerate(config.nx)}
    rows = sorted(accepted, key=lambda one: (order[one.code.nx], one.rope))
    points, rope = np.stack([one.points for one in rows]), Rope()
    start = rope.qpos(STARTS[config.start](rope))
    steps = np.array([one.step for one in rows], dtype=np.int64)
    return States(
        qpos=np.stack([one.qpos for one in rows]),
        points=points,
        image=draw_many(points),
        gauss_code=np.array([str(one.code) for one in rows]),
        gauss_code_chiral=np.array([one.code.chiral for one in rows]),
        knot=np.array([knot_type(one.code) for one in rows]),
        nx=np.array([one.code.nx for one in rows], dtype=np.int64),
        split=np.array([config.split(one.rope) for one in rows]),
        quality={
            field.name: np.array([getattr(one.quality, field.name) for one in rows])
            for field in fields(Quality)
        },
        units=dict(UNITS),
        source={
            "start_qpos": np.repeat(start[None], len(rows), axis=0),
            "steps": steps,
            "seed": np.array([key_of(config, one.rope) for one in rows], dtype=np.int64),
            "policy": np.array([RANDOM_WALK] * len(rows)),
            "trajectory": np.array([one.rope for one in rows], dtype=np.int64),
            "step": steps,
        },
        attributes={
            "knotgym": knotgym.__version__,
            "mujoco": mujoco.__version__,
            "rope": rope.config.fingerprint,
            "engine": config.engine,
            "config": json.dumps(asdict(config), sort_keys=True),
        },
    )
