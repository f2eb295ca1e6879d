"""A dataset opened as consecutive segments of transitions.

A segment is a whole episode or, with hindsight relabelling, the start of an episode up to a code
that it reached. Actions, rewards and ends are cached when first read; observations are read or
rendered on demand.
"""

from functools import cached_property
from typing import Any, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import InvalidInput
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.trajectory import MACRO_INFOS, codes_in_bounds, goal_steps
from knotgym.envs.reward import success_at_last
from knotgym.envs.tasks import ACTIONS
from knotgym.loaders.frame_cache import CachedFrames, FrameCache
from knotgym.loaders.windows import Window
from knotgym.rope.actions import CHOICES, decode_actions, force_choices

_CACHED_SEGMENTS = 256  # segments whose codes stay in memory


class Columns(NamedTuple):
    """The T transitions of a segment without observations: actions (T, ...), the others (T,)."""

    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    terminals: NDArray[np.bool_]
    timeouts: NDArray[np.bool_]


class Opening(TypedDict, total=False):
    """The keywords of every loader, see `knotgym.loaders`."""

    observation: str | None
    picture: Any
    action: str | None
    relabel: str | None
    labels: bool
    cache: Any
    window: Window | None


class Segments:
    """N transitions in S segments. Can be pickled, and read from any process.

    Data are read when needed, so opening is fast; only relabel reads all codes, and the view
    "macro" where macro-actions start.

    In the view "macro" a transition is a macro-action. It leads from the state in which the
    macro-action began to that in which the next one began, or to the segment's last; its reward is
    the sum over the pulls between, of which only the last can have one. States before the first
    macro-action are left out, and so are segments without any.

    Attributes:
        episode: int64 (S,), index of the segment's episode in the dataset.
        goal_step: int64 (S,), which state of the episode is the goal; -1 for the episode's own
            goal.
        starts: int64 (S + 1,), the first transition of each segment, then N.
        action: view of the actions, see `knotgym.rope.action_views`.
        actions: float32 (N, 6); in other views int64 (N, 4) or (N, 3).
        pulls: int64 (N,), pulls of each transition: 1 unless the view is "macro".
        rewards: float64 (N,).
        terminals, timeouts: bool (N,).
    """

    def __init__(
        self,
        dataset: Any,
        observation: str | None = None,
        picture: Any = None,
        action: str | None = None,
        relabel: str | None = None,
        labels: bool = False,
        cache: Any = None,
        window: Window | None = None,
    ) -> None:
        """Open a dataset.

        Args:
            dataset: id or folder of a Minari dataset, `minari.MinariDataset`, or an episode file,
                compact or not.
            observation: "pixels", "state", "both" or "symbolic"; None for the environment's.
            picture: a `knotgym.rendering.picture.PictureConfig` to render with; None for the
                environment's pictures.
            action: "pull", "bead" or "macro"; None for the environment's.
            relabel: None for episodes as they are. "last": the goal becomes the last new code that
                an episode reached, and the episode ends there. "all": one such segment for every
                code that it reached. An episode that never leaves its first code gives none.
            labels: use the actions that an expert would have taken (`collect --labels expert`)
                instead of those taken; they don't lead to the next observation.
            cache: a folder, or a `FrameCache`, for uncompressed pictures; see `knotgym.loaders`.
            window: steps, chunks, stacks, histories and sampled goals of `batch`; None for single
                transitions.

        Raises:
            InvalidInput: goals are sampled in a dataset with relabel or labels, or chunks are made
                of labels.
            InvalidInput: the observations have no pictures, or the cache has no room for them.
            InvalidInput: labels are requested together with relabel or the view "macro", or the
                dataset has none.
            InvalidInput: the view is "macro", and an episode doesn't record them.
            InvalidInput: there is no such view.
        """
        self._reader = EpisodeReader(dataset)
        self._labels = labels
        self.action = self._reader.task.action if action is None else action
        if self.action not in ACTIONS:
            raise InvalidInput(f"no action {action!r}; there is {', '.join(ACTIONS)}")
        if self.action == "macro" and labels:
            raise InvalidInput("the expert's actions are pulls: use labels without action 'macro'")
        if self.action == "macro" and not self._reader.has("macro_start"):
            raise InvalidInput(
                f"{self._reader.path} doesn't record macro-actions: use action 'pull' or 'bead', or"
                " collect it with a policy that acts in macro-actions"
            )
        if labels and relabel is not None:
            raise InvalidInput(
                "the expert's actions lead to the episode's own goal: use labels without relabel"
            )
        if labels and not self._reader.has("expert_action"):
            raise InvalidInput(
                f"{self._reader.path} has no expert actions: collect it with --labels expert"
            )
        self.window = window
        if window is not None and window.goals is not None and (labels or relabel is not None):
            raise InvalidInput("sampled goals replace the episodes': leave out relabel and labels")
        if window is not None and window.chunk is not None and labels:
            raise InvalidInput("the expert's actions don't follow one another: leave out chunk")
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
        # the states before and after each segment's transitions
        ends = [self._ends(k, length) for (k, _), length in zip(parts, lengths, strict=True)]
        kept = [row for row, own in enumerate(ends) if len(own) > 1]
        self._states_of = [ends[row] for row in kept]
        parts = [parts[row] for row in kept]
        self.episode, self.goal_step = np.array(parts, dtype=np.int64).reshape(-1, 2).T
        self.starts: NDArray[np.int64] = np.cumsum([0, *(len(own) - 1 for own in self._states_of)])

        # per state of all segments, N + S of them; a transition's state is its row + its segment
        self._segment_of = np.repeat(np.arange(self.segments), np.diff(self.starts) + 1)
        self._step_of = np.concatenate([np.empty(0, np.int64), *self._states_of])

    @property
    def _shown(self) -> str:
        """The observation that is returned."""
        return str(self._seen["observation"] or self._reader.task.observation)

    @cached_property
    def actions(self) -> NDArray[Any]:
        """float32 (N, 6); in other views int64 (N, 4) or (N, 3)."""
        if self.action == "pull":
            return self._all(0, np.empty((0, 6), np.float32))
        return self._all(0, np.empty((0, len(CHOICES[self.action])), np.int64))

    @cached_property
    def rewards(self) -> NDArray[np.float64]:
        """float64 (N,)."""
        return self._all(1, np.empty(0))

    @cached_property
    def terminals(self) -> NDArray[np.bool_]:
        """bool (N,), true where an episode terminated."""
        return self._all(2, np.empty(0, bool))

    @cached_property
    def timeouts(self) -> NDArray[np.bool_]:
        """bool (N,), true where an episode was truncated."""
        return self._all(3, np.empty(0, bool))

    @cached_property
    def pulls(self) -> NDArray[np.int64]:
        """int64 (N,), pulls of each transition."""
        return np.concatenate([np.empty(0, np.int64), *map(np.diff, self._states_of)])

    @cached_property
    def _taken(self) -> NDArray[Any]:
        """The actions that were taken, where `actions` are the expert's."""
        if not self._labels:
            return self.actions
        own = zip(self.episode.tolist(), self._states_of, strict=True)
        return np.concatenate([self._actions(index, ends, taken=True) for index, ends in own])

    @cached_property
    def _codes_held(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Per state: its code as a number, -1 where none counts; and for how many steps it held."""
        codes, steps = [], []
        for index in self.episode.tolist():
            shown = self._reader.column(index, "gauss_code")
            valid = ~self._reader.column(index, "simulation_failed")
            valid[len(self._codes_in_bounds(index)) :] = False
            codes.append(np.where(valid, shown, "-"))
            steps.append(np.arange(len(shown)))
        step = np.concatenate([np.empty(0, np.int64), *steps])
        names, number = np.unique(np.concatenate([np.empty(0, str), *codes]), return_inverse=True)
        number[names[number] == "-"] = -1
        # the state of a reset isn't a step, so that the first step begins to hold a code
        begins = np.append(True, number[1:] != number[:-1]) | (step <= 1)
        row = np.arange(len(step))
        held = row - np.maximum.accumulate(np.where(begins, row, 0)) + (step > 0)
        kept = self._step_of + np.flatnonzero(step == 0)[self._segment_of]
        return number[kept], held[kept]

    def _ends(self, index: int, length: int) -> NDArray[np.int64]:
        """Return the states of an episode's first `length` pulls that transitions lead between."""
        if self.action != "macro":
            return np.arange(length + 1)
        # the step that led to state i starts in state i - 1
        begun = np.flatnonzero(self._reader.column(index, "macro_start")[1 : length + 1])
        return np.append(begun, length)

    def _cached(self, cache: Any) -> CachedFrames:
        if self._shown not in ("pixels", "both"):
            raise InvalidInput(
                f"a cache keeps pictures, and observation {self._shown!r} has none:"
                ' leave out cache, or use observation="pixels"'
            )
        if not isinstance(cache, FrameCache):
            cache = FrameCache(cache)
        return CachedFrames(self._reader, self._seen["picture"], cache)

    def columns(self, segment: int) -> Columns:
        """Read a segment without its observations; the result is kept in memory."""
        if segment not in self._read:
            index, ends = int(self.episode[segment]), self._states_of[segment]
            outcome: list[NDArray[Any]]
            if self._relabelled:
                outcome = list(success_at_last(int(ends[-1]), self._reader.task.success_reward))
            else:
                outcome = [
                    self._reader.column(index, name)
                    for name in ("rewards", "terminations", "truncations")
                ]
            # over each transition rewards are summed; an episode ends in its last pull only
            rewards, *ended = outcome
            self._read[segment] = Columns(
                self._actions(index, ends),
                np.add.reduceat(rewards, ends[:-1]),
                *(flags[ends[1:] - 1] for flags in ended),
            )
        return self._read[segment]

    def _actions(self, index: int, ends: NDArray[np.int64], *, taken: bool = False) -> NDArray[Any]:
        """Return the actions that lead from each of the states `ends` of an episode to the next."""
        reader, length, labels = self._reader, int(ends[-1]), self._labels and not taken
        if self.action == "macro":
            led = (reader.column(index, name)[ends[:-1] + 1] for name in MACRO_INFOS[1:])
            bead, target, side = led
            return np.stack([bead, target, (side + 1) // 2], axis=1)
        pulls = reader.column(index, "expert_action" if labels else "actions")[:length]
        if self.action == "pull":
            return pulls
        if labels:
            points = reader.column(index, "points")[:length]
            beads = decode_actions(pulls, points, reader.task.rope)[0]
        else:
            beads = reader.column(index, "bead")[1 : length + 1]
        return np.column_stack([beads, force_choices(pulls[:, 3:])])

    def _codes_in_bounds(self, index: int) -> NDArray[np.str_]:
        """Return an episode's codes up to the first state that is towed too far to be a goal."""
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
        """Return the segment that holds a transition, and its step there."""
        segment = int(np.searchsorted(self.starts, transition, side="right")) - 1
        return segment, int(transition - self.starts[segment])

    def frame_place(self, frame: int) -> tuple[int, int]:
        """Return the segment and step of one of the N + S states of all segments."""
        starts = self.starts + np.arange(self.segments + 1)
        segment = int(np.searchsorted(starts, frame, side="right")) - 1
        return segment, int(frame - starts[segment])

    def observations(self, segment: int, start: int = 0, stop: int | None = None) -> Any:
        """Return the observations of the states [start, stop) of a segment with T transitions.

        There are T + 1; see `Transitions` for those of the view "macro".

        Returns:
            uint8 (n, views * size, 2 size, 3 or 4), float32 (n, 6 beads), a dict of both, or int16
            (n, 2, symbols).
        """
        steps = self._states_of[segment][start:stop]
        return self._read_states(segment, steps, self._own_goal(segment))

    def _own_goal(self, segment: int) -> tuple[int, int] | None:
        """Return the episode and step of a segment's goal; None for the episode's own goal."""
        step = int(self.goal_step[segment])
        return None if step < 0 else (int(self.episode[segment]), step)

    def _read_states(
        self, segment: int, steps: NDArray[np.int64], goal: tuple[int, int] | None
    ) -> Any:
        """Return the observations at some steps of a segment's episode, in increasing order."""
        episode = int(self.episode[segment])
        goal_episode, goal_step = (None, None) if goal is None else goal
        named: dict[str, Any] = {"goal_episode": goal_episode, "goal_step": goal_step}
        if self._frames is None:
            return self._reader.observations(episode, steps, **named, **self._seen)
        goals = self._frames.goal(*np.array([goal or (episode, -1)]).T)
        ropes = self._frames.offsets[episode] + steps
        pictures = self._frames.joined(ropes, np.broadcast_to(goals, ropes.shape))
        if self._shown == "pixels":
            return pictures
        state = self._reader.observations(episode, steps, **named, observation="state")
        return {"pixels": pictures, "state": state}

    def codes(self, segment: int) -> list[str]:
        """Return the Gauss codes of a segment's states; recent segments are cached."""
        if segment not in self._codes:
            if len(self._codes) == _CACHED_SEGMENTS:
                del self._codes[next(iter(self._codes))]
            codes = self._reader.column(int(self.episode[segment]), "gauss_code")
            self._codes[segment] = codes[self._states_of[segment]].tolist()
        return self._codes[segment]
