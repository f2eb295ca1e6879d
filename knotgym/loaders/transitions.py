"""Transitions of a dataset in batches, through windows of several steps and with sampled goals; and
stretches of consecutive states, straight from the columns, for models of sequences.

A segment is a whole episode or, with hindsight relabelling, the start of an episode up to a code
that it reached. All of it is index arithmetic on the columns of the dataset:

    states         N + S of them: the states of all segments, one after the other; `_states` has
                   the row of steps of each
    transition t   of segment s leads from state t + s to state t + s + 1
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array, Ids, InvalidInput, Table
from knotgym.datasets import Episodes, columns_of
from knotgym.envs import Situation, TaskConfig
from knotgym.loaders.drawn_frames import DrawnFrames
from knotgym.loaders.items import Index, rows_at
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
    reward: Callable[[dict[str, Any], Table], ArrayLike] | None


class Transitions:
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
        episodes = self.dataset.episodes
        if relabel is None:
            self.episode, lengths = np.arange(episodes.episodes.rows), episodes.episodes["length"]
            self.goal_step = np.full(len(lengths), -1)
        else:
            self.episode, lengths = episodes.goals_reached(self.task, relabel)
            self.goal_step = lengths
        self._offsets = episodes.offsets
        first = self._offsets[self.episode]
        counts, states = lengths, Episodes.ranges(first, lengths + 1)
        if self.leads:
            # transitions begin where macro-actions do; the last state of a segment ends the last
            begun = np.flatnonzero(episodes.steps["macro_start"])
            at, end = np.searchsorted(begun, first), np.searchsorted(begun, first + lengths)
            kept, counts = end > at, (end - at)[end > at]
            self.episode, self.goal_step = self.episode[kept], self.goal_step[kept]
            states = np.append(begun, 0)[Episodes.ranges(at[kept], counts + 1)]
            states[np.cumsum(counts + 1) - 1] = (first + lengths)[kept]
        self.starts: Ids = np.concatenate([[0], np.cumsum(counts)])
        self._states = states

    def _check(self, seen: TaskConfig) -> None:
        """Refuse settings that don't go together or that the dataset has no columns for."""
        steps, window, path = self.dataset.episodes.steps, self.window, self.dataset.path
        if window is not None and not isinstance(window, Window):
            raise InvalidInput(f"window must be such as Window(n_step=5), got {window!r}")
        goals = window is not None and window.goals is not None
        chunk = window is not None and window.chunk is not None
        refusals = {
            f"the expert's actions are pulls: use labels without action {self.action!r}": (
                self.leads and self._labels
            ),
            f"{path} doesn't record macro-actions: use action 'pull' or 'bead', or collect it with"
            " a policy that acts in macro-actions": self.leads and "macro_start" not in steps,
            "actions that follow one another are seen from where each begins: leave out chunk and"
            " history, or use frame 'world' and another action than 'decision'": (
                (seen.is_canonical or self._view.relative)
                and (chunk or (window is not None and window.history is not None))
            ),
            "the expert's actions lead to the episode's own goal: use labels without relabel": (
                self._labels and self._relabelled
            ),
            f"{path} has no expert actions: collect it with --set labels=expert": (
                self._labels and "expert_action" not in steps
            ),
            f"{path} has states without expert actions, of sets that were collected without": (
                self._labels and bool(np.isnan(steps.get("expert_action", 0.0)).any())
            ),
            "sampled goals replace the episodes': leave out relabel and labels": (
                goals and (self._labels or self._relabelled)
            ),
            "the expert's actions don't follow one another: leave out chunk": (
                chunk and self._labels
            ),
            "other goals bring their own rewards: leave out reward": (
                self._reward is not None and (goals or self._relabelled)
            ),
        }
        for refusal, refused in refusals.items():
            if refused:
                raise InvalidInput(refusal)

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
    def _before(self) -> Ids:
        """The row of steps that each transition begins in: (N,)."""
        return self._states[np.arange(len(self)) + self._segments(np.arange(len(self)))]

    @cached_property
    def _after(self) -> Ids:
        """The row of steps that each transition ends in: (N,)."""
        return self._states[np.arange(len(self)) + self._segments(np.arange(len(self))) + 1]

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
        goals = self._goals(self._segments(rows)) if goals is None else goals
        taken = self._taken_as("action", rows)
        seen = self._view.seen
        assert seen is not None  # `TaskConfig` refuses such a frame
        return seen(self._frames.frames_of(taken.before, goals), taken, actions)

    def _taken_as(self, name: str, rows: Any = slice(None)) -> Taken:
        reach = self.task.rope_config.reach
        return Taken(
            self.dataset.episodes.steps, self._before[rows], self._after[rows], name, reach
        )

    @cached_property
    def rewards(self) -> Array:
        """float64 (N,)."""
        rewards, before, after = self._pull_rewards(), self._before, self._after
        if self._relabelled:
            # segments of one episode share its rows, so each gets rows of its own
            first = self._offsets[self.episode]
            own = np.cumsum(self.goal_step + 1) - (self.goal_step + 1) - first
            shift = np.repeat(own, np.diff(self.starts))
            before, after = before + shift, after + shift
        if not self.leads:
            return rewards[before]
        between = np.stack([before, after], axis=1).ravel()
        return np.add.reduceat(rewards, between)[::2] if len(between) else np.zeros(0)

    def _hindsight_rewards(self) -> Array:
        """Return the reward of the pull in each state of each segment, 0 in its last."""
        steps, lengths = self.dataset.episodes.steps, self.goal_step
        before = Episodes.ranges(self._offsets[self.episode], lengths)
        after, goal = before + 1, np.repeat(self._offsets[self.episode] + lengths, lengths)
        codes, held = self.dataset.episodes.codes_held(self.task)
        shown = np.where(codes[after] == codes[goal], held[after], 0)
        count, visits = Episodes.ranges(np.ones_like(lengths), lengths), steps["visits"]
        # A segment ends at its goal: no state before is beyond the bound on towing or has failed.
        # Nor is any late, though of several datasets loaded as one the first says the horizon.
        count = np.minimum(count, self.task.horizon - 1)
        codes_of = {"visits": visits[after], "goal_visits": visits[goal]}
        seen = Situation(
            **codes_of, held=shown, hold=self.task.hold, steps=count, visits_before=visits[before]
        )
        found = np.zeros(len(after) + len(lengths))
        rows = np.arange(len(after)) + np.repeat(np.arange(len(lengths)), lengths)
        found[rows] = seen.outcome(self.task).rewards
        return found

    def _pull_rewards(self) -> Array:
        """Return the reward of the pull in each row of steps, or in each state of all segments."""
        if self._relabelled:
            return self._hindsight_rewards()
        episodes, steps = self.dataset.episodes
        if self._reward is None:
            return steps["reward"]
        found = np.zeros(steps.rows)
        for number, first in enumerate(self._offsets[:-1].tolist()):
            # copies: a function may change what it is given
            own = {name: column[[number]][0] for name, column in episodes.items()}
            last = first + int(own["length"])
            rewards = np.asarray(self._reward(own, steps.take(np.arange(first, last + 1))))
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
            found[first:last] = rewards
        return found

    @cached_property
    def terminals(self) -> NDArray[np.bool_]:
        """bool (N,), true where an episode terminated."""
        if self._relabelled:
            return np.isin(np.arange(len(self)), self.starts[1:] - 1)
        return self.dataset.episodes.steps["terminated"][self._after - 1]

    @cached_property
    def timeouts(self) -> NDArray[np.bool_]:
        """bool (N,), true where an episode was truncated."""
        if self._relabelled:
            return np.zeros(len(self), dtype=bool)
        return self.dataset.episodes.steps["truncated"][self._after - 1]

    @cached_property
    def pulls(self) -> Ids:
        """int64 (N,), pulls of each transition: 1 unless they are macro-actions."""
        return self._after - self._before

    def observations(self, segment: int, start: int = 0, stop: int | None = None) -> Any:
        """Return the observations of the states [start, stop) of a segment with T transitions.

        There are T + 1; see `Transitions` for those of the view "macro".

        Returns:
            uint8 (n, views * size, 2 size, 3 or 4), float32 (n, 6 beads), a dict of both, int16
            (n, 2, symbols), or float32 (n, marked.size(beads)).
        """
        first, last = self.starts[segment : segment + 2] + (segment, segment + 1)
        shown = self._states[first:last][start:stop]
        goals = np.repeat(self._goals(np.array([segment])), len(shown))
        return self._frames.observe([shown], goals)[0]

    def _goals(self, segments: Ids) -> Ids:
        """Return the frames of segments' goals."""
        episode, step = self.episode[segments], self.goal_step[segments]
        reached = self._offsets[episode] + step
        return np.where(step < 0, self._frames.goals(episode), reached)

    def _segments(self, rows: Ids) -> Ids:
        return np.searchsorted(self.starts, rows, side="right") - 1

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
            own = (None if one is None else one[some] for one in drawn)
            yield some, self._batch(rows[some], False, *own)

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
        codes = self._codes_held[0]
        return sampled, _other_codes(codes, codes[sampled], goals.negatives, rng)

    def _batch(
        self, rows: Ids, apart: bool, sampled: Ids | None, others: Ids | None
    ) -> dict[str, Any]:
        window, segments = self.window or Window(), self._segments(rows)
        goals = self._goals(segments) if sampled is None else self._states[sampled]
        steps, found = _returns(window.discount, *self._outcomes(rows, window.n_step, sampled))
        states = rows + segments
        ends = (states, states + steps)
        shown = [self._states[self._stack(one, segments)] for one in ends]
        alone, observe = self._frames.alone, self._frames.observe
        seen = alone([*shown, goals]) if apart else observe(shown, goals)
        batch = {
            "observations": seen[0],
            **self.seen_actions(rows, goals),
            "rewards": found.pop("rewards"),
            "next_observations": seen[1],
            "terminals": found.pop("terminals"),
            "timeouts": found.pop("timeouts"),
            **({"goals": seen[2]} if apart else {}),
        }
        if self.window is None:
            return batch
        batch |= found  # discounts and pulls
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
            batch["negatives"] = self._frames.alone([self._states[others]])[0]
        return batch

    def _sampled_goals(self, rows: Ids, goals: GoalSampling, rng: np.random.Generator) -> Ids:
        """Draw the goals of transitions: (n,), indices of the N + S states of all segments."""
        segments = self._segments(rows)
        last = self.starts[segments + 1] + segments
        discount = (self.window or Window()).discount
        return goals.draw(rows + segments, last, len(self._states), discount, rng)

    def _outcomes(
        self, rows: Ids, n_step: int, goals: Ids | None = None
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
        segments = self._segments(rows)
        end = self.starts[segments + 1][:, None]
        longest = int(np.diff(self.starts).max(initial=1))
        following = rows[:, None] + np.arange(min(n_step, longest))
        inside = following < end
        at = np.minimum(following, end - 1)
        if goals is None:
            ends = self.terminals[at], self.timeouts[at]
            return self.rewards[at], *ends, self.pulls[at], inside
        assert self.window is not None and self.window.goals is not None
        codes, held = self._codes_held
        after = at + segments[:, None] + 1
        wanted = codes[goals][:, None]
        shown = np.where((codes[after] == wanted) & (wanted >= 0), held[after], 0)
        success = Situation.reached(shown, self.task.hold)
        rewards = success - float(self.window.goals.gc_negative)
        return rewards, success, (at == end - 1) & ~success, self.pulls[at], inside

    @cached_property
    def _codes_held(self) -> tuple[Ids, Ids]:
        """`codes_held` of the states of all segments."""
        codes, held = self.dataset.episodes.codes_held(self.task)
        return codes[self._states], held[self._states]

    def _stack(self, states: Ids, segments: Ids) -> Ids:
        """Return the states that are shown at each of n states: (n,), or (n, stack)."""
        if self.window is None or self.window.stack is None:
            return states
        first = self.starts[segments] + segments
        return np.maximum(states[:, None] + np.arange(1 - self.window.stack, 1), first[:, None])


class Sequences:
    """Every stretch of `length` consecutive states of an episode. Can be pickled.

    Attributes:
        starts: int64 (n,), the row of steps that each stretch begins in.
    """

    def __init__(
        self, dataset: Any, length: int = 64, columns: Sequence[str] = ("observation", "action")
    ) -> None:
        """Open a dataset, see `knotgym.loaders`.

        Args:
            dataset: see `knotgym.loaders`.
            length: states of a stretch.
            columns: which columns of `datasets.episodes.STEPS` a stretch has.

        Raises:
            InvalidInput: the length isn't above 0, no episode is as long, or there is no such
                column.
        """
        if length < 1:
            raise InvalidInput(f"length must be at least 1, got {length}")
        self.dataset, self.length, self.columns = columns_of(dataset), length, tuple(columns)
        episodes = self.dataset.episodes
        episodes.steps.only(*columns)  # refuses unknown names
        self._offsets = episodes.offsets
        rows = np.arange(episodes.steps.rows)
        fits = rows + length <= np.repeat(episodes.offsets[1:], episodes.episodes["length"] + 1)
        self.starts: Ids = rows[fits]
        if not len(self.starts):
            longest = int(episodes.episodes["length"].max(initial=-1)) + 1
            lacks = f"no episode of {self.dataset.path} has {length} states"
            raise InvalidInput(f"{lacks}; the longest has {longest}")

    def __len__(self) -> int:
        """Return the number of stretches."""
        return len(self.starts)

    def __getitem__(self, index: Index) -> dict[str, NDArray[Any]]:
        """Return a copy of a stretch and the number of its episode; of several, with an axis more.

        observation is float32 (length, beads, 3), the rope alone; the goal is
        `dataset.episodes.episodes["goal_points"][episode]`, and episode an array of one number.
        """
        first, steps = self.starts[rows_at(index, len(self))], self.dataset.episodes.steps
        at = first[..., None] + np.arange(self.length)
        # indices copy: torch would write into mapped columns, which ends the process
        found = {name: steps[name][at] for name in self.columns}
        return {**found, "episode": np.searchsorted(self._offsets, first[..., None], "right") - 1}


def _masked(actions: NDArray[Any], rows: Ids, kept: NDArray[np.bool_]) -> NDArray[Any]:
    """Gather actions; those not kept are zeros."""
    found = actions[np.where(kept, rows, 0)]
    found[~kept] = 0
    return found


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


def _other_codes(codes: Ids, own: Ids, count: int, rng: np.random.Generator) -> Ids:
    """Draw, for each of n codes, `count` states with other codes, uniformly.

    Args:
        codes: (m,), the code of each state, as a number.
        own: (n,), the codes to avoid, each one of `codes`.
        count: states to draw for each.

    Returns:
        (n, count), indices of states.

    Raises:
        InvalidInput: all states have the same code.
    """
    order = np.argsort(codes, kind="stable")
    low, high = (np.searchsorted(codes[order], own, side) for side in ("left", "right"))
    left = len(codes) - (high - low)
    if (left == 0).any():
        raise InvalidInput("negatives need a dataset with two Gauss codes or more, got one")
    drawn = rng.integers(left[:, None], size=(len(own), count))
    # in sorted order the states with the code itself are the range [low, high), stepped over here
    return order[drawn + np.where(drawn >= low[:, None], (high - low)[:, None], 0)]
