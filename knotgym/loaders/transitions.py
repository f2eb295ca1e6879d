"""A dataset as one long row of transitions.

Small columns are kept once they are read, observations are read or drawn when asked for. Segments
lie one after another: an episode as it was, or, with hindsight, the part of one that leads to a
code it reached.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.errors import KnotgymError
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.trajectory import codes_in_bounds, goal_steps
from knotgym.envs.reward import success_at_last
from knotgym.loaders.frame_cache import CachedFrames, FrameCache, NoCache, goal_axis

_KEPT = 256  # segments whose codes are kept


class NoLabels(KnotgymError, ValueError):
    """An expert's labels are asked for where there are none."""


class Columns(NamedTuple):
    """What is small of the T transitions of a segment: (T, 6), and (T,) each."""

    actions: NDArray[np.float32]
    rewards: NDArray[np.float64]
    terminals: NDArray[np.bool_]
    timeouts: NDArray[np.bool_]


class Transitions:
    """N transitions in S segments; pickles, and reads from any process.

    Columns are read when needed, so a million open at once.

    Attributes:
        episode: int64 (S,), index in the dataset of the episode that a segment is of.
        goal_step: int64 (S,), which of its states is the goal, -1 where the goal is the episode's
            own.
        starts: int64 (S + 1,), the first transition of each segment, then N.
        actions: float32 (N, 6).
        rewards: float64 (N,).
        terminals, timeouts: bool (N,).
    """

    def __init__(
        self,
        dataset: Any,
        *,
        observation: str | None = None,
        picture: Any = None,
        relabel: str | None = None,
        labels: bool = False,
        cache: Any = None,
    ) -> None:
        """Find the segments.

        Args:
            dataset: a Minari dataset's id or folder or `minari.MinariDataset`, or an episode file,
                compact or not.
            observation: "pixels", "state", "both" or "symbolic"; None for the environment's.
            picture: a `knotgym.rendering.picture.PictureConfig` to draw with; None for the
                environment's pictures.
            relabel: hindsight: None; "last": of each episode the part up to the last new code it
                reached, that code the goal; "all": one such part for every code it reached. An
                episode that shows no code but its first gives none.
            labels: actions are what an expert would have done (`collect --labels expert`), not what
                was done; so they don't lead to the next observation.
            cache: a folder, or a `FrameCache`, for pictures uncompressed; see `knotgym.loaders`.

        Raises:
            NoCache: no pictures are shown, or there is no room for them.
            NoLabels: labels are asked for with hindsight, or there are none.
        """
        self._reader = EpisodeReader(dataset)
        self._action_column = "expert_action" if labels else "actions"
        if labels and relabel is not None:
            raise NoLabels("an expert's labels lead to the episode's own goal: leave out relabel")
        if labels and not self._reader.has_expert_actions:
            raise NoLabels(
                f"{self._reader.path} has no expert's labels: collect it with --labels expert"
            )
        self._seen: dict[str, Any] = {"observation": observation or "", "picture": picture}
        self._relabelled = relabel is not None
        self._frames = None if cache is None else self._cached(cache)
        self._read: dict[int, Columns] = {}
        self._codes: dict[int, list[str]] = {}
        if relabel is None:
            parts = [(index, -1) for index in range(len(self._reader))]
            lengths = self._reader.lengths.tolist()
        else:
            hold = self._reader.task.hold
            shown = [self._codes_in_bounds(index) for index in range(len(self._reader))]
            parts = [
                (k, goal)
                for k, codes in enumerate(shown)
                for goal in goal_steps(codes, relabel, hold)
            ]
            lengths = [goal for _, goal in parts]
        self.episode, self.goal_step = np.array(parts, dtype=np.int64).reshape(-1, 2).T
        self.starts: NDArray[np.int64] = np.cumsum([0, *lengths])

    @property
    def _shown(self) -> str:
        """What is observed."""
        return str(self._seen["observation"] or self._reader.task.observation)

    @cached_property
    def actions(self) -> NDArray[np.float32]:
        """All of them."""
        return self._all(0, np.empty((0, 6), np.float32))

    @cached_property
    def rewards(self) -> NDArray[np.float64]:
        """All of them."""
        return self._all(1, np.empty(0))

    @cached_property
    def terminals(self) -> NDArray[np.bool_]:
        """All of them."""
        return self._all(2, np.empty(0, bool))

    @cached_property
    def timeouts(self) -> NDArray[np.bool_]:
        """All of them."""
        return self._all(3, np.empty(0, bool))

    def _cached(self, cache: Any) -> CachedFrames:
        if self._shown not in ("pixels", "both"):
            raise NoCache(
                f"a cache keeps pictures, and observation {self._shown!r} shows none: leave it out,"
                ' or ask for observation="pixels"'
            )
        if not isinstance(cache, FrameCache):
            cache = FrameCache(cache)
        return CachedFrames(self._reader, self._seen["picture"], cache)

    def columns(self, segment: int) -> Columns:
        """The small columns of a segment, read when first asked for and then kept."""
        if segment not in self._read:
            index, goal = int(self.episode[segment]), int(self.goal_step[segment])
            actions, *outcome = (
                self._reader.column(index, name)
                for name in (self._action_column, "rewards", "terminations", "truncations")
            )
            actions = actions[: len(outcome[0])]  # a label stands at the last state too
            if self._relabelled:
                actions = actions[:goal]
                outcome = list(success_at_last(goal, self._reader.task.success_reward))
            self._read[segment] = Columns(actions, *outcome)
        return self._read[segment]

    def _codes_in_bounds(self, index: int) -> NDArray[np.str_]:
        """The codes of an episode's states that may be goals."""
        codes, tow_limit = self._reader.column(index, "gauss_code"), self._reader.task.tow_limit
        if tow_limit is None:
            return codes
        return codes_in_bounds(codes, self._reader.column(index, "points"), tow_limit)

    def _all(self, column: int, empty: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate(
            [empty, *(self.columns(segment)[column] for segment in range(self.segments))]
        )

    def __len__(self) -> int:
        """N, the transitions."""
        return int(self.starts[-1])

    @property
    def segments(self) -> int:
        """S, the segments."""
        return len(self.episode)

    def place(self, transition: int) -> tuple[int, int]:
        """The segment a transition is in, and its step there."""
        segment = int(np.searchsorted(self.starts, transition, side="right")) - 1
        return segment, int(transition - self.starts[segment])

    def frame_place(self, frame: int) -> tuple[int, int]:
        """As `place`, of the N + S states that all the segments go through."""
        starts = self.starts + np.arange(self.segments + 1)
        segment = int(np.searchsorted(starts, frame, side="right")) - 1
        return segment, int(frame - starts[segment])

    def observations(self, segment: int, start: int = 0, stop: int | None = None) -> Any:
        """Observations of the states [start, stop), of 0 to T, of a segment of T transitions.

        Returns:
            uint8 (n, views * size, 2 size, 3 or 4), float32 (n, 6 beads), a dict of both, or int16
            (n, 2, symbols).
        """
        last = int(self.starts[segment + 1] - self.starts[segment]) + 1
        goal = int(self.goal_step[segment])
        steps = slice(start, last if stop is None else min(stop, last))
        episode, goal_step = int(self.episode[segment]), None if goal < 0 else goal
        if self._frames is None:
            return self._reader.observations(episode, steps, goal_step=goal_step, **self._seen)
        ropes = self._frames.offsets[episode] + np.arange(last)[steps]
        goals = self._frames.goal(self.episode[[segment]], self.goal_step[[segment]])
        pictures = self._frames.pictures(ropes, np.broadcast_to(goals, ropes.shape))
        if self._shown == "pixels":
            return pictures
        state = self._reader.observations(episode, steps, goal_step=goal_step, observation="state")
        return {"pixels": pictures, "state": state}

    def batch(self, rows: ArrayLike, *, apart: bool = False) -> dict[str, Any]:
        """Any n transitions, such as a random batch; with a `cache` of pictures, quickly.

        Args:
            rows: int (n,), which of the N.
            apart: rope and goal in arrays of their own, the goal, which is that of both states,
                once: less to copy by half.

        Returns:
            As `arrays`, n rows: observations, actions, rewards, next_observations, terminals,
            timeouts. With `apart` the observations are of the rope alone, uint8 (n, views * size,
            size, 3 or 4), float32 (n, 3 beads), a dict of both or int16 (n, 1, symbols), and goals
            are as they.

        Raises:
            IndexError: there is no such transition.
        """
        wanted = np.asarray(rows, dtype=np.int64)
        if wanted.ndim != 1 or not len(wanted):
            raise IndexError(f"a batch is of a list of transitions, at least one, got {rows!r}")
        if wanted.min() < -len(self) or wanted.max() >= len(self):
            raise IndexError(
                f"transitions {wanted.min()} to {wanted.max()} aren't all among {len(self)}"
            )
        wanted = wanted % len(self)
        seen = self._observed(wanted, apart)
        return {
            "observations": seen[0],
            "actions": self.actions[wanted],
            "rewards": self.rewards[wanted],
            "next_observations": seen[1],
            "terminals": self.terminals[wanted],
            "timeouts": self.timeouts[wanted],
            **({"goals": seen[2]} if apart else {}),
        }

    def _observed(self, wanted: NDArray[np.int64], apart: bool) -> tuple[Any, ...]:
        """Observations of both states of some transitions; and of their goals, if apart."""
        segments = np.searchsorted(self.starts, wanted, side="right") - 1
        steps = wanted - self.starts[segments]
        if self._frames is not None and self._shown == "pixels":
            episodes = self.episode[segments]
            ropes = self._frames.offsets[episodes] + steps
            goals = self._frames.goal(episodes, self.goal_step[segments])
            if apart:
                return tuple(self._frames.frames[rows] for rows in (ropes, ropes + 1, goals))
            return tuple(self._frames.pictures(rows, goals) for rows in (ropes, ropes + 1))
        pairs = [
            self.observations(segment, step, step + 2)
            for segment, step in zip(segments.tolist(), steps.tolist(), strict=True)
        ]
        if self._shown != "both":
            return self._states(self._shown, pairs, apart)
        each = [self._states(kind, [pair[kind] for pair in pairs], apart) for kind in pairs[0]]
        return tuple(dict(zip(pairs[0], kinds, strict=True)) for kinds in zip(*each, strict=True))

    def _states(self, kind: str, pairs: list[NDArray[Any]], apart: bool) -> tuple[Any, ...]:
        """Both states of n transitions, (n, ...) each, of n pairs of them."""
        both = np.stack(pairs)
        if not apart:
            return both[:, 0], both[:, 1]
        layout = goal_axis(self._reader.task.layout) if kind == "pixels" else 1
        rope, goal = np.split(both, 2, axis=layout + 1)
        return rope[:, 0], rope[:, 1], goal[:, 0]

    def codes(self, segment: int) -> list[str]:
        """The Gauss codes of a segment's T + 1 states; of the last segments asked for, kept."""
        if segment not in self._codes:
            if len(self._codes) == _KEPT:
                del self._codes[next(iter(self._codes))]
            codes = self._reader.column(int(self.episode[segment]), "gauss_code").tolist()
            self._codes[segment] = codes[: int(self.starts[segment + 1] - self.starts[segment]) + 1]
        return self._codes[segment]
