"""A dataset as one long row of transitions: the small columns in memory, observations read or drawn when asked for.

Segments lie one after another: an episode as it was, or, with hindsight, the part of one that leads to a code it reached.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episodes import goal_steps


class Transitions:
    """N transitions in S segments; pickles, and reads from any process.

    Attributes:
        episode: int64 (S,), index in the dataset of the episode that a segment is of.
        goal_step: int64 (S,), which of its states is the goal, -1 where the goal is the episode's own.
        starts: int64 (S + 1,), the first transition of each segment, then N.
        actions: float32 (N, 6).
        rewards: float64 (N,).
        terminals, timeouts: bool (N,).
    """

    def __init__(self, dataset: Any, *, observation: str | None = None, picture: Any = None, relabel: str | None = None) -> None:
        """Read the small columns.

        Args:
            dataset: a Minari dataset's id or folder or `minari.MinariDataset`, or an episode file, compact or not.
            observation: "pixels", "state" or "both"; None for the environment's.
            picture: a `knotgym.picture.PictureConfig` to draw with; None for the environment's pictures.
            relabel: hindsight: None; "last": of each episode the part up to the last new code it reached, that code the goal;
                "all": one such part for every code it reached. An episode that shows no code but its first gives none.
        """
        self._reader = EpisodeReader(dataset)
        self._seen: dict[str, Any] = {"observation": observation or "", "picture": picture}
        task = self._reader.task
        parts: list[tuple[int, int]] = []
        columns: list[list[NDArray[Any]]] = []
        for index in range(len(self._reader)):
            own = [self._reader.column(index, name) for name in ("actions", "rewards", "terminations", "truncations")]
            if relabel is None:
                parts.append((index, -1))
                columns.append(own)
                continue
            for goal in goal_steps(self._reader.column(index, "gauss_code"), relabel, task.hold):
                end = np.arange(goal) == goal - 1
                parts.append((index, goal))
                columns.append([own[0][:goal], np.where(end, task.success_reward, 0.0), end, np.zeros(goal, dtype=bool)])
        self.episode, self.goal_step = np.array(parts, dtype=np.int64).reshape(-1, 2).T
        self.starts: NDArray[np.int64] = np.cumsum([0, *(len(part[0]) for part in columns)])
        empty = [np.empty((0, 6), np.float32), np.empty(0), np.empty(0, bool), np.empty(0, bool)]
        self.actions, self.rewards, self.terminals, self.timeouts = (np.concatenate(parts) for parts in zip(empty, *columns, strict=True))

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
        """Observations of the states [start, stop) of a segment of T transitions; its states are 0 to T.

        Returns:
            uint8 (n, size, 2 size, 3), float32 (n, 6 beads), or a dict of both.
        """
        last = int(self.starts[segment + 1] - self.starts[segment]) + 1
        goal = int(self.goal_step[segment])
        steps = slice(start, last if stop is None else min(stop, last))
        return self._reader.observations(int(self.episode[segment]), steps, goal_step=None if goal < 0 else goal, **self._seen)

    def codes(self, segment: int) -> list[str]:
        """The Gauss codes of a segment's T + 1 states."""
        codes: list[str] = self._reader.column(int(self.episode[segment]), "gauss_code").tolist()
        return codes[: int(self.starts[segment + 1] - self.starts[segment]) + 1]
