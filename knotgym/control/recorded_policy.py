"""Recorded pulls as a policy: to expand, verify and replay episodes is to play them again.

`RecordedPolicy` repeats a set's episodes from their own starts, `rollouts(policy, task,
episodes.episodes)`. A policy `recorded:DATASET` recognizes an episode by where its rope is after
the reset and by its goal's code, so a recording is replayed in every command that resets to the
same starts, such as `knotgym evaluate` with the seed that the episodes were recorded with.
"""

from pathlib import Path

import numpy as np

from knotgym.common import InvalidPolicy, KnotgymError
from knotgym.control.basic_policies import Generators
from knotgym.control.sampler import Ids, Pulls
from knotgym.datasets import MACROS, Episodes, episode_file, open_episodes
from knotgym.envs import EpisodeBatch, TaskConfig

PREFIX = "recorded:"  # of a policy's name; a dataset's id or path follows

_Key = tuple[bytes, bytes]  # of `start_qpos`, and of the goal's visits


class RecordedPolicy:
    """Repeats recorded pulls; once they are used up, the rope is left alone.

    Attributes:
        name: name of the policy.
        episodes: what is repeated.
        by_start: whether an episode is recognized by its start and goal; otherwise episode i of a
            run repeats row i.
    """

    def __init__(self, episodes: Episodes, name: str = "recorded", by_start: bool = False) -> None:
        self.name, self.episodes, self.by_start = name, episodes, by_start

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """Any task: an action of every view is stored as its pulls."""
        return task

    def player(self, batch: EpisodeBatch) -> "_RecordedPlayer":
        """Return a player for the lanes of a batch."""
        return _RecordedPlayer(self, batch)


class _RecordedPlayer:
    def __init__(self, policy: RecordedPolicy, batch: EpisodeBatch) -> None:
        self._batch, self._policy, self._steps = batch, policy, policy.episodes.steps
        self._from = policy.episodes.offsets
        self._row = np.zeros(batch.count, dtype=np.int64)
        self.planned = np.zeros(batch.count, dtype=np.int64)
        rows = policy.episodes.episodes
        self.names = [policy.name] * batch.count
        self._known: dict[_Key, int] = {}
        if policy.by_start:
            # the start to the bit, noise included, and the goal: together they name an episode
            keys = zip(rows["start_qpos"], rows["goal_visits"], strict=True)
            self._known = {_key(*one): row for row, one in enumerate(keys)}

    def begin(self, ids: Ids, rngs: Generators) -> None:
        batch, policy = self._batch, self._policy
        rows = policy.episodes.episodes
        for index in ids.tolist():
            row: int | None = int(batch.number[index])
            if policy.by_start:
                row = self._known.get(_key(batch.start_qpos[index], batch.wanted[index]))
            if row is None or row >= rows.rows:
                raise InvalidPolicy(
                    f"{policy.name} has {rows.rows} episodes, but none with this start and goal;"
                    " use the task, --states, --split and --seed that it was recorded with, and no"
                    " more --episodes"
                )
            self._row[index] = row
            if not policy.by_start:
                self.names[index] = str(rows["policy"][row])
        self.planned[ids] = rows["planner_steps"][self._row[ids]]

    def act(self, ids: Ids) -> Pulls:
        row, steps = self._row[ids], self._steps
        # the last row of an episode has no pull: zeros leave the rope alone
        at = np.minimum(self._from[row] + self._batch.steps[ids], self._from[row + 1] - 1)
        macros = None
        if MACROS[0] in steps:
            macros = np.column_stack([steps[name][at].astype(np.int64) for name in MACROS])
        return Pulls(ids, steps["bead"][at].astype(np.int64), np.array(steps["force"][at]), macros)


def load_recording(name: str) -> RecordedPolicy:
    """Return the policy of a name `recorded:DATASET`.

    Raises:
        InvalidPolicy: there is no such dataset.
    """
    try:
        return RecordedPolicy(open_episodes(name.removeprefix(PREFIX)).episodes, name, True)
    except KnotgymError as error:
        raise InvalidPolicy(str(error)) from error


def recording_files(name: str) -> dict[str, Path]:
    """Return the file that decides how a recorded policy acts."""
    path = episode_file(name.removeprefix(PREFIX))
    return {path.name: path}


def _key(start_qpos: np.ndarray, goal_visits: np.ndarray) -> _Key:
    # padding differs from file to file, so zeros are left out
    visits = np.ascontiguousarray(goal_visits, dtype=np.int16)
    return np.ascontiguousarray(start_qpos).tobytes(), visits[visits != 0].tobytes()
