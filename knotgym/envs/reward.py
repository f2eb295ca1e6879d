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

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.configuration import Count, Real, configuration

SUCCESS_REWARD = 5.0
FAILURE_REWARD = -5.0


class Outcome(NamedTuple):
    """Rewards of n steps, float64 (n,), and whether they end their episodes, bool (n,) each."""

    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


@configuration
class RewardRule:
    """Parameters of the reward; for those of a task see `TaskConfig.reward_rule`.

    Attributes:
        hold: consecutive steps for which the goal code must be shown.
        horizon: steps until truncation.
        success_reward: reward on success.
        failure_reward: reward at the horizon, or beyond the bound on towing, without success.
        endless: go on after success.
    """

    hold: Count = 1
    horizon: Count = 50
    success_reward: Real = SUCCESS_REWARD
    failure_reward: Real = FAILURE_REWARD
    endless: bool = False

    def outcome(
        self, held: ArrayLike, steps: ArrayLike, failed: ArrayLike, towed: ArrayLike = False
    ) -> Outcome:
        """Return the rewards of n steps and whether they end their episodes.

        Args:
            held: int (n,), consecutive steps up to this one that showed the goal within the bound
                on towing.
            steps: int (n,), steps since the reset, this one included.
            failed: bool (n,), whether the simulation blew up in this step.
            towed: bool (n,), whether the rope is beyond the bound on towing.

        >>> RewardRule(hold=2, horizon=9).outcome([2, 1, 1], [4, 4, 9], [False] * 3).rewards
        array([ 5.,  0., -5.])
        """
        blew_up = np.asarray(failed, dtype=bool)
        reached = self.reached(held, failed)
        terminated = reached & (not self.endless)
        late = ((np.asarray(steps) >= self.horizon) | np.asarray(towed)) & ~terminated
        failure = 0.0 if self.endless else self.failure_reward
        unsuccessful = np.where(late & ~blew_up, failure, 0.0)
        return Outcome(
            rewards=np.where(reached, self.success_reward, unsuccessful),
            terminated=terminated,
            truncated=late | blew_up,
        )

    def reached(self, held: ArrayLike, failed: ArrayLike) -> NDArray[np.bool_]:
        """Return which of n steps are successes; arguments as of `outcome`."""
        return (np.asarray(held) >= self.hold) & ~np.asarray(failed, dtype=bool)


def success_at_last(steps: int, success_reward: float = SUCCESS_REWARD) -> Outcome:
    """Return the outcome of an episode that succeeds in its last step only.

    An episode that is relabelled in hindsight, and cut where it reaches its new goal, has this
    outcome.

    >>> success_at_last(3).rewards
    array([0., 0., 5.])
    """
    last = np.arange(1, steps + 1) == steps
    return Outcome(
        rewards=np.where(last, success_reward, 0.0),
        terminated=last,
        truncated=np.zeros(steps, dtype=bool),
    )


def consecutive(shown: ArrayLike) -> NDArray[np.int64]:
    """Count the consecutive states up to each one that show the goal: int64 (n,).

    >>> consecutive([True, True, False, True])
    array([1, 2, 0, 1])
    """
    seen = np.asarray(shown, dtype=bool)
    index = np.arange(1, len(seen) + 1)
    return index - np.maximum.accumulate(np.where(seen, 0, index))  # index - last state without it
