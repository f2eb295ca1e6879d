"""What the agent sees of a rope and its goal: both pictures side by side, or both's vertices, or
both's Gauss codes.

The environment, the datasets and the loaders all observe through this one module, so that a stored
observation is the environment's byte for byte.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.envs.tasks import TaskConfig
from knotgym.rendering.picture import PictureConfig, draw, draw_many
from knotgym.topology.crossings import label, label_many
from knotgym.topology.gauss import GaussCode

SYMBOLS = 64  # visits of a code that an agent is told, two a crossing


def picture_config(task: TaskConfig) -> PictureConfig:
    """How a task's environment draws."""
    drawn: dict[str, Any] = {"camera": task.camera, "renderer": task.renderer}
    return PictureConfig(size=task.image_size, views=task.views, depth=task.depth, **drawn)


def pixels(
    points: ArrayLike, goal_picture: NDArray[np.uint8], picture: PictureConfig
) -> NDArray[np.uint8]:
    """Ropes left, their one goal right; views one below another.

    Args:
        points: float64 (n, beads, 3), metres.
        goal_picture: uint8 (views * size, size, 3 or 4), the goal as `draw` draws it.
        picture: how the ropes are drawn.

    Returns:
        uint8 (n, views * size, 2 size, 3), with depth 4 channels.
    """
    ropes = draw_many(points, picture)
    return np.concatenate([ropes, np.broadcast_to(goal_picture, ropes.shape)], axis=2)


def stacked(pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Pictures uint8 (..., size, 2 size, 3) as (..., size, size, 6), the goal's channels last."""
    return np.concatenate(np.split(pictures, 2, axis=-2), axis=-1)


def state(points: ArrayLike, goal_points: ArrayLike) -> NDArray[np.float32]:
    """Vertices of ropes, then those of their one goal.

    Args:
        points: float64 (n, beads, 3), metres.
        goal_points: float64 (beads, 3), metres.

    Returns:
        float32 (n, 6 beads), metres.
    """
    ropes = np.asarray(points, dtype=np.float64)
    ropes = ropes.reshape(len(ropes), -1)
    goals = np.broadcast_to(np.ravel(goal_points), ropes.shape)
    return np.concatenate([ropes, goals], axis=1).astype(np.float32)


def symbols(codes: Sequence[GaussCode], goal: GaussCode) -> NDArray[np.int16]:
    """Gauss codes of ropes, each above that of their one goal.

    A visit is +label over and -label under, as in `GaussCode.visits`, and 0 after the last. Of a
    code of more than SYMBOLS visits the first SYMBOLS are kept.

    Returns:
        int16 (n, 2, SYMBOLS), in [-SYMBOLS, SYMBOLS].

    >>> symbols([GaussCode((1, -1), "c")], GaussCode(()))[0, :, :3].tolist()
    [[1, -1, 0], [0, 0, 0]]
    """
    told = np.zeros((len(codes), 2, SYMBOLS), dtype=np.int16)
    for row, code in enumerate(codes):
        told[row] = numbers(code.visits), numbers(goal.visits)
    return told


def numbers(code: Iterable[int], length: int = SYMBOLS) -> NDArray[np.int16]:
    """The first `length` of a code's visits or signs, then 0: int16 (length,)."""
    told = np.zeros(length, dtype=np.int16)
    first = tuple(code)[:length]
    told[: len(first)] = first
    return told


def observe(
    points: ArrayLike,
    goal_points: ArrayLike,
    observation: str,
    picture: PictureConfig,
    layout: str = "beside",
) -> Any:
    """What an agent sees at each of n states.

    Args:
        points: float64 (n, beads, 3), metres.
        goal_points: float64 (beads, 3), metres.
        observation: "pixels", "state", "both" or "symbolic".
        picture, layout: how they are drawn and laid out, see `TaskConfig`; used for pixels alone.

    Returns:
        `pixels`, perhaps `stacked`, `state`, a dict of the two, or `symbols`.
    """
    if observation == "symbolic":
        return symbols(label_many(np.asarray(points)), label(np.asarray(goal_points)))
    seen: dict[str, NDArray[Any]] = {}
    if observation != "state":
        drawn = pixels(points, draw(goal_points, picture), picture)
        seen["pixels"] = stacked(drawn) if layout == "stacked" else drawn
    if observation != "pixels":
        seen["state"] = state(points, goal_points)
    return seen if observation == "both" else seen[observation]
