"""The recipe of `knotgym generate --source random-walk`, with a checkpoint after every wave.

Until the run is finished, the staging folder contains

    walks.json     counters, and the checksum of the file below; written last
    accepted.npz   the accepted states, column by column
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import knotgym
from knotgym.common.configuration import as_json
from knotgym.common.errors import Failed, InvalidInput
from knotgym.datasets.finished_folders import finish_states
from knotgym.generate.packed_records import (
    read_records,
    reading_checkpoint,
    require_digest,
    write_records,
)
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
from knotgym.rope.model import Array, Rope
from knotgym.runs.engine import CHECKPOINT, Batch, Recipe, run
from knotgym.runs.progress import Progress, Status
from knotgym.runs.run_options import RunOptions
from knotgym.runs.sealed_json import read_sealed, write_sealed
from knotgym.states.near_duplicates import pairs_within
from knotgym.states.schema import RANDOM_WALK
from knotgym.states.split_names import STATE_SPLITS
from knotgym.states.state_file import States, write_states
from knotgym.topology.knots import codes_of

_RUN, _ACCEPTED = "walks.json", "accepted.npz"


def walk_states(
    config: RandomWalkConfig, out: Path, options: RunOptions, *, progress: Progress | None = None
) -> Path:
    """Make states of random walks in the new folder `out`, and return it.

    Raises:
        Occupied, InvalidInput: as in `runs.engine.run`; shards are not supported.
        Failed: `config.attempts` were used up.
    """
    if not options.shard.is_whole:
        raise InvalidInput("--source random-walk doesn't support --shard: leave it out")
    return run(RandomWalkRecipe(config), out, options, progress)


class RandomWalkRecipe(Recipe):
    """Recipe for states of random walks, see `runs.engine.Recipe`."""

    flexible = ("attempts",)

    def __init__(self, config: RandomWalkConfig) -> None:
        self.config = config
        self.engine = config.engine
        self.walked = 0  # ropes
        self.accepted: list[WalkState] = []
        self.rejected: dict[int, Counter[str]] = {nx: Counter() for nx in config.nx}

    def request(self) -> dict[str, Any]:
        return {"config": as_json(self.config), "source": RANDOM_WALK}

    def batches(self, folder: Path) -> Iterator[Batch]:
        config = self.config
        most = config.attempts * max(config.count, config.loops)
        while lacking := self._lacking():
            if self.walked >= most:
                raise Failed(
                    f"states are missing for {lacking} after {self.walked} walks; give more"
                    " --attempts"
                )
            firsts = range(self.walked, self.walked + config.wave * config.batch, config.batch)
            units = [WalkUnit(config, first) for first in firsts]
            yield Batch(walk, units, self._absorb, "walking")
            yield CHECKPOINT

    def save(self, folder: Path) -> None:
        counters = {
            "walked": self.walked,
            "rejected": {str(nx): dict(reasons) for nx, reasons in self.rejected.items()},
            "sha256": write_records(folder / _ACCEPTED, {"states": self.accepted}),
        }
        write_sealed(folder / _RUN, counters)

    def load(self, folder: Path) -> bool:
        if not (folder / _RUN).is_file():
            return False
        with reading_checkpoint(folder):
            stored = read_sealed(folder / _RUN)
            require_digest(folder / _ACCEPTED, stored["sha256"])
            self.accepted = read_records(folder / _ACCEPTED, "states", WalkState)
            self.walked = int(stored["walked"])
            self.rejected = {nx: Counter(stored["rejected"][str(nx)]) for nx in self.config.nx}
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
        finish_states(folder, states, self.report(), request)
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
    rope = Rope()
    start = rope.qpos(STARTS[config.start](rope))
    steps = np.array([one.step for one in rows], dtype=np.int64)
    return state_folder.rows_of(
        rows,
        split=[config.split(one.rope) for one in rows],
        source={
            "start_qpos": np.repeat(start[None], len(rows), axis=0),
            "steps": steps,
            "seed": np.array([key_of(config, one.rope) for one in rows], dtype=np.int64),
            "policy": np.array([RANDOM_WALK] * len(rows)),
            "trajectory": np.array([one.rope for one in rows], dtype=np.int64),
            "step": steps,
        },
        config=asdict(config),
    )
