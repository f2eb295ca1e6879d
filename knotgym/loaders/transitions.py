"""A dataset as one long row of transitions.

Small columns are kept once they are read, observations are read or drawn when asked for. Segments
lie one after another: an episode as it was, or, with hindsight, the part of one that leads to a
code it reached.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.trajectory import codes_in_bounds, goal_steps
from knotgym.reward import success_at_last

_KEPT = 256  # segments whose codes are kept


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
        """
        self._reader = EpisodeReader(dataset)
        self._seen: dict[str, Any] = {"observation": observation or "", "picture": picture}
        self._relabelled = relabel is not None
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

    def columns(self, segment: int) -> Columns:
        """The small columns of a segment, read when first asked for and then kept."""
        if segment not in self._read:
            index, goal = int(self.episode[segment]), int(self.goal_step[segment])
            actions, *outcome = (
                self._reader.column(index, name)
                for name in ("actions", "rewards", "terminations", "truncations")
            )
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
        return self._reader.observations(
            int(self.episode[segment]), steps, goal_step=None if goal < 0 else goal, **self._seen
        )

    def codes(self, segment: int) -> list[str]:
        """The Gauss codes of a segment's T + 1 states; of the last segments asked for, kept."""
        if segment not in self._codes:
            if len(self._codes) == _KEPT:
                del self._codes[next(iter(self._codes))]
            codes = self._reader.column(int(self.episode[segment]), "gauss_code").tolist()
            self._codes[segment] = codes[: int(self.starts[segment + 1] - self.starts[segment]) + 1]
        return self._codes[segment]
