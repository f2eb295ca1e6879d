"""Recorded pulls as a policy: to expand, verify and replay episodes is to play them again."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from knotgym.common import Ids, InvalidPolicy, Table
from knotgym.control.sampler import Player, Pulls, SimplePolicy, rollouts
from knotgym.datasets import MACROS, Episodes
from knotgym.envs import EpisodeBatch, TaskConfig


def replay(
    episodes: Episodes, task: TaskConfig, seeds: Sequence[int] | Table | None = None
) -> Episodes:
    """Play recorded pulls again; once they are used up, the rope is left alone.

    Args:
        episodes: what is repeated: episode i of the run repeats row i.
        task: the environment.
        seeds: as of `rollouts`; by default the episodes begin where they were recorded.
    """
    policy = SimplePolicy("recorded", partial(_RecordedPlayer, episodes))
    return rollouts(policy, task, episodes.episodes if seeds is None else seeds)


class _RecordedPlayer(Player):
    """Repeats recorded pulls."""

    def __init__(self, episodes: Episodes, batch: EpisodeBatch) -> None:
        self._batch, self._steps, self._rows = batch, episodes.steps, episodes.episodes
        self._from = episodes.offsets
        self._row = np.zeros(batch.count, dtype=np.int64)
        self.planned = np.zeros(batch.count, dtype=np.int64)
        self.names = [""] * batch.count

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        numbers = self._batch.number[ids]
        if numbers.max() >= self._rows.rows:
            raise InvalidPolicy(f"{self._rows.rows} episodes are recorded, got {numbers.max()}")
        self._row[ids] = numbers
        for index, row in zip(ids.tolist(), numbers.tolist(), strict=True):
            self.names[index] = str(self._rows["policy"][row])
        self.planned[ids] = self._rows["planner_steps"][numbers]

    def act(self, ids: Ids) -> Pulls:
        row, steps = self._row[ids], self._steps
        # the last row of an episode has no pull: zeros leave the rope alone
        at = np.minimum(self._from[row] + self._batch.steps[ids], self._from[row + 1] - 1)
        macros = None
        if MACROS[0] in steps:
            macros = np.column_stack([steps[name][at].astype(np.int64) for name in MACROS])
        return Pulls(ids, steps["bead"][at].astype(np.int64), np.array(steps["force"][at]), macros)
