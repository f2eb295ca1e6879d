"""Transitions of a dataset in batches, through windows of several steps and with sampled goals.

Which stretches of episodes they are taken from is in `segments`, what they brought in `outcomes`.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Ids, InvalidInput
from knotgym.datasets import columns_of
from knotgym.envs import TaskConfig
from knotgym.loaders.drawn_frames import DrawnFrames
from knotgym.loaders.items import rows_at
from knotgym.loaders.outcomes import Outcomes, Reward
from knotgym.loaders.segments import Segments
from knotgym.loaders.windows import GoalSampling, Window
from knotgym.rope import VIEWS, Taken

_VIEWS = "observation", "action", "frame"  # that a loader may choose


class Opening(TypedDict, total=False):
    """The keywords of every loader, all None or False by default.

    Attributes:
        observation: "pixels", "state", "both", "symbolic" or "marked"; None for the
            environment's.
        picture: a `knotgym.rendering.camera.PictureConfig` to render with; None for the
            environment's pictures.
        action: "pull", "bead", "macro" or "decision"; None for the environment's.
        frame: "world", or "canonical" for actions and vertices in the rope's own frame, see
            `TaskConfig`; None for the environment's. Actions are in the frame of the state in
            which they begin.
        relabel: None for episodes as they are. "last": the goal becomes the last new code that
            an episode reached, and the episode ends there. "all": one such segment for every
            code that it reached. An episode that never leaves its first code gives none.
        labels: use the actions that an expert would have taken (`collect --set labels=expert`)
            instead of those taken; they don't lead to the next observation.
        cache: a folder to keep uncompressed pictures in; see `knotgym.loaders`.
        window: steps, chunks, stacks, histories and sampled goals of `batch`; None for single
            transitions.
        reward: a function of an episode, as a dict of its row of the table of episodes, and of
            its T + 1 rows of steps, that returns the rewards (T,) of its pulls; None for those
            of the dataset. Ends stay as they are.
    """

    observation: str | None
    picture: Any
    action: str | None
    frame: str | None
    relabel: str | None
    labels: bool
    cache: Any
    window: Window | None
    reward: Reward | None


class Transitions(Outcomes):
    """N transitions in S segments. Can be pickled, and read from any process.

    Opening maps the columns and reads hardly any of them; only relabel reads all codes.

    In the views "macro" and "decision" a transition is a macro-action. It leads from the state in
    which the macro-action began to that in which the next one began, or to the segment's last; its
    reward is the sum over the pulls between. States before the first macro-action are left out, and
    so are segments without any.

    Attributes:
        dataset: the columns.
        task: the environment of the dataset.
        episode: int64 (S,), index of the segment's episode in the dataset.
        goal_step: int64 (S,), which state of the episode is the goal; -1 for the episode's own
            goal.
        starts: int64 (S + 1,), the first transition of each segment, then N.
        action, frame: view and frame of the actions, see `knotgym.rope.action_views`.
        leads: whether an action is several pulls of a bead, "macro" or "decision".
        window: steps, chunks, stacks, histories and sampled goals of `batch`.
    """

    def __init__(self, dataset: Any, **opening: Unpack[Opening]) -> None:
        """Open a dataset.

        Args:
            dataset: id or folder of a Minari dataset, `minari.MinariDataset`, or an episode file.
            opening: see `Opening`.

        Raises:
            InvalidInput: these settings don't go together, or the dataset lacks what they need.
            MissingFile, InvalidFile: there is no such dataset, or it is damaged.
        """
        known = Opening.__annotations__
        if unknown := opening.keys() - known.keys():
            raise InvalidInput(f"no argument {min(unknown)!r}; there is {', '.join(known)}")
        self.dataset = columns_of(dataset)
        self._opening, self.task = opening, self.dataset.task
        self.window, self._reward = opening.get("window"), opening.get("reward")
        views: dict[str, Any] = {
            name: opening.get(name) or getattr(self.task, name) for name in _VIEWS
        }
        seen = replace(self.task, **views)
        self.action, self.frame = seen.action, seen.frame
        self._view = VIEWS[self.action]
        self.leads = self._view.leads  # a transition is a macro-action
        relabel = opening.get("relabel")
        self._labels, self._relabelled = opening.get("labels", False), relabel is not None
        self._check(seen)
        picture, cache = opening.get("picture"), opening.get("cache")
        self._frames = DrawnFrames(self.dataset, seen, picture, cache)
        segments = Segments(self.dataset.episodes, self.task, relabel, leads=self.leads)
        super().__init__(segments, self._reward)
        self.episode, self.goal_step = segments.episode, segments.goal_step
        self.starts = segments.starts

    def _check(self, seen: TaskConfig) -> None:
        """Refuse settings that don't go together or that the dataset has no columns for."""
        steps, path = self.dataset.episodes.steps, self.dataset.path
        window = Window() if self.window is None else self.window
        if not isinstance(window, Window):
            raise InvalidInput(f"window must be such as Window(n_step=5), got {window!r}")
        goals, chunk = window.goals is not None, window.chunk is not None
        labels, relabelled = self._labels, self._relabelled
        if self.leads and labels:
            why = f"the expert's actions are pulls: use labels without action {self.action!r}"
        elif self.leads and "macro_start" not in steps:
            why = (
                f"{path} doesn't record macro-actions: use action 'pull' or 'bead', or collect it"
                " with a policy that acts in macro-actions"
            )
        elif (seen.is_canonical or self._view.relative) and (chunk or window.history is not None):
            why = (
                "actions that follow one another are seen from where each begins: leave out chunk"
                " and history, or use frame 'world' and another action than 'decision'"
            )
        elif labels and relabelled:
            why = "the expert's actions lead to the episode's own goal: use labels without relabel"
        elif labels and "expert_action" not in steps:
            why = f"{path} has no expert actions: collect it with --set labels=expert"
        elif labels and np.isnan(steps["expert_action"]).any():
            why = f"{path} has states without expert actions, of sets that were collected without"
        elif goals and (labels or relabelled):
            why = "sampled goals replace the episodes': leave out relabel and labels"
        elif chunk and labels:
            why = "the expert's actions don't follow one another: leave out chunk"
        elif self._reward is not None and (goals or relabelled):
            why = "other goals bring their own rewards: leave out reward"
        else:
            return
        raise InvalidInput(why)

    def __reduce__(self) -> Any:
        """Pickle what was opened, so that each process maps the file itself."""
        return partial(Transitions, self.dataset, **self._opening), ()

    def __len__(self) -> int:
        """N, the transitions."""
        return int(self.starts[-1])

    @property
    def segments(self) -> int:
        """S, the segments."""
        return len(self.episode)

    @cached_property
    def actions(self) -> NDArray[Any]:
        """float32 (N, 6) or (N, 43); in other views int64 (N, 4) or (N, 3); see `batch`."""
        return self._view.stored(self._taken_as("expert_action" if self._labels else "action"))

    @cached_property
    def _taken(self) -> NDArray[Any]:
        """The actions that were taken, where `actions` are the expert's."""
        return self._view.stored(self._taken_as("action")) if self._labels else self.actions

    def seen_actions(self, rows: Ids, goals: Ids | None = None) -> dict[str, NDArray[Any]]:
        """Return the actions of transitions in the frames of their first states.

        Args:
            rows: (n,), transitions.
            goals: (n,), the frames that show their goals; None for those of their segments.

        Returns:
            actions, and for decisions beads int64 (n,) and whole bool (n,), see `arrays`.
        """
        actions = self.actions[rows]
        if not (self._frames.task.is_canonical or self._view.relative):
            return {"actions": actions}
        goals = self._goals(self._segments.of(rows)) if goals is None else goals
        taken = self._taken_as("action", rows)
        seen = self._view.seen
        assert seen is not None  # `TaskConfig` refuses such a frame
        return seen(self._frames.frames_of(taken.before, goals), taken, actions)

    def _taken_as(self, name: str, rows: Any = slice(None)) -> Taken:
        segments, reach = self._segments, self.task.rope_config.reach
        before, after = segments.before[rows], segments.after[rows]
        return Taken(segments.episodes.steps, before, after, name, reach)

    def observations(self, segment: int, start: int = 0, stop: int | None = None) -> Any:
        """Return the observations of the states [start, stop) of a segment with T transitions.

        There are T + 1; see `Transitions` for those of the view "macro".

        Returns:
            uint8 (n, views * size, 2 size, 3 or 4), float32 (n, 6 beads), a dict of both, int16
            (n, 2, symbols), or float32 (n, marked.size(beads)).
        """
        first, last = self.starts[segment : segment + 2] + (segment, segment + 1)
        shown = self._segments.states[first:last][start:stop]
        goals = np.repeat(self._goals(np.array([segment])), len(shown))
        return self._frames.observe([shown], goals)[0]

    def _goals(self, segments: Ids) -> Ids:
        """Return the frames of segments' goals."""
        episode, step = self.episode[segments], self.goal_step[segments]
        reached = self.dataset.episodes.offsets[episode] + step
        return np.where(step < 0, self._frames.goals(episode), reached)

    def batch(
        self, rows: ArrayLike, *, apart: bool = False, rng: np.random.Generator | None = None
    ) -> dict[str, Any]:
        """Return n transitions, such as a random batch.

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
            IndexError: rows is not one-dimensional, isn't of whole numbers, such as a mask, or
                an index is out of range.
            InvalidInput: goals are sampled, and there is no generator; or no other goal exists.
            InvalidInput: halves of marked observations are needed, for `apart` or negatives.
        """
        rows = rows_at(np.asarray(rows), len(self), several=True)
        return self._batch(rows, apart, *self._drawn(rows, rng))

    def blocks(
        self, size: int, rng: np.random.Generator | None
    ) -> Iterator[tuple[slice, dict[str, Any]]]:
        """Yield all transitions in batches, as `batch` of all at once; where none are, one batch.

        Args:
            size: transitions of a batch, on which nothing that is drawn depends.
            rng: generator of the goals, if the window samples them.
        """
        rows = np.arange(len(self))
        drawn = self._drawn(rows, rng)
        for first in range(0, max(1, len(rows)), size):
            some = slice(first, min(first + size, len(rows)))
            parts = (None if rows_drawn is None else rows_drawn[some] for rows_drawn in drawn)
            yield some, self._batch(rows[some], False, *parts)

    def _drawn(
        self, rows: Ids, rng: np.random.Generator | None
    ) -> tuple[Ids | None, NDArray[np.int64] | None]:
        """Draw the goals of transitions and the negatives: (n,) and (n, negatives), or None."""
        goals = self.window.goals if self.window else None
        if goals is None:
            return None, None
        if rng is None:
            raise InvalidInput("goals are drawn: hand a generator in, batch(rows, rng=...)")
        sampled = self._sampled_goals(rows, goals, rng)
        if not goals.negatives:
            return sampled, None
        codes = self._segments.codes_held[0]
        return sampled, _other_codes(codes, codes[sampled], goals.negatives, rng)

    def _batch(
        self, rows: Ids, apart: bool, sampled: Ids | None, others: Ids | None
    ) -> dict[str, Any]:
        window, segments = self.window or Window(), self._segments.of(rows)
        goals = self._goals(segments) if sampled is None else self._segments.states[sampled]
        steps, outcomes = self._of_window(rows, window, sampled)
        states = rows + segments
        ends = (states, states + steps)
        shown = [self._segments.states[self._stack(end, segments)] for end in ends]
        alone, observe = self._frames.alone, self._frames.observe
        seen = alone([*shown, goals]) if apart else observe(shown, goals)
        batch = {
            "observations": seen[0],
            **self.seen_actions(rows, goals),
            "rewards": outcomes.pop("rewards"),
            "next_observations": seen[1],
            "terminals": outcomes.pop("terminals"),
            "timeouts": outcomes.pop("timeouts"),
            **({"goals": seen[2]} if apart else {}),
        }
        if self.window is None:
            return batch
        batch |= outcomes  # discounts and pulls
        if window.chunk is not None:
            following = rows[:, None] + np.arange(window.chunk)
            kept = following < self.starts[segments + 1][:, None]
            batch["actions"], batch["action_mask"] = _masked(self.actions, following, kept), kept
        if window.history is not None:
            for name, end in (("", rows), ("next_", rows + steps)):
                past = end[:, None] + np.arange(-window.history, 0)
                kept = past >= self.starts[segments][:, None]
                batch[f"{name}history"] = _masked(self._taken, past, kept)
                batch[f"{name}history_mask"] = kept
        if others is not None:
            batch["negatives"] = self._frames.alone([self._segments.states[others]])[0]
        return batch

    def _sampled_goals(self, rows: Ids, goals: GoalSampling, rng: np.random.Generator) -> Ids:
        """Draw the goals of transitions: (n,), indices of the N + S states of all segments."""
        segments = self._segments.of(rows)
        last = self.starts[segments + 1] + segments
        discount = (self.window or Window()).discount
        return goals.draw(rows + segments, last, len(self._segments.states), discount, rng)

    def _stack(self, states: Ids, segments: Ids) -> Ids:
        """Return the states that are shown at each of n states: (n,), or (n, stack)."""
        if self.window is None or self.window.stack is None:
            return states
        first = self.starts[segments] + segments
        return np.maximum(states[:, None] + np.arange(1 - self.window.stack, 1), first[:, None])


def _masked(actions: NDArray[Any], rows: Ids, kept: NDArray[np.bool_]) -> NDArray[Any]:
    """Gather actions; those not kept are zeros."""
    gathered = actions[np.where(kept, rows, 0)]
    gathered[~kept] = 0
    return gathered


def _other_codes(codes: Ids, avoided: Ids, count: int, rng: np.random.Generator) -> Ids:
    """Draw, for each of n codes, `count` states with other codes, uniformly.

    Args:
        codes: (m,), the code of each state, as a number.
        avoided: (n,), the codes to avoid, each one of `codes`.
        count: states to draw for each.

    Returns:
        (n, count), indices of states.

    Raises:
        InvalidInput: all states have the same code.
    """
    order = np.argsort(codes, kind="stable")
    low, high = (np.searchsorted(codes[order], avoided, side) for side in ("left", "right"))
    left = len(codes) - (high - low)
    if (left == 0).any():
        raise InvalidInput("negatives need a dataset with two Gauss codes or more, got one")
    drawn = rng.integers(left[:, None], size=(len(avoided), count))
    # in sorted order the states with the code itself are the range [low, high), stepped over here
    return order[drawn + np.where(drawn >= low[:, None], (high - low)[:, None], 0)]
