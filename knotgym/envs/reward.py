"""The reward rule: what an episode pays, and when it ends.

    the goal code shown `hold` steps running    success_reward, terminated
    else, at step `horizon`                     failure_reward, truncated
    else, where the rope was towed too far      failure_reward, truncated
    else, where the simulation blew up          0, truncated
    else                                        0, goes on

The code is compared without chirality (`GaussCode.matches`). A step in which the simulation blew up
never succeeds, and pays 0 at the horizon too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

SUCCESS_REWARD = 5.0
FAILURE_REWARD = -5.0


class Outcome(NamedTuple):
    """What n steps pay, float64 (n,), and whether they end their episodes, bool (n,) each."""

    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class RewardRule:
    """The rule's numbers; a task's are `TaskConfig.reward_rule`.

    Attributes:
        hold: consecutive steps the goal code must show.
        horizon: steps until truncation.
        success_reward, failure_reward: paid at success, and at the horizon without it.
    """

    hold: int = 1
    horizon: int = 50
    success_reward: float = SUCCESS_REWARD
    failure_reward: float = FAILURE_REWARD

    def outcome(
        self, held: ArrayLike, steps: ArrayLike, failed: ArrayLike, towed: ArrayLike = False
    ) -> Outcome:
        """What steps pay.

        Args:
            held: int (n,), consecutive steps that the goal has been shown by then.
            steps: int (n,), taken by then since the reset.
            failed: bool (n,), the simulation blew up in this step.
            towed: bool (n,), the rope lies beyond the bound on towing; such states count as none
                that show the goal.

        >>> RewardRule(hold=2, horizon=9).outcome([2, 1, 1], [4, 4, 9], [False] * 3).rewards
        array([ 5.,  0., -5.])
        """
        blew_up = np.asarray(failed, dtype=bool)
        terminated = (np.asarray(held) >= self.hold) & ~blew_up
        late = ((np.asarray(steps) >= self.horizon) | np.asarray(towed)) & ~terminated
        unsuccessful = np.where(late & ~blew_up, self.failure_reward, 0.0)
        return Outcome(
            rewards=np.where(terminated, self.success_reward, unsuccessful),
            terminated=terminated,
            truncated=late | blew_up,
        )


def success_at_last(steps: int, success_reward: float = SUCCESS_REWARD) -> Outcome:
    """The outcome of so many steps of which the last, and no other, succeeds.

    Such is an episode that was cut in hindsight where it reached the goal it now has.

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
    """How many states running, up to and with each, show the goal: int64 (n,).

    >>> consecutive([True, True, False, True])
    array([1, 2, 0, 1])
    """
    seen = np.asarray(shown, dtype=bool)
    place = np.arange(1, len(seen) + 1)
    return place - np.maximum.accumulate(np.where(seen, 0, place))
