"""Outcomes of episodes, computed again from their codes and the task's reward rule."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.episodes import Episodes, held_for, ranges, within_tow
from knotgym.envs.reward import outcome
from knotgym.envs.tasks import TaskConfig


class Outcomes(NamedTuple):
    """What the rows of steps bring by the reward rule, each (rows,).

    Attributes:
        reached: whether the row's state shows the goal for long enough, bool.
        reward, terminated, truncated: as the columns of these names.
    """

    reached: NDArray[np.bool_]
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


def outcomes(episodes: Episodes, task: TaskConfig) -> Outcomes:
    """Compute the outcomes of columns from codes, vertices, and whether simulations blew up."""
    own, steps = episodes.episodes, episodes.steps
    episode, first, last = episodes.episode_of(), episodes.offsets[:-1], episodes.last()
    shown = (steps["visits"] == own["goal_visits"][episode]).all(axis=1)
    shown[first] = False  # the start isn't the result of a pull
    within = within_tow(episodes, task.tow_limit)
    failed = np.zeros(len(shown), dtype=bool)
    failed[last] = own["failed"]
    wanted = np.where(own["hold"] > 0, own["hold"], task.hold)
    count = ranges(np.zeros_like(own["length"]), own["length"] + 1)  # pulls before each state
    reached = (held_for(shown & within, episodes) >= wanted[episode]) & ~failed
    found = outcome(task, reached, count, failed, ~within)

    def of_pull(values: NDArray[np.generic]) -> NDArray[np.generic]:
        """Move what a state has to the row of the pull that led there."""
        moved = np.roll(values, -1)
        moved[last] = 0
        return moved

    return Outcomes(
        np.asarray(reached & (count > 0)),
        *map(of_pull, found),  # type: ignore[arg-type]
    )
