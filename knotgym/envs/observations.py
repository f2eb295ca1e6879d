"""Observations of a rope and its goal: pictures side by side, vertices, Gauss codes, or `marked`.

The environment, the datasets and the loaders all use this module, so that stored observations equal
the environment's byte for byte.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Threads
from knotgym.envs.tasks import TaskConfig
from knotgym.rendering import PictureConfig, draw
from knotgym.topology import CodeArrays

if TYPE_CHECKING:
    from knotgym.rendering import Appearance

SYMBOLS = 64  # visits of a code in an observation, two per crossing


def observation_space(task: TaskConfig) -> spaces.Space[Any]:
    """Return the observation space of one rope."""
    if task.observation == "symbolic":
        return spaces.Box(-SYMBOLS, SYMBOLS, (2, SYMBOLS), np.int16)
    if task.observation == "marked":
        from knotgym.envs.marked import size

        return spaces.Box(-np.inf, np.inf, (size(task.beads),), np.float32)
    height, width, channels = len(task.views) * task.image_size, task.image_size, 3 + task.depth
    beside = task.layout == "beside"
    shape = (height, 2 * width, channels) if beside else (height, width, 2 * channels)
    seen: dict[str, spaces.Space[Any]] = {
        "pixels": spaces.Box(0, 255, shape, np.uint8),
        "state": spaces.Box(-np.inf, np.inf, (6 * task.beads,), np.float32),
    }
    return spaces.Dict(seen) if task.observation == "both" else seen[task.observation]


def picture_config(task: TaskConfig) -> PictureConfig:
    """Return the picture settings of a task's environment."""
    drawn: dict[str, Any] = {"camera": task.camera, "renderer": task.renderer}
    drawn |= {"size": task.image_size, "views": task.views, "depth": task.depth}
    return PictureConfig.of(task.beads, **drawn)


def looks(task: TaskConfig, goals: Iterable[tuple[int, ArrayLike]]) -> list[Appearance | None]:
    """Return the appearance of each episode's pictures; None for the published one.

    Args:
        task: settings of the environment.
        goals: of each episode, the row of its goal state, and that state's points.
    """
    from knotgym.rendering import Drawer

    drawer = Drawer.of(task.appearance)
    return [drawer.for_episode(_stored(points), task.image_size, row) for row, points in goals]


def alone(
    points: ArrayLike, looks: Sequence[Appearance | None], picture: PictureConfig
) -> NDArray[np.uint8]:
    """Draw ropes (n, beads, 3), metres, each as its episode looks; see `draw`."""
    if all(look is None for look in looks):
        return draw(points, picture)
    from knotgym.rendering import Drawer

    ropes = zip(_stored(points), looks, strict=True)
    return np.stack([Drawer.of(look.name).image(rope, look) for rope, look in ropes if look])


def _stored(points: ArrayLike) -> NDArray[np.float64]:
    """Round points as datasets do."""
    return np.asarray(points, dtype=np.float32).astype(np.float64)


def pixels(
    points: ArrayLike,
    goal_pictures: Sequence[NDArray[np.uint8]],
    picture: PictureConfig,
    threads: Threads | None = None,
    looks: Sequence[Appearance | None] = (),
) -> NDArray[np.uint8]:
    """Draw ropes on the left and their goals on the right; views are stacked vertically.

    Args:
        points: float64 (n, beads, 3), metres.
        goal_pictures: uint8 (views * size, size, 3 or 4) each, the goals as `draw` draws them.
        picture: settings of the pictures.
        threads: that draw them; one by default. MuJoCo's renderer works on one.
        looks: of each rope, see `looks`; all published by default.

    Returns:
        uint8 (n, views * size, 2 size, 3); 4 channels with depth.
    """
    ropes, height, size = np.asarray(points), len(picture.views) * picture.size, picture.size
    seen = np.empty((len(goal_pictures), height, 2 * size, picture.channels), dtype=np.uint8)

    def part(rows: slice) -> None:
        if any(looks):
            seen[rows, :, :size] = alone(ropes[rows], looks[rows], picture)
        else:
            draw(ropes[rows], picture, out=seen[rows])
        goals = np.concatenate(goal_pictures[rows])
        seen[rows, :, size:] = goals.reshape(-1, height, size, picture.channels)

    if threads is None or picture.renderer == "mujoco":
        threads = Threads()
    threads.spread(part, len(seen), most=Threads.FEW)
    return seen


def each(seen: Any, function: Callable[[Any], Any]) -> Any:
    """Apply a function to an observation; to both parts of one of the kind "both"."""
    if isinstance(seen, dict):
        return {name: each(part, function) for name, part in seen.items()}
    return function(seen)


def _stacked(pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Rearrange pictures (..., size, 2 size, 3) to (..., size, size, 6), goal channels last."""
    return np.concatenate(np.split(pictures, 2, axis=-2), axis=-1)


def _state(points: ArrayLike, goal_points: ArrayLike) -> NDArray[np.float32]:
    """Concatenate the vertices of each rope with those of its goal.

    Args:
        points: float64 (n, beads, 3), metres.
        goal_points: float64 (beads, 3), metres, a goal common to all; or (n, beads, 3).

    Returns:
        float32 (n, 6 beads), metres.
    """
    ropes = np.asarray(points)
    seen = np.empty((len(ropes), 2, *ropes.shape[1:]), dtype=np.float32)
    seen[:, 0], seen[:, 1] = ropes, goal_points
    return seen.reshape(len(ropes), -1)


def cut(codes: NDArray[np.integer], length: int = SYMBOLS) -> NDArray[np.int16]:
    """Cut or pad codes (..., visits or signs) with 0 to `length`: int16 (..., length).

    A visit is +label over and -label under, as in `GaussCode.visits`.
    """
    padded = np.zeros((*codes.shape[:-1], length), dtype=np.int16)
    shared = min(length, codes.shape[-1])
    padded[..., :shared] = codes[..., :shared]
    return padded


def observe(
    task: TaskConfig,
    points: ArrayLike,
    visits: NDArray[np.int16],
    goal_points: ArrayLike,
    goal_visits: NDArray[np.int16],
    pictures: Callable[[], NDArray[np.uint8]],
) -> Any:
    """Return the observations of n states, of the kind `task.observation`.

    Args:
        task: settings of the environment.
        points: float64 (n, beads, 3), metres.
        visits: (n, 2 width), the ropes' codes, see `topology.code_arrays`.
        goal_points: as of `state`.
        goal_visits: (n, 2 width), the goals' codes.
        pictures: draws the states as `pixels` does; called only if there are pictures.

    Returns:
        The pictures, rearranged by `stacked` in that layout; `state`; a dict of both; the codes of
        rope and goal, int16 (n, 2, SYMBOLS), see `cut`; or the joined parts of `mark`.
    """
    if task.observation == "marked":
        from knotgym.envs.marked import join, mark

        return join(mark(points, CodeArrays(np.asarray(goal_visits)).objects()))
    if task.observation == "symbolic":
        return cut(np.stack([visits, goal_visits], axis=1))
    seen: dict[str, NDArray[Any]] = {}
    if task.observation != "state":
        seen["pixels"] = _stacked(pictures()) if task.layout == "stacked" else pictures()
    if task.observation == "state" and task.frame == "canonical":
        from knotgym.envs.marked import frames_of

        frames = frames_of(points, CodeArrays(np.asarray(goal_visits)).objects())
        return frames.states(np.asarray(points, dtype=np.float64), goal_points)
    if task.observation != "pixels":
        seen["state"] = _state(points, goal_points)
    return seen if task.observation == "both" else seen[task.observation]
