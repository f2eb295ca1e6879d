"""What the agent sees of a rope and its goal: both pictures side by side, or both's vertices.

The environment, the datasets and the loaders all observe through this one module, so that a stored
observation is the environment's byte for byte.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.rendering.picture import PictureConfig, draw, draw_many
from knotgym.tasks import TaskConfig


def picture_config(task: TaskConfig) -> PictureConfig:
    """How a task's environment draws."""
    drawn: dict[str, Any] = {"camera": task.camera, "renderer": task.renderer}
    return PictureConfig(size=task.image_size, **drawn)


def pixels(
    points: ArrayLike, goal_picture: NDArray[np.uint8], picture: PictureConfig
) -> NDArray[np.uint8]:
    """Ropes left, their one goal right.

    Args:
        points: float64 (n, beads, 3), metres.
        goal_picture: uint8 (size, size, 3), the goal as `draw` draws it.
        picture: how the ropes are drawn.

    Returns:
        uint8 (n, size, 2 size, 3).
    """
    ropes = draw_many(points, picture)
    return np.concatenate([ropes, np.broadcast_to(goal_picture, ropes.shape)], axis=2)


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


def observe(
    points: ArrayLike, goal_points: ArrayLike, observation: str, picture: PictureConfig
) -> Any:
    """What an agent sees at each of n states.

    Args:
        points: float64 (n, beads, 3), metres.
        goal_points: float64 (beads, 3), metres.
        observation: "pixels", "state" or "both".
        picture: how they are drawn; unused for "state".

    Returns:
        `pixels`, `state`, or a dict of the two.
    """
    seen: dict[str, NDArray[Any]] = {}
    if observation != "state":
        seen["pixels"] = pixels(points, draw(goal_points, picture), picture)
    if observation != "pixels":
        seen["state"] = state(points, goal_points)
    return seen if observation == "both" else seen[observation]
