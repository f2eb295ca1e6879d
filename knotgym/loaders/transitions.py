"""Transitions of a dataset in batches, through windows of several steps and with sampled goals."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.errors import InvalidInput
from knotgym.datasets.episode_reader import goal_axis
from knotgym.loaders.frame_cache import CachedFrames, HeldVertices
from knotgym.loaders.segments import Segments
from knotgym.loaders.windows import Window, other_codes, returns


class Transitions(Segments):
    """The transitions of `Segments`, in batches."""

    def batch(
        self,
        rows: ArrayLike,
        *,
        apart: bool = False,
        rng: np.random.Generator | None = None,
    ) -> dict[str, Any]:
        """Return n transitions, such as a random batch.

        A `cache` of pictures makes this fast. Vertices are held in memory from the first batch on,
        if they take at most a gigabyte.

        Args:
            rows: int (n,), indices of transitions.
            apart: return rope and goal in separate arrays, the goal once for both states, which
                copies half as much.
            rng: generator of the goals, if the window samples them.

        Returns:
            As `arrays`, n rows: observations, actions, rewards, next_observations, terminals,
            timeouts, and what the window adds. With `apart` the observations are of the rope only,
            uint8 (n, views * size, size, 3 or 4), float32 (n, 3 beads), a dict of both, or int16
            (n, 1, symbols), and `goals` has the same shape.

        Raises:
            IndexError: rows is empty or not one-dimensional, or an index is out of range.
            InvalidInput: goals are sampled, and there is no generator; or no other goal exists.
            InvalidInput: halves of marked observations are needed, for `apart` or negatives.
        """
        wanted = np.asarray(rows, dtype=np.int64)
        if wanted.ndim != 1 or not len(wanted):
            raise IndexError(f"rows must be a list of at least one transition, got {rows!r}")
        if wanted.min() < -len(self) or wanted.max() >= len(self):
            raise IndexError(
                f"indices {wanted.min()} to {wanted.max()} are outside a dataset of {len(self)}"
            )
        return self.gather(wanted % len(self), apart=apart, rng=rng)

    def sample_goals(self, rows: ArrayLike, rng: np.random.Generator) -> NDArray[np.int64]:
        """Draw the goals of transitions, as `batch` does first with the same generator.

        Returns:
            int64 (n,), indices of the N + S states of all segments, see `frame_place`.

        Raises:
            InvalidInput: the window samples no goals.
        """
        if self.window is None or self.window.goals is None:
            raise InvalidInput("there are no goals to sample: open with window=Window(goals=...)")
        wanted = np.asarray(rows, dtype=np.int64)
        segments = self._segments(wanted)
        last = self.starts[segments + 1] + segments
        return self.window.goals.draw(
            wanted + segments, last, len(self._step_of), self.window.discount, rng
        )

    def outcomes(
        self, rows: NDArray[np.int64], n_step: int, goals: NDArray[np.int64] | None = None
    ) -> tuple[NDArray[Any], ...]:
        """Return what happened in n_step transitions from each of n on.

        Args:
            rows: (n,), the first transitions.
            n_step: how many from each.
            goals: (n,), states that are their goals; None for those of the segments.

        Returns:
            rewards, terminals, timeouts, pulls, and whether the transition belongs to the segment,
            (n, n_step) each.
        """
        end = self.starts[self._segments(rows) + 1][:, None]
        following = rows[:, None] + np.arange(n_step)
        inside = following < end
        at = np.minimum(following, end - 1)
        if goals is None:
            ends = self.terminals[at], self.timeouts[at]
            return self.rewards[at], *ends, self.pulls[at], inside
        assert self.window is not None and self.window.goals is not None
        codes, held = self._codes_held
        after = at + self._segments(rows)[:, None] + 1
        wanted = codes[goals][:, None]
        success = (codes[after] == wanted) & (wanted >= 0) & (held[after] >= self._reader.task.hold)
        rewards = success - float(self.window.goals.gc_negative)
        return rewards, success, (at == end - 1) & ~success, self.pulls[at], inside

    def _segments(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.searchsorted(self.starts, rows, side="right") - 1

    def gather(
        self,
        rows: NDArray[np.int64],
        *,
        apart: bool = False,
        rng: np.random.Generator | None = None,
    ) -> dict[str, Any]:
        """Return what `batch` does, for any number of rows in [0, N), which aren't checked."""
        window = self.window or Window()
        halved = apart or (window.goals is not None and window.goals.negatives)
        if halved and self._shown == "marked":
            raise InvalidInput(
                "a marked observation has no halves: its frame depends on rope and goal; choose"
                " observation 'pixels', 'state', 'both' or 'symbolic', or leave out apart and"
                " negatives"
            )
        segments, goals = self._segments(rows), None
        if window.goals is not None:
            if rng is None:
                raise InvalidInput("goals are drawn: hand a generator in, batch(rows, rng=...)")
            goals = self.sample_goals(rows, rng)
        found = returns(window.discount, *self.outcomes(rows, window.n_step, goals))
        states = rows + segments
        seen = self._observed(
            [self._stack(states, segments), self._stack(states + found.steps, segments)],
            goals,
            apart,
        )
        batch = {
            "observations": seen[0],
            "actions": self.actions[rows],
            "rewards": found.rewards,
            "next_observations": seen[1],
            "terminals": found.terminals,
            "timeouts": found.timeouts,
            **({"goals": seen[2]} if apart else {}),
        }
        if self.window is None:
            return batch
        batch |= {"discounts": found.discounts, "pulls": found.pulls}
        if window.chunk is not None:
            following = rows[:, None] + np.arange(window.chunk)
            kept = following < self.starts[segments + 1][:, None]
            batch["actions"], batch["action_mask"] = _masked(self.actions, following, kept), kept
        if window.history is not None:
            for name, ends in (("", rows), ("next_", rows + found.steps)):
                past = ends[:, None] + np.arange(-window.history, 0)
                kept = past >= self.starts[segments][:, None]
                batch[f"{name}history"] = _masked(self._taken, past, kept)
                batch[f"{name}history_mask"] = kept
        if goals is not None and window.goals is not None and window.goals.negatives:
            codes = self._codes_held[0]
            assert rng is not None
            others = other_codes(codes, codes[goals], window.goals.negatives, rng)
            (flat, _) = self._observed([others.ravel()], None, apart=True)
            batch["negatives"] = _each(flat, lambda one: one.reshape(*others.shape, *one.shape[1:]))
        return batch

    def _stack(self, states: NDArray[np.int64], segments: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the states that are shown at each of n states: (n,), or (n, stack)."""
        if self.window is None or self.window.stack is None:
            return states
        first = self.starts[segments] + segments
        return np.maximum(states[:, None] + np.arange(1 - self.window.stack, 1), first[:, None])

    def _observed(
        self, shown: list[NDArray[np.int64]], goals: NDArray[np.int64] | None, apart: bool
    ) -> list[Any]:
        """Return the observations of n transitions.

        Args:
            shown: states, (n,) or (n, k) each; those of a row belong to one segment.
            goals: (n,), states; None for the goals of the segments.
            apart: return ropes only, and the goals (n,) after them.
        """
        first = shown[0] if shown[0].ndim == 1 else shown[0][:, 0]
        segments = self._segment_of[first]
        if goals is None:
            goal = self.episode[segments], self.goal_step[segments]
        else:
            goal = self.episode[self._segment_of[goals]], self._step_of[goals]
        frames = {"pixels": self._frames, "state": self._vertices}.get(self._shown)
        if frames is not None and len(first):
            return self._gathered(frames, shown, frames.goal(*goal), apart)
        filled: dict[str, list[NDArray[Any]]] = {}
        # rows with the same segment and goal are read at once, each state once
        alike = segments if goals is None else segments * len(self._step_of) + goals
        order = np.argsort(alike, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(alike[order])) + 1):
            if not len(rows):  # of an empty dataset
                break
            segment = int(segments[rows[0]])
            own = goal[0][rows[0]], goal[1][rows[0]]
            parts = [one[rows] for one in shown]
            states, where = np.unique(
                np.concatenate([one.ravel() for one in parts]), return_inverse=True
            )
            places = np.split(where, np.cumsum([one.size for one in parts])[:-1])
            target = None if own[1] < 0 else (int(own[0]), int(own[1]))
            seen = self._read_states(segment, self._step_of[states], target)
            for name, array in {"": seen}.items() if not isinstance(seen, dict) else seen.items():
                halves = self._halves(name, array) if apart else [array]
                if name not in filled:
                    filled[name] = [
                        np.empty((*one.shape, *halves[0].shape[1:]), halves[0].dtype)
                        for one in (*shown, *([segments] if apart else []))
                    ]
                for out, part, place in zip(filled[name], parts, places, strict=False):
                    out[rows] = halves[0][place].reshape(*part.shape, *halves[0].shape[1:])
                if apart:
                    filled[name][-1][rows] = halves[1][0]
        if [*filled] in ([], [""]):
            return filled.get("", [{}, {}, {}])
        return [dict(zip(filled, each, strict=True)) for each in zip(*filled.values(), strict=True)]

    @cached_property
    def _vertices(self) -> HeldVertices | None:
        held = HeldVertices(self._reader)
        return held if held.fits else None

    def _gathered(
        self,
        frames: CachedFrames | HeldVertices,
        shown: list[NDArray[np.int64]],
        goals: NDArray[np.int64],
        apart: bool,
    ) -> list[NDArray[Any]]:
        """Gather what `_observed` returns from the frames of states and goals."""
        offsets = frames.offsets[self.episode]
        ropes = [offsets[self._segment_of[one]] + self._step_of[one] for one in shown]
        seen: list[NDArray[Any]] = []
        for one in (*ropes, goals) if apart else ropes:
            # along one axis, which NumPy copies many times faster than along two
            flat = one.ravel()
            if apart:
                taken = frames.frames[flat]
            else:
                taken = frames.joined(flat, np.repeat(goals, flat.size // len(goals)))
            seen.append(taken.reshape(*one.shape, *taken.shape[1:]))
        return seen

    def _halves(self, name: str, seen: NDArray[Any]) -> list[NDArray[Any]]:
        """Split observations into rope and goal."""
        pixels = (name or self._shown) == "pixels"
        return np.split(seen, 2, axis=goal_axis(self._reader.task.layout) if pixels else 1)


def _masked(
    actions: NDArray[Any], rows: NDArray[np.int64], kept: NDArray[np.bool_]
) -> NDArray[Any]:
    """Gather actions; those not kept are zeros."""
    found = actions[np.where(kept, rows, 0)]
    found[~kept] = 0
    return found


def _each(seen: Any, change: Callable[[NDArray[Any]], Any]) -> Any:
    """Apply a function to an observation's array, or to each of its arrays."""
    if isinstance(seen, dict):
        return {name: change(array) for name, array in seen.items()}
    return change(seen)
