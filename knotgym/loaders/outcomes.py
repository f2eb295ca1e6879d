"""What transitions brought: their rewards and ends, one by one and over windows of several.

There are three rewards: those of the dataset, those of goals that an episode reached (hindsight),
and those that a user's function gives to its pulls. With sampled goals, transitions are rewarded as
`GoalSampling` says.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array, Ids, InvalidInput, Table
from knotgym.datasets import Episodes
from knotgym.envs import Situation
from knotgym.loaders.segments import Segments
from knotgym.loaders.windows import Window

Reward = Callable[[dict[str, Any], Table], ArrayLike]  # see `Opening`


class Outcomes:
    """What each of the N transitions of some segments brought; computed when it is asked for."""

    def __init__(self, segments: Segments, reward: Reward | None) -> None:
        """Take transitions.

        Args:
            segments: the transitions.
            reward: gives the rewards of an episode's pulls; None for those of the dataset.
        """
        self._segments, self._reward = segments, reward

    @cached_property
    def rewards(self) -> Array:
        """float64 (N,)."""
        segments = self._segments
        before, after = segments.before, segments.after
        if segments.relabelled:
            rewards = self._hindsight_rewards()
            # segments of one episode share its rows, so each gets rows of its own
            shift = np.cumsum(segments.goal_step + 1) - (segments.goal_step + 1) - segments.first
            shift = np.repeat(shift, np.diff(segments.starts))
            before, after = before + shift, after + shift
        elif self._reward is not None:
            rewards = self._rewards_by(self._reward)
        else:
            rewards = segments.episodes.steps["reward"]
        if not segments.leads:
            return rewards[before]
        between = np.stack([before, after], axis=1).ravel()
        return np.add.reduceat(rewards, between)[::2] if len(between) else np.zeros(0)

    @cached_property
    def terminals(self) -> NDArray[np.bool_]:
        """bool (N,), true where an episode terminated."""
        segments = self._segments
        if segments.relabelled:
            return np.isin(np.arange(segments.starts[-1]), segments.starts[1:] - 1)
        return segments.episodes.steps["terminated"][segments.after - 1]

    @cached_property
    def timeouts(self) -> NDArray[np.bool_]:
        """bool (N,), true where an episode was truncated."""
        segments = self._segments
        if segments.relabelled:
            return np.zeros(len(segments.after), dtype=bool)
        return segments.episodes.steps["truncated"][segments.after - 1]

    @cached_property
    def pulls(self) -> Ids:
        """int64 (N,), pulls of each transition: 1 unless they are macro-actions."""
        return self._segments.after - self._segments.before

    def _of_window(
        self, rows: Ids, window: Window, goals: Ids | None
    ) -> tuple[Ids, dict[str, NDArray[Any]]]:
        """Return what happened in the window from each of n transitions on.

        Args:
            rows: (n,), the first transitions.
            window: how many from each, and with which discount.
            goals: (n,), states that are their goals; None for those of the segments.

        Returns:
            As `_returns`.
        """
        segments = self._segments.of(rows)
        end = self._segments.starts[segments + 1][:, None]
        longest = int(np.diff(self._segments.starts).max(initial=1))
        following = rows[:, None] + np.arange(min(window.n_step, longest))
        inside, at = following < end, np.minimum(following, end - 1)
        if goals is None:
            brought = self.rewards[at], self.terminals[at], self.timeouts[at]
        else:
            assert window.goals is not None
            codes, held = self._segments.codes_held
            after, wanted = at + segments[:, None] + 1, codes[goals][:, None]
            shown = np.where((codes[after] == wanted) & (wanted >= 0), held[after], 0)
            success = Situation.reached(shown, self._segments.task.hold)
            rewards = success - float(window.goals.gc_negative)
            brought = rewards, success, (at == end - 1) & ~success
        return _returns(window.discount, *brought, self.pulls[at], inside)

    def _hindsight_rewards(self) -> Array:
        """Return the reward of the pull in each state of each segment, 0 in its last."""
        segments, task, lengths = self._segments, self._segments.task, self._segments.goal_step
        before = Episodes.ranges(segments.first, lengths)
        after, goal = before + 1, np.repeat(segments.first + lengths, lengths)
        codes, held = segments.episodes.codes_held(task)
        shown = np.where(codes[after] == codes[goal], held[after], 0)
        visits = segments.episodes.steps["visits"]
        # A segment ends at its goal: no state before is beyond the bound on towing or has failed.
        # Nor is any late, though of several datasets loaded as one the first says the horizon.
        count = np.minimum(Episodes.ranges(np.ones_like(lengths), lengths), task.horizon - 1)
        codes_of = {"visits": visits[after], "goal_visits": visits[goal]}
        seen = Situation(
            **codes_of, held=shown, hold=task.hold, steps=count, visits_before=visits[before]
        )
        rewards = np.zeros(len(after) + len(lengths))
        rows = np.arange(len(after)) + np.repeat(np.arange(len(lengths)), lengths)
        rewards[rows] = seen.outcome(task).rewards
        return rewards

    def _rewards_by(self, reward: Reward) -> Array:
        """Return the rewards that a user's function gives to the pulls of each episode."""
        episodes, steps = self._segments.episodes
        every = np.zeros(steps.rows)
        for number, first in enumerate(self._segments.episodes.offsets[:-1].tolist()):
            # copies: a function may change what it is given
            episode = {name: column[[number]][0] for name, column in episodes.items()}
            last = first + int(episode["length"])
            rewards = np.asarray(reward(episode, steps.take(np.arange(first, last + 1))))
            if rewards.shape != (last - first,) or rewards.dtype.kind not in "biuf":
                raise InvalidInput(
                    f"reward must return {last - first} numbers for an episode of as many pulls,"
                    f" got {rewards.dtype} of shape {rewards.shape}"
                )
            if len(wrong := np.flatnonzero(~np.isfinite(rewards))):
                raise InvalidInput(
                    f"reward must return finite numbers, got {rewards[wrong[0]]} in episode"
                    f" {number}, step {wrong[0]}"
                )
            every[first:last] = rewards
        return every


def _returns(
    discount: float,
    rewards: Array,
    terminals: NDArray[np.bool_],
    timeouts: NDArray[np.bool_],
    pulls: Ids,
    inside: NDArray[np.bool_],
) -> tuple[Ids, dict[str, NDArray[Any]]]:
    """Sum n windows of m transitions up to the first that ends an episode.

    Args:
        discount: per pull.
        rewards, terminals, timeouts, pulls: (n, m), of each transition.
        inside: bool (n, m), whether it belongs to the segment of the first; that one does.

    Returns:
        Transitions to the next observation, int64 (n,); and columns of a batch, (n,) each. Rewards
        are discounted sums, and there is a timeout where the window ended with the episode, which
        was truncated.
    """
    ends = terminals | timeouts
    ended_before = np.cumsum(ends, axis=1) - ends > 0
    taken = inside & ~ended_before
    lasting = np.where(taken, pulls, 0)
    elapsed = np.cumsum(lasting, axis=1)
    # r_i is discounted by the pulls before transition i
    factors = discount ** (elapsed - lasting).astype(np.float64)
    terminated = np.any(terminals & taken, axis=1)
    return taken.sum(axis=1), {
        "rewards": np.where(taken, rewards * factors, 0).sum(axis=1),
        "terminals": terminated,
        "timeouts": np.any(timeouts & taken, axis=1) & ~terminated,
        "discounts": np.where(terminated, 0, discount ** elapsed[:, -1].astype(np.float64)),
        "pulls": elapsed[:, -1],
    }
