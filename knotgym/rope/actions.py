"""The action interface: (x, y, z, fx, fy, fz) in [-1, 1], to a bead and a force and back.

An action steps the rope by the bead nearest to the point (x, y, z), in units of `RopeConfig.reach`,
with the force (fx, fy, fz), in units of `RopeConfig.max_force`; as published.
Source: arXiv 2505.18028.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.streams import generator_of

if TYPE_CHECKING:
    from knotgym.rope.model import RopeConfig  # not at run time, so that loaders need no simulator

Array = NDArray[np.float64]


def decode_actions(
    actions: ArrayLike, points: Array, rope: RopeConfig
) -> tuple[NDArray[np.int64], Array]:
    """The beads and forces that actions stand for.

    Args:
        actions: (n, 6), in [-1, 1].
        points: float64 (n, beads, 3), metres: how each rope lies when the action is taken.
        rope: what it is.

    Returns:
        beads int64 (n,); forces float64 (n, 3), newtons.
    """
    a = np.asarray(actions, dtype=np.float64)
    apart = points - rope.reach * a[:, None, :3]
    return np.argmin((apart**2).sum(axis=2), axis=1), rope.max_force * a[:, 3:]


def encode_actions(
    beads: ArrayLike, forces: ArrayLike, points: Array, rope: RopeConfig
) -> NDArray[np.float32]:
    """Actions that stand for beads and forces; the inverse of `decode_actions`.

    Args:
        beads: int (n,).
        forces: (n, 3), newtons; cut at the largest there is.
        points, rope: as of `decode_actions`.

    Returns:
        float32 (n, 6).
    """
    at = points[np.arange(len(points)), np.asarray(beads)] / rope.reach
    scaled = np.asarray(forces, dtype=np.float64) / rope.max_force
    return np.clip(np.concatenate([at, scaled], axis=1), -1, 1).astype(np.float32)


def steps_taken(
    actions: ArrayLike, points: Array, rope: RopeConfig
) -> tuple[NDArray[np.int64], Array]:
    """What led to each state of an episode; nothing led to the first.

    Args:
        actions: (T, 6).
        points: float64 (T + 1, beads, 3), metres: the states around them.
        rope: what it is.

    Returns:
        beads int64 (T + 1,), -1 first; the forces asked for, float64 (T + 1, 3), newtons, 0 first.
    """
    beads, forces = decode_actions(actions, points[:-1], rope)
    return np.concatenate([[-1], beads]), np.concatenate([np.zeros((1, 3)), forces])


def drawn_actions(key: tuple[int, ...], steps: int) -> NDArray[np.float32]:
    """The first actions of a random walk, float32 (steps, 6), uniform in [-1, 1].

    The key of their stream is all that has to be kept of them; fewer steps are the beginning of
    more.
    """
    return generator_of(key).uniform(-1, 1, (steps, 6)).astype(np.float32)
