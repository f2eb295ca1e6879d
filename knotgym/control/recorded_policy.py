"""Recorded pulls as a policy: to expand, verify and replay episodes is to play them again.

`replay` repeats a set's episodes from their own starts. A policy `recorded:DATASET` recognizes an
episode by where its rope is after the reset and by its goal's code, so a recording is replayed in
every command that resets to the same starts, such as `knotgym evaluate` with the seed that the
episodes were recorded with.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from knotgym.common import Ids, InvalidPolicy, KnotgymError, Table
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.sampler import Player, Pulls, SimplePolicy, rollouts
from knotgym.datasets import MACROS, Episodes, open_episodes
from knotgym.envs import EpisodeBatch, TaskConfig

_PREFIX = "recorded:"  # of a policy's name; a dataset's id or path follows

_Key = tuple[bytes, bytes]  # of `start_qpos`, and of the goal's visits


def replay(
    episodes: Episodes, task: TaskConfig, seeds: Sequence[int] | Table | None = None
) -> Episodes:
    """Play recorded pulls again; once they are used up, the rope is left alone.

    Args:
        episodes: what is repeated: episode i of the run repeats row i.
        task: the environment.
        seeds: as of `rollouts`; by default the episodes begin where they were recorded.
    """
    policy = SimplePolicy("recorded", partial(_RecordedPlayer, episodes, ""))
    return rollouts(policy, task, episodes.episodes if seeds is None else seeds)


class _RecordedPlayer(Player):
    """Repeats recorded pulls.

    With a `name` an episode is recognized by its start and goal.
    """

    def __init__(self, episodes: Episodes, name: str, batch: EpisodeBatch) -> None:
        self._batch, self._steps, self._rows = batch, episodes.steps, episodes.episodes
        self._from, self._name = episodes.offsets, name
        self._row = np.zeros(batch.count, dtype=np.int64)
        self.planned = np.zeros(batch.count, dtype=np.int64)
        self.names = [name] * batch.count
        self._known: dict[_Key, int] = {}
        if name:
            # the start to the bit, noise included, and the goal: together they name an episode
            keys = zip(self._rows["start_qpos"], self._rows["goal_visits"], strict=True)
            self._known = {_key(*one): row for row, one in enumerate(keys)}

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        batch, rows = self._batch, self._rows
        for index in ids.tolist():
            row: int | None = int(batch.number[index])
            if self._name:
                row = self._known.get(_key(batch.start_qpos[index], batch.wanted[index]))
            if row is None or row >= rows.rows:
                raise InvalidPolicy(
                    f"{self._name or 'recorded'} has {rows.rows} episodes, but none with this start"
                    " and goal; use the task, --states, --split and --seed that it was recorded"
                    " with, and no more --episodes; evaluate draws other starts than collect"
                )
            self._row[index] = row
            self.names[index] = self._name or str(rows["policy"][row])
        self.planned[ids] = rows["planner_steps"][self._row[ids]]

    def act(self, ids: Ids) -> Pulls:
        row, steps = self._row[ids], self._steps
        # the last row of an episode has no pull: zeros leave the rope alone
        at = np.minimum(self._from[row] + self._batch.steps[ids], self._from[row + 1] - 1)
        macros = None
        if MACROS[0] in steps:
            macros = np.column_stack([steps[name][at].astype(np.int64) for name in MACROS])
        return Pulls(ids, steps["bead"][at].astype(np.int64), np.array(steps["force"][at]), macros)


def load(config: PolicyConfig) -> SimplePolicy:
    name = config.policy
    with InvalidPolicy.instead(f"policy {name}", KnotgymError):
        episodes = open_episodes(name.removeprefix(_PREFIX)).episodes
    return SimplePolicy(name, partial(_RecordedPlayer, episodes, name))


def files(name: str) -> dict[str, Path]:
    path = open_episodes(name.removeprefix(_PREFIX)).path
    return {path.name: path}


def _key(start_qpos: np.ndarray, goal_visits: np.ndarray) -> _Key:
    # padding differs from file to file, so zeros are left out
    visits = np.ascontiguousarray(goal_visits, dtype=np.int16)
    return np.ascontiguousarray(start_qpos).tobytes(), visits[visits != 0].tobytes()
