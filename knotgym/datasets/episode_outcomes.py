"""Where episodes reach their goal, computed again from their codes."""

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.episodes import Episodes, within_tow
from knotgym.envs.tasks import TaskConfig


def goal_reached(episodes: Episodes, task: TaskConfig) -> NDArray[np.bool_]:
    """Return which states show the goal for as many consecutive states as the task asks.

    A start is never one of them, nor a state beyond the bound on towing or in which the simulation
    blew up.

    Returns:
        bool (rows,), for each row of steps.
    """
    own, steps = episodes.episodes, episodes.steps
    episode, first, last = episodes.episode_of(), episodes.offsets[:-1], episodes.last()
    shown = (steps["visits"] == own["goal_visits"][episode]).all(axis=1)
    shown[first] = False  # the start isn't the result of a pull, and so ends an earlier run too
    shown &= within_tow(episodes, task.tow_limit)
    index = np.arange(len(shown), dtype=np.int64)
    # consecutive states up to each one: since the last row that doesn't show the goal
    held = index - np.maximum.accumulate(np.where(shown, -1, index))
    wanted = np.where(own["hold"] > 0, own["hold"], task.hold)
    reached = shown & (held >= wanted[episode])
    reached[last] &= ~own["failed"]
    return np.asarray(reached)
