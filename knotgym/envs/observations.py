"""Observations of a rope and its goal: pictures side by side, vertices, Gauss codes, or `marked`.

The environment, the datasets and the loaders all use this module, so that stored observations equal
the environment's byte for byte.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.envs.marked import join, mark
from knotgym.envs.tasks import TaskConfig
from knotgym.rendering.picture import PictureConfig, draw, draw_many, picture_of
from knotgym.topology.code_arrays import visits_of
from knotgym.topology.crossings import label, label_many
from knotgym.topology.gauss import GaussCode

SYMBOLS = 64  # visits of a code in an observation, two per crossing


def picture_config(task: TaskConfig) -> PictureConfig:
    """Return the picture settings of a task's environment."""
    drawn: dict[str, Any] = {"camera": task.camera, "renderer": task.renderer}
    return picture_of(task.beads, size=task.image_size, views=task.views, depth=task.depth, **drawn)


def pixels(
    points: ArrayLike, goal_pictures: Sequence[NDArray[np.uint8]], picture: PictureConfig
) -> NDArray[np.uint8]:
    """Draw ropes on the left and their goals on the right; views are stacked vertically.

    Args:
        points: float64 (n, beads, 3), metres.
        goal_pictures: uint8 (views * size, size, 3 or 4) each, the goals as `draw` draws them.
        picture: settings of the pictures.

    Returns:
        uint8 (n, views * size, 2 size, 3); 4 channels with depth.
    """
    height, size = len(picture.views) * picture.size, picture.size
    seen = np.empty((len(goal_pictures), height, 2 * size, picture.channels), dtype=np.uint8)
    draw_many(points, picture, out=seen[:, :, :size])
    for one, goal in zip(seen, goal_pictures, strict=True):
        one[:, size:] = goal
    return seen


def stacked(pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Rearrange pictures (..., size, 2 size, 3) to (..., size, size, 6), goal channels last."""
    return np.concatenate(np.split(pictures, 2, axis=-2), axis=-1)


def state(points: ArrayLike, goal_points: ArrayLike) -> NDArray[np.float32]:
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


def symbols(codes: Sequence[GaussCode], goals: Sequence[GaussCode]) -> NDArray[np.int16]:
    """Encode the Gauss codes of ropes, each with that of its goal.

    A visit is +label over and -label under, as in `GaussCode.visits`; codes are padded with 0 to
    SYMBOLS visits, longer ones cut off there.

    Returns:
        int16 (n, 2, SYMBOLS), in [-SYMBOLS, SYMBOLS].

    >>> symbols([GaussCode((1, -1), "c")], [GaussCode(())])[0, :, :3].tolist()
    [[1, -1, 0], [0, 0, 0]]
    """
    return np.stack([cut(visits_of(codes)), cut(visits_of(goals))], axis=1)


def cut(codes: NDArray[np.integer], length: int = SYMBOLS) -> NDArray[np.int16]:
    """Cut or pad codes (..., visits or signs) with 0 to `length`: int16 (..., length)."""
    padded = np.zeros((*codes.shape[:-1], length), dtype=np.int16)
    shared = min(length, codes.shape[-1])
    padded[..., :shared] = codes[..., :shared]
    return padded


def observe(
    points: ArrayLike,
    goal_points: ArrayLike,
    observation: str,
    picture: PictureConfig,
    layout: str = "beside",
) -> Any:
    """Return the observations of n states.

    Args:
        points: float64 (n, beads, 3), metres.
        goal_points: float64 (beads, 3), metres.
        observation: "pixels", "state", "both", "symbolic" or "marked".
        picture, layout: settings of the pictures, see `TaskConfig`; used for pixels only.

    Returns:
        `pixels` (rearranged by `stacked` if layout is "stacked"), `state`, a dict of both,
        `symbols`, or the joined parts of `mark`.
    """
    if observation == "marked":
        return join(mark(points, [label(np.asarray(goal_points))] * len(np.asarray(points))))
    if observation == "symbolic":
        codes = label_many(np.asarray(points))
        return symbols(codes, [label(np.asarray(goal_points))] * len(codes))
    seen: dict[str, NDArray[Any]] = {}
    if observation != "state":
        ropes = np.asarray(points)
        drawn = pixels(ropes, [draw(goal_points, picture)] * len(ropes), picture)
        seen["pixels"] = stacked(drawn) if layout == "stacked" else drawn
    if observation != "pixels":
        seen["state"] = state(points, goal_points)
    return seen if observation == "both" else seen[observation]
