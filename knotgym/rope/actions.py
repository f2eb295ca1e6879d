"""Conversion between actions (x, y, z, fx, fy, fz) in [-1, 1] and beads with forces.

An action pulls the bead nearest to the point (x, y, z), given in units of `RopeConfig.reach`, with
the force (fx, fy, fz), given in units of `RopeConfig.max_force`.
Source: arXiv 2505.18028.

In the view "bead" the same pull is four whole numbers: the bead, and which of FORCE_CHOICES forces
each component has. These are evenly spaced from -1 to 1.

A pull with a *quantized* force fits into four bytes: the bead, and three whole numbers of 1 / 127
of the largest force. The float32 numbers of its action give the bytes back, and the bytes the
action. Policies that pull beads quantize their forces, so an episode of theirs is its start and
four bytes a step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.errors import InvalidInput
from knotgym.common.streams import generator_of

if TYPE_CHECKING:
    from knotgym.rope.model import RopeConfig  # not at run time, so that loaders need no simulator

Array = NDArray[np.float64]

FORCE_BINS = 127  # a quantized force component is a whole multiple of 1 / 127 of the largest
# Odd, so that one of the forces is exactly 0. Of 64 of the expert's plans (tie nx 2, convert nx 3)
# that are binned and replayed blindly, 43 still end in the same code with 11 choices, 29 with 5, 48
# with 31; after one action the farthest bead is 3 mm off with 11, 8 mm with 5, 1 mm with 31.
FORCE_CHOICES = 11
# Values of each whole number of an action, by view; 0 stands for the number of beads.
CHOICES = {"bead": (0, FORCE_CHOICES, FORCE_CHOICES, FORCE_CHOICES), "macro": (0, 0, 2)}


def decode_actions(
    actions: ArrayLike, points: Array, rope: RopeConfig
) -> tuple[NDArray[np.int64], Array]:
    """Convert actions to beads and forces.

    Args:
        actions: (n, 6), in [-1, 1].
        points: float64 (n, beads, 3), metres: each rope's vertices when the action is taken.
        rope: supplies `reach` and `max_force`.

    Returns:
        beads int64 (n,); forces float64 (n, 3), newtons.
    """
    a = np.asarray(actions, dtype=np.float64)
    offset = points - rope.reach * a[:, None, :3]
    return np.argmin((offset**2).sum(axis=2), axis=1), rope.max_force * a[:, 3:]


def encode_actions(
    beads: ArrayLike, forces: ArrayLike, points: Array, rope: RopeConfig
) -> NDArray[np.float32]:
    """Convert beads and forces to actions; the inverse of `decode_actions`.

    Args:
        beads: int (n,).
        forces: (n, 3), newtons; components are clipped to `max_force`.
        points, rope: as in `decode_actions`.

    Returns:
        float32 (n, 6).
    """
    position = points[np.arange(len(points)), np.asarray(beads)] / rope.reach
    force = np.asarray(forces, dtype=np.float64) / rope.max_force
    return np.clip(np.concatenate([position, force], axis=1), -1, 1).astype(np.float32)


def quantized(forces: ArrayLike) -> Array:
    """Round forces in units of the largest force to whole multiples of 1 / FORCE_BINS.

    The result holds the float32 numbers of an action, so what is simulated with it is what the
    action does.
    """
    # + 0.0 makes -0.0 to 0.0, which a whole number can't tell apart
    bins = np.rint(np.asarray(forces, dtype=np.float64) * FORCE_BINS) + 0.0
    return (bins / FORCE_BINS).astype(np.float32).astype(np.float64)


def encode_pulls(actions: ArrayLike, points: Array, rope: RopeConfig) -> NDArray[np.int8]:
    """Convert actions with quantized forces to four bytes each; the inverse of `decode_pulls`.

    Args:
        actions, points, rope: as in `decode_actions`.

    Returns:
        int8 (n, 4): the bead, as an unsigned byte, and three multiples of 1 / FORCE_BINS.

    Raises:
        InvalidInput: an action isn't what `decode_pulls` gives, or the rope has too many beads.
    """
    if points.shape[1] > 256:
        raise InvalidInput(f"a pull's bead is one byte, got a rope of {points.shape[1]} beads")
    beads, _ = decode_actions(actions, points, rope)
    given = np.ascontiguousarray(actions, dtype=np.float32)
    bins = np.rint(given[:, 3:] * FORCE_BINS)
    pulls = np.concatenate([beads[:, None].astype(np.uint8).view(np.int8), bins], axis=1)
    pulls = pulls.astype(np.int8)
    # bit by bit: -0.0 equals 0.0, but isn't the same
    decoded = decode_pulls(pulls, points, rope).view(np.uint32)
    off = np.flatnonzero((decoded != given.view(np.uint32)).any(axis=1))
    if len(off):
        raise InvalidInput(
            f"an action must pull a bead at its vertex with multiples of 1/{FORCE_BINS} of the"
            f" largest force, got {given[off[0]].tolist()}"
        )
    return pulls


def decode_pulls(pulls: NDArray[np.int8], points: Array, rope: RopeConfig) -> NDArray[np.float32]:
    """Convert four bytes (n, 4) to actions, float32 (n, 6)."""
    forces = quantized(pulls[:, 1:] / FORCE_BINS) * rope.max_force
    return encode_actions(np.ascontiguousarray(pulls[:, 0]).view(np.uint8), forces, points, rope)


def steps_taken(
    actions: ArrayLike, points: Array, rope: RopeConfig
) -> tuple[NDArray[np.int64], Array]:
    """Return the bead and the requested force that led to each state of an episode.

    Args:
        actions: (T, 6).
        points: float64 (T + 1, beads, 3), metres: the states before and after the actions.
        rope: supplies `reach` and `max_force`.

    Returns:
        beads int64 (T + 1,) and requested forces float64 (T + 1, 3), newtons; the first state, to
        which no action led, has bead -1 and force 0.
    """
    beads, forces = decode_actions(actions, points[:-1], rope)
    return np.concatenate([[-1], beads]), np.concatenate([np.zeros((1, 3)), forces])


def drawn_actions(key: tuple[int, ...], steps: int) -> NDArray[np.float32]:
    """Draw the actions of a random walk, float32 (steps, 6), uniform in [-1, 1].

    The walk can be reproduced from the key of its random stream alone. A shorter walk with the
    same key is a prefix of a longer one.
    """
    return generator_of(key).uniform(-1, 1, (steps, 6)).astype(np.float32)


def force_choices(forces: ArrayLike) -> NDArray[np.int64]:
    """Return the nearest choice for each force component in [-1, 1], int64 of the same shape.

    >>> force_choices([-1.0, 0.0, 0.97]).tolist()
    [0, 5, 10]
    """
    half = (FORCE_CHOICES - 1) // 2
    return np.rint(half * (1 + np.asarray(forces, dtype=np.float64))).astype(np.int64)


def chosen_forces(chosen: ArrayLike) -> Array:
    """Return the force component, quantized, that each choice means.

    >>> chosen_forces([0, 5, 10]).tolist()
    [-1.0, 0.0, 1.0]
    """
    half = (FORCE_CHOICES - 1) // 2
    return quantized((np.asarray(chosen, dtype=np.float64) - half) / half)


def choices(view: str, beads: int) -> NDArray[np.int64]:
    """Return how many values each whole number of an action of a view has.

    >>> choices("macro", 100).tolist()
    [100, 100, 2]
    """
    counts = np.array(CHOICES[view])
    return np.where(counts, counts, beads)
