"""Rewards and ends of episodes: `reward`, `asked` and `Situation.reached` alone decide them.

    the goal code was shown for `hold` consecutive steps    success_reward, terminated
    otherwise, at step `horizon`                            failure_reward, truncated
    otherwise, if the rope was towed too far                failure_reward, truncated
    otherwise, if the simulation blew up                    0, truncated
    otherwise                                               0, the episode continues

An endless task pays success_reward at every step that has shown the goal for long enough, and
failure_reward never; its episodes are truncated as above and don't terminate.

Codes are compared without chirality (`GaussCode.matches`). A step in which the simulation blew up
never succeeds, and its reward is 0 even at the horizon.

Environments call `Situation.outcome`, and so do loaders for goals in hindsight, goal environments
for `compute_reward`, and `dataset verify`, which plays episodes again: a reward that is changed
here is changed for all of them. It may depend on the codes of rope and goal, and on the code before
the pull; where that isn't known, such a reward is refused. What a goal asks of a state, by default
its code, is `asked`, for relabelling, too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import InvalidInput

if TYPE_CHECKING:
    from knotgym.envs.tasks import TaskConfig


class Situation(NamedTuple):
    """What n steps led to, and the goals of their episodes.

    Attributes:
        visits: int16 (n, width), the code that the rope shows, see `topology.CodeArrays`.
        goal_visits: int16 (n, width or another), the code of the goal.
        held: int (n,), consecutive steps for which the goal has been shown, this one included,
            within the bound on towing.
        hold: int (n,) or one number: for how many steps it must be shown.
        steps: int (n,), steps since the reset, this one included.
        failed: bool (n,), whether the simulation blew up in this step.
        towed: bool (n,), whether the rope is beyond the bound on towing.
        visits_before: int16 (n, width or another), the code before the step; None if unknown.
    """

    visits: NDArray[np.int16]
    goal_visits: NDArray[np.int16]
    held: NDArray[np.int64]
    hold: ArrayLike
    steps: NDArray[np.int64]
    failed: ArrayLike = False
    towed: ArrayLike = False
    visits_before: NDArray[np.int16] | None = None

    @property
    def before(self) -> NDArray[np.int16]:
        """The codes before the pulls, int16 (n, width).

        Raises:
            InvalidInput: they aren't known.
        """
        if self.visits_before is None:
            raise InvalidInput(
                "the reward depends on the code before a pull, which a goal that may be exchanged"
                " doesn't tell: take it out of knotgym.envs.reward, or use no goal environment"
            )
        return self.visits_before

    @staticmethod
    def asked(task: TaskConfig, visits: NDArray[np.int16]) -> NDArray[np.int16]:
        """Return what goals ask of states, see the function `asked`: int16 (n, k)."""
        return asked(task, visits)

    @staticmethod
    def shown(
        task: TaskConfig, visits: NDArray[np.int16], goal_visits: NDArray[np.int16]
    ) -> NDArray[np.bool_]:
        """Return which of n states show their goals: bool (n,)."""
        return np.asarray((asked(task, visits) == asked(task, goal_visits)).all(axis=1))

    @staticmethod
    def reached(
        held: NDArray[np.int64], hold: ArrayLike, failed: ArrayLike = False
    ) -> NDArray[np.bool_]:
        """Return whether steps are successes: bool (n,); arguments are as the attributes."""
        return (held >= np.asarray(hold)) & ~np.asarray(failed)

    def outcome(self, task: TaskConfig) -> Outcome:
        """Return the rewards of n steps and whether they end their episodes."""
        terminated = self.reached(self.held, self.hold, self.failed) & (not task.endless)
        late = (self.steps >= task.horizon) | np.asarray(self.towed) | np.asarray(self.failed)
        return Outcome(reward(task, self), terminated, truncated=late & ~terminated)


class Outcome(NamedTuple):
    """Rewards of n steps, float64 (n,), and whether they end their episodes, bool (n,) each."""

    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


def asked(task: TaskConfig, visits: NDArray[np.int16]) -> NDArray[np.int16]:
    """Return what a goal asks of a state, given codes (n, width): int16 (n, k).

    A state shows its goal if both have the same; goals in hindsight are what a state has.
    """
    return visits


def reward(task: TaskConfig, seen: Situation) -> NDArray[np.float64]:
    """Return the rewards of n steps, float64 (n,)."""
    failure = 0.0 if task.endless else task.failure_reward
    late = ((seen.steps >= task.horizon) | np.asarray(seen.towed)) & ~np.asarray(seen.failed)
    success = seen.reached(seen.held, seen.hold, seen.failed)
    return np.where(success, task.success_reward, np.where(late, failure, 0.0))
