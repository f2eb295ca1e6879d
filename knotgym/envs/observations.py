"""Observations of a rope and its goal: one record a kind, in OBSERVATIONS.

Environments, datasets and loaders observe `Frames` by these records alone, so that stored
observations equal the environment's byte for byte. A new kind is a record; every keyword
`observation` then takes its name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Ids, Kinds
from knotgym.topology import GaussCode

if TYPE_CHECKING:
    from knotgym.common import Threads
    from knotgym.envs.marked import Marked
    from knotgym.envs.tasks import TaskConfig
    from knotgym.rendering import Appearance, PictureConfig

# axis of a picture along which the goal follows the rope: to the right of it, or in the channels
LAYOUTS = Kinds("layout", {"beside": 1, "stacked": 2})
SYMBOLS = 64  # visits of a code in an observation, two per crossing


@dataclass(frozen=True)
class Frames:
    """States that can be observed, by their numbers.

    Frames below R are the ropes in these rows; R + k is goal k. An observation joins the frame of a
    rope and that of a goal, so that a state that ends one transition and begins the next is
    there once.

    Attributes:
        ropes: (R, beads, 3), metres.
        visits: int16 (R, width), their codes, see `topology.CodeArrays`.
        goals: (G, beads, 3), metres.
        goal_visits: int16 (G, width).
        pictures: draws frames: (n,) -> uint8 (n, views * size, size, 3 or 4).
        threads: that gather them; one by default.
        block: rows that a thread gathers at once; 0 for `Threads.FEW`.
    """

    ropes: NDArray[Any]
    visits: NDArray[np.int16]
    goals: NDArray[Any]
    goal_visits: NDArray[np.int16]
    pictures: Callable[[Ids], NDArray[np.uint8]]
    threads: Threads
    block: int = 0

    def points(self, ids: Ids) -> NDArray[Any]:
        """Return the vertices of frames, as they are stored: (n, beads, 3), metres."""
        return self._rows(self.ropes, self.goals, ids)

    def codes(self, ids: Ids) -> NDArray[np.int16]:
        """Return the codes of frames, int16 (n, width)."""
        return self._rows(self.visits, self.goal_visits, ids)

    def marked(self, ropes: Ids, goals: Ids) -> Marked:
        """Observe ropes in their canonical frames."""
        from knotgym.envs.marked import Marked
        from knotgym.topology import CodeArrays

        texts = CodeArrays(np.asarray(self.codes(goals))).texts().tolist()
        wanted = [parsed(text) for text in texts]  # which a stranger's numbers needn't be
        return Marked.of(self.points(ropes), wanted)

    def _rows(self, ropes: NDArray[Any], goals: NDArray[Any], ids: Ids) -> NDArray[Any]:
        of_goals = ids >= len(self.ropes)
        if not of_goals.any():
            return ropes[ids]
        if of_goals.all():
            return goals[ids - len(self.ropes)]
        values = ropes[np.where(of_goals, 0, ids)]
        values[of_goals] = goals[ids[of_goals] - len(self.ropes)]
        return values


class ObservationKind(NamedTuple):
    """Everything in which one kind of observation differs from the others.

    Most join two halves of one form, of the rope and of the goal: `half`. Others need both at once
    (`whole`), or are a dict of several kinds (`parts`).

    Attributes:
        goal: how the goal is shown: by its picture, its vertices, its code.
        space: of a half, or of a whole, in a task.
        half: of frames (n,): an array (n, ...).
        axis: of a half, along which the goal follows the rope; None for the layout of pictures.
        is_drawn: whether halves are pictures, which are drawn once for all that shows them.
        whole: of frames of n ropes and of their goals: an array (n, ...).
        canonical: the same in the ropes' own frames; None if there is no such observation.
        parts: names of other kinds.
        centred: the rope's vertices in n observations, about its centre, (n, beads, 3), metres, by
            which models may choose a bead; None if there are none.
        ogbench: what names of OGBench's files begin with; None if it knows no such observation.
    """

    goal: tuple[Literal["picture", "vertices", "code"], ...]
    space: Callable[[TaskConfig], spaces.Box] | None = None
    half: Callable[[Frames, Ids], NDArray[Any]] | None = None
    axis: int | None = 0
    is_drawn: bool = False
    whole: Callable[[Frames, Ids, Ids], NDArray[Any]] | None = None
    canonical: Callable[[Frames, Ids, Ids], NDArray[Any]] | None = None
    parts: tuple[str, ...] = ()
    centred: Callable[[NDArray[Any]], NDArray[Any]] | None = None
    ogbench: str | None = None

    def space_of(self, task: TaskConfig) -> spaces.Space[Any]:
        """Return the space of one observation."""
        if self.space is None:
            return spaces.Dict({name: OBSERVATIONS[name].space_of(task) for name in self.parts})
        half = self.space(task)
        if self.half is None:
            return half
        low, high = (
            np.concatenate([end, end], axis=self._axis(task)) for end in (half.low, half.high)
        )
        return spaces.Box(low, high, dtype=half.dtype.type)

    def observe(self, task: TaskConfig, frames: Frames, ropes: Ids, goals: Ids) -> Any:
        """Return observations of n ropes with their goals: an array (n, ...), or a dict of them.

        Args:
            task: of which the layout and the frame count.
            frames: of ropes and goals.
            ropes, goals: int64 (n,), numbers of frames.
        """
        if self.parts:
            kinds = {name: OBSERVATIONS[name] for name in self.parts}
            return {name: kind.observe(task, frames, ropes, goals) for name, kind in kinds.items()}
        whole = self.canonical if task.is_canonical else self.whole
        if whole is not None:
            return whole(frames, ropes, goals)
        assert self.half is not None
        axis, count = 1 + self._axis(task), len(ropes)
        if self.is_drawn:
            drawn, at = np.unique(np.concatenate([ropes, goals]), return_inverse=True)
            halves = self.half(frames, drawn)
            return np.concatenate([halves[at[:count]], halves[at[count:]]], axis=axis)
        none, half = self.half(frames, ropes[:0]), self.half
        shape = [count, *none.shape[1:]]
        shape[axis] *= 2
        seen = np.empty(shape, none.dtype)
        left, right = np.split(seen, 2, axis=axis)

        # Block by block, so that no half is held twice; on several threads, because memory that
        # nobody has touched yet takes longer to get from the system than to fill.
        def _part(rows: slice) -> None:
            left[rows], right[rows] = half(frames, ropes[rows]), half(frames, goals[rows])

        frames.threads.spread(_part, count, most=frames.block or frames.threads.FEW)
        return seen

    def halves(self, frames: Frames, ids: Ids) -> Any:
        """Return frames by themselves, the halves of observations: (n, ...), or a dict of such."""
        if self.parts:
            return {name: OBSERVATIONS[name].halves(frames, ids) for name in self.parts}
        assert self.half is not None
        if not self.is_drawn:
            return self.half(frames, ids)
        drawn, at = np.unique(ids, return_inverse=True)
        return self.half(frames, drawn)[at]

    def has_halves(self, task: TaskConfig) -> bool:
        """Whether rope and goal can be observed by themselves."""
        kinds = [OBSERVATIONS[name] for name in self.parts] or [self]
        return not task.is_canonical and all(kind.half is not None for kind in kinds)

    def _axis(self, task: TaskConfig) -> int:
        return LAYOUTS[task.layout] if self.axis is None else self.axis


def _picture_space(task: TaskConfig) -> spaces.Box:
    shape = len(task.views) * task.image_size, task.image_size, 3 + task.depth
    return spaces.Box(0, 255, shape, np.uint8)


def _vertices(frames: Frames, ids: Ids) -> NDArray[np.float32]:
    points = np.asarray(frames.points(ids), dtype=np.float32)
    return points.reshape(len(points), 3 * points.shape[1])


def _canonical_vertices(frames: Frames, ropes: Ids, goals: Ids) -> NDArray[np.float32]:
    points = np.asarray(frames.points(ropes), dtype=np.float64)
    return frames.marked(ropes, goals).frames.states(points, frames.points(goals))


def _centred_vertices(seen: NDArray[Any]) -> NDArray[Any]:
    points = seen.reshape(len(seen), 2, -1, 3)[:, 0]
    return points - points.mean(axis=1, keepdims=True)


def _marked_space(task: TaskConfig) -> spaces.Box:
    from knotgym.envs.marked import Marked

    return spaces.Box(-np.inf, np.inf, (Marked.size(task.beads),), np.float32)


def _marked(frames: Frames, ropes: Ids, goals: Ids) -> NDArray[np.float32]:
    return frames.marked(ropes, goals).joined()


def _marked_vertices(seen: NDArray[Any]) -> NDArray[Any]:
    from knotgym.envs.marked import Marked

    return Marked.split(seen).points


OBSERVATIONS = Kinds(
    "observation",
    {
        "pixels": ObservationKind(
            goal=("picture",),
            space=_picture_space,
            half=lambda frames, ids: frames.pictures(ids),
            axis=None,
            is_drawn=True,
            ogbench="visual-",
        ),
        "state": ObservationKind(
            goal=("vertices",),
            space=lambda task: spaces.Box(-np.inf, np.inf, (3 * task.beads,), np.float32),
            half=_vertices,
            canonical=_canonical_vertices,
            centred=_centred_vertices,
            ogbench="",
        ),
        "both": ObservationKind(goal=("picture", "vertices"), parts=("pixels", "state")),
        "symbolic": ObservationKind(
            goal=("code",),
            space=lambda task: spaces.Box(-SYMBOLS, SYMBOLS, (1, SYMBOLS), np.int16),
            half=lambda frames, ids: Observer.symbols(frames.codes(ids))[:, None],
        ),
        "marked": ObservationKind(
            goal=("code",),
            space=_marked_space,
            whole=_marked,
            canonical=_marked,
            centred=_marked_vertices,
        ),
    },
)


class Observer:
    """Draws the pictures of a task's episodes.

    Attributes:
        task: settings of the environment.
        picture: settings of its pictures.
        SYMBOLS: visits of a code in an observation, two per crossing.
    """

    SYMBOLS: ClassVar[int] = SYMBOLS

    def __init__(self, task: TaskConfig, picture: PictureConfig | None = None) -> None:
        """Take a task, and other pictures than its own, in which no appearance varies."""
        from knotgym.rendering import PictureConfig

        drawn: dict[str, Any] = {"camera": task.camera, "renderer": task.renderer}
        drawn |= {"size": task.image_size, "views": task.views, "depth": task.depth}
        self.task, self._is_own = task, picture is None
        self.picture = picture or PictureConfig.of(task.beads, **drawn)

    def appearances(self, goals: Iterable[tuple[int, ArrayLike]]) -> list[Appearance | None]:
        """Return the appearance of each episode's pictures; None for the published one.

        Args:
            goals: of each episode, the row of its goal state, and that state's points.
        """
        from knotgym.rendering import Drawer

        drawer = Drawer.of(self.task.appearance if self._is_own else "published")
        size = self.task.image_size
        return [drawer.for_episode(_stored(points), size, row) for row, points in goals]

    def draw_ropes(
        self, points: ArrayLike, looks: Sequence[Appearance | None], threads: Threads | None = None
    ) -> NDArray[np.uint8]:
        """Draw ropes (n, beads, 3), metres, each as its episode looks.

        Args:
            points: metres.
            looks: of each rope, see `appearances`.
            threads: that draw them; one by default. MuJoCo's renderer works on one.

        Returns:
            uint8 (n, views * size, size, 3); 4 channels with depth. Views are stacked vertically.
        """
        from knotgym.common import Threads
        from knotgym.rendering import Drawer, draw

        picture, ropes = self.picture, np.asarray(points)
        shape = len(picture.views) * picture.size, picture.size, picture.channels
        seen = np.empty((len(ropes), *shape), dtype=np.uint8)

        def _part(rows: slice) -> None:
            if any(looks):
                each = zip(_stored(ropes[rows]), looks[rows], strict=True)
                seen[rows] = [Drawer.of(look.name).image(rope, look) for rope, look in each if look]
            else:
                draw(ropes[rows], picture, out=seen[rows])

        if threads is None or picture.renderer == "mujoco":
            threads = Threads()
        threads.spread(_part, len(seen), most=Threads.FEW)
        return seen

    @staticmethod
    def symbols(codes: NDArray[np.integer], length: int = SYMBOLS) -> NDArray[np.int16]:
        """Cut or pad codes (..., visits or signs) with 0 to `length`: int16 (..., length).

        A visit is +label over and -label under, as in `GaussCode.visits`.
        """
        from knotgym.common import padded

        return padded(codes, length).astype(np.int16)

    @staticmethod
    def map_parts(seen: Any, function: Callable[[Any], Any]) -> Any:
        """Apply a function to an observation; to each part of one that is a dict."""
        if isinstance(seen, dict):
            return {name: Observer.map_parts(part, function) for name, part in seen.items()}
        return function(seen)


def _stored(points: ArrayLike) -> NDArray[np.float64]:
    """Round points as datasets do."""
    return np.asarray(points, dtype=np.float32).astype(np.float64)


@lru_cache(maxsize=1024)
def parsed(text: str) -> GaussCode:
    """Parse a code, which is likely to come again."""
    return GaussCode.parse(text)
