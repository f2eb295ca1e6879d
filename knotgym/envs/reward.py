"""Rewards and ends of episodes.

    the goal code was shown for `hold` consecutive steps    success_reward, terminated
    otherwise, at step `horizon`                            failure_reward, truncated
    otherwise, if the rope was towed too far                failure_reward, truncated
    otherwise, if the simulation blew up                    0, truncated
    otherwise                                               0, the episode continues

An endless task pays success_reward at every step that has shown the goal for long enough, and
failure_reward never; its episodes are truncated as above and don't terminate.

Codes are compared without chirality (`GaussCode.matches`). A step in which the simulation blew up
never succeeds, and its reward is 0 even at the horizon.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from knotgym.envs.tasks import TaskConfig


class Outcome(NamedTuple):
    """Rewards of n steps, float64 (n,), and whether they end their episodes, bool (n,) each."""

    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


def outcome(
    task: TaskConfig,
    reached: NDArray[np.bool_],
    steps: NDArray[np.int64],
    failed: NDArray[np.bool_],
    towed: ArrayLike = False,
) -> Outcome:
    """Return the rewards of n steps and whether they end their episodes.

    Args:
        task: horizon and rewards.
        reached: bool (n,), whether the goal has been shown for `hold` consecutive steps, this one
            included, within the bound on towing; False where the simulation blew up.
        steps: int (n,), steps since the reset, this one included.
        failed: bool (n,), whether the simulation blew up in this step.
        towed: bool (n,), whether the rope is beyond the bound on towing.
    """
    terminated = reached & (not task.endless)
    late = ((steps >= task.horizon) | np.asarray(towed)) & ~terminated
    failure = 0.0 if task.endless else task.failure_reward
    unsuccessful = np.where(late & ~failed, failure, 0.0)
    rewards = np.where(reached, task.success_reward, unsuccessful)
    return Outcome(rewards, terminated, truncated=late | failed)
