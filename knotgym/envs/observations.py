"""Observations of a rope and its goal: pictures side by side, vertices, Gauss codes, or `marked`.

The environment, the datasets and the loaders all use this module, so that stored observations equal
the environment's byte for byte.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Threads, padded
from knotgym.envs.tasks import TaskConfig
from knotgym.rendering import PictureConfig, draw
from knotgym.topology import CodeArrays

if TYPE_CHECKING:
    from knotgym.rendering import Appearance


class Observer:
    """What is seen in the episodes of a task.

    Attributes:
        task: settings of the environment.
        picture: settings of its pictures.
        SYMBOLS: visits of a code in an observation, two per crossing.
    """

    SYMBOLS: ClassVar[int] = 64

    def __init__(self, task: TaskConfig, picture: PictureConfig | None = None) -> None:
        """Take a task, and other pictures than its own, in which no appearance varies."""
        drawn: dict[str, Any] = {"camera": task.camera, "renderer": task.renderer}
        drawn |= {"size": task.image_size, "views": task.views, "depth": task.depth}
        self.task, self._is_own = task, picture is None
        self.picture = picture or PictureConfig.of(task.beads, **drawn)

    @property
    def space(self) -> spaces.Space[Any]:
        """The observation space of one rope."""
        task = self.task
        if task.observation == "symbolic":
            most = self.SYMBOLS
            return spaces.Box(-most, most, (2, most), np.int16)
        if task.observation == "marked":
            from knotgym.envs.marked import Marked

            return spaces.Box(-np.inf, np.inf, (Marked.size(task.beads),), np.float32)
        height, width, channels = len(task.views) * task.image_size, task.image_size, 3 + task.depth
        beside = task.layout == "beside"
        shape = (height, 2 * width, channels) if beside else (height, width, 2 * channels)
        seen: dict[str, spaces.Space[Any]] = {
            "pixels": spaces.Box(0, 255, shape, np.uint8),
            "state": spaces.Box(-np.inf, np.inf, (6 * task.beads,), np.float32),
        }
        return spaces.Dict(seen) if task.observation == "both" else seen[task.observation]

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
        self, points: ArrayLike, looks: Sequence[Appearance | None], **drawn: Any
    ) -> NDArray[np.uint8]:
        """Draw ropes (n, beads, 3), metres, each as its episode looks; see `draw`."""
        from knotgym.rendering import Drawer

        if not any(looks):
            return draw(points, self.picture, **drawn)
        ropes = zip(_stored(points), looks, strict=True)
        return np.stack([Drawer.of(look.name).image(rope, look) for rope, look in ropes if look])

    def pixels(
        self,
        points: ArrayLike,
        goal_pictures: Sequence[NDArray[np.uint8]],
        looks: Sequence[Appearance | None],
        threads: Threads | None = None,
    ) -> NDArray[np.uint8]:
        """Draw ropes on the left and their goals on the right; views are stacked vertically.

        Args:
            points: float64 (n, beads, 3), metres.
            goal_pictures: uint8 (views * size, size, 3 or 4) each, the goals drawn by `draw_ropes`.
            looks: of each rope, see `appearances`.
            threads: that draw them; one by default. MuJoCo's renderer works on one.

        Returns:
            uint8 (n, views * size, 2 size, 3); 4 channels with depth.
        """
        picture, ropes = self.picture, np.asarray(points)
        height, size = len(picture.views) * picture.size, picture.size
        seen = np.empty((len(goal_pictures), height, 2 * size, picture.channels), dtype=np.uint8)

        def _part(rows: slice) -> None:
            if any(looks):
                seen[rows, :, :size] = self.draw_ropes(ropes[rows], looks[rows])
            else:
                self.draw_ropes(ropes[rows], (), out=seen[rows])
            goals = np.concatenate(goal_pictures[rows])
            seen[rows, :, size:] = goals.reshape(-1, height, size, picture.channels)

        if threads is None or picture.renderer == "mujoco":
            threads = Threads()
        threads.spread(_part, len(seen), most=Threads.FEW)
        return seen

    def observe(
        self,
        points: ArrayLike,
        visits: NDArray[np.int16],
        goal_points: ArrayLike,
        goal_visits: NDArray[np.int16],
        pictures: Callable[[], NDArray[np.uint8]],
    ) -> Any:
        """Return the observations of n states, of the kind `task.observation`.

        Args:
            points: float64 (n, beads, 3), metres.
            visits: (n, 2 width), the ropes' codes, see `topology.CodeArrays`.
            goal_points: float64 (beads, 3), metres, a goal common to all; or (n, beads, 3).
            goal_visits: (n, 2 width), the goals' codes.
            pictures: draws the states as `pixels` does; called only if there are pictures.

        Returns:
            The pictures, uint8, in the layout "stacked" with the goal's channels last; vertices of
            ropes and goals, float32 (n, 6 beads), metres; a dict of both; the codes of rope and
            goal, int16 (n, 2, SYMBOLS), see `symbols`; or what `Marked.joined` returns.
        """
        task = self.task
        if task.observation == "symbolic":
            return self.symbols(np.stack([visits, goal_visits], axis=1))
        if task.observation == "marked" or task.frame == "canonical":
            from knotgym.envs.marked import Marked

            marked = Marked.of(points, CodeArrays(np.asarray(goal_visits)).objects())
            if task.observation == "marked":
                return marked.joined()
            return marked.frames.states(np.asarray(points, dtype=np.float64), goal_points)
        seen: dict[str, NDArray[Any]] = {}
        if task.observation != "state":
            drawn = pictures()
            if task.layout == "stacked":  # (n, size, 2 size, 3) becomes (n, size, size, 6)
                drawn = np.concatenate(np.split(drawn, 2, axis=-2), axis=-1)
            seen["pixels"] = drawn
        if task.observation != "pixels":
            ropes = np.asarray(points)
            states = np.empty((len(ropes), 2, *ropes.shape[1:]), dtype=np.float32)
            states[:, 0], states[:, 1] = ropes, goal_points
            seen["state"] = states.reshape(len(ropes), -1)
        return seen if task.observation == "both" else seen[task.observation]

    @staticmethod
    def symbols(codes: NDArray[np.integer], length: int = SYMBOLS) -> NDArray[np.int16]:
        """Cut or pad codes (..., visits or signs) with 0 to `length`: int16 (..., length).

        A visit is +label over and -label under, as in `GaussCode.visits`.
        """
        return padded(codes, length).astype(np.int16)

    @staticmethod
    def map_parts(seen: Any, function: Callable[[Any], Any]) -> Any:
        """Apply a function to an observation; to both parts of one of the kind "both"."""
        if isinstance(seen, dict):
            return {name: Observer.map_parts(part, function) for name, part in seen.items()}
        return function(seen)


def _stored(points: ArrayLike) -> NDArray[np.float64]:
    """Round points as datasets do."""
    return np.asarray(points, dtype=np.float32).astype(np.float64)
