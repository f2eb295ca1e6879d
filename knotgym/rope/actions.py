"""Actions (x, y, z, fx, fy, fz) in [-1, 1], and the other forms that they have.

An action pulls the bead nearest to the point (x, y, z), given in units of `RopeConfig.reach`, with
the force (fx, fy, fz), given in units of `RopeConfig.max_force`.
Source: arXiv 2505.18028.

In the view "bead" the same pull is four whole numbers: the bead, and which of FORCE_CHOICES forces
each component has. These are evenly spaced from -1 to 1.

A pull with a *quantized* force fits into four bytes: the bead, and three whole numbers of 1 / 127
of the largest force. Policies that pull beads quantize their forces, so that a recording of their
episodes is the starts and four bytes a step.

The medium is viscous, so a rope's centre follows the sum of all applied forces. A rope that is
pulled in one direction for long enough trails behind the pulled bead, stretches and untangles. A
`TowBound` rules this out, but still allows pulls that cancel out over an episode.

After a change run `pytest tests/rope/test_simulations.py tests/rope/test_towing.py
tests/envs/test_action_views.py`: what was encoded must be decoded, and the expert's plans keep to
the bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array, InvalidInput, Stream

_ROUNDING = 1e-6  # tolerance for float32 rounding of actions beyond 1; they are clipped to 1
FORCE_BINS = 127  # a quantized force component is a whole multiple of 1 / 127 of the largest
# Odd, so that one of the forces is exactly 0. Of 64 of the expert's plans (tie nx 2, convert nx 3)
# that are binned and replayed blindly, 43 still end in the same code with 11 choices, 29 with 5, 48
# with 31; after one action the farthest bead is 3 mm off with 11, 8 mm with 5, 1 mm with 31.
FORCE_CHOICES = 11
# A pass takes 9 on average (notes/experiments.md). With another number decisions have another
# width, and sets and learners of them can't be used any more.
LONGEST = 10  # pulls of a macro-action or of a decision, at most
NEAR = 1 / 3  # metres from the rope's centre that 1 stands for in a decision; ropes are 0.2 m wide


def nearest_beads(points: Array, positions: Array) -> NDArray[np.int64]:
    """Find the vertex of each rope (n, beads, 3) nearest to its position (n, 3): int64 (n,).

    It is the first one if several are equally near.
    """
    # Squared distances: their order is the same, and a root would only round. An axis at a time, as
    # NumPy's sums over an axis of three take four times as long.
    squares = [(points[..., axis] - positions[:, axis, None]) ** 2 for axis in range(3)]
    return np.argmin(squares[0] + squares[1] + squares[2], axis=1)


def checked(actions: ArrayLike, shape: tuple[int, int], what: str, counts: Any = None) -> Array:
    """Return actions as float64, those in [-1, 1] clipped to it.

    Args:
        actions: any numbers.
        shape: that they must have, ropes and numbers of an action.
        what: an action is, in words, for the error.
        counts: how many values each whole number has; None for numbers in [-1, 1].

    Raises:
        InvalidInput: they have another shape, or a number is NaN or out of range.
    """
    a = np.asarray(actions, dtype=np.float64)
    if a.shape != shape:
        raise InvalidInput(f"{what}; got shape {a.shape} for {shape[0]} ropes")
    if counts is None:
        # Actions of float32 may be beyond 1 by their rounding. Clipping keeps the largest force the
        # largest, so a replay of stored actions applies what was applied.
        fits, kept = np.abs(a) <= 1 + _ROUNDING, np.clip(a, -1, 1)
    else:
        # equal to their rounded values, so that an integer in a float array is taken, and NaN isn't
        fits, kept = (a == np.rint(a)) & (a >= 0) & (a < counts), a
        what += f" below {counts.tolist()}"
    bad = ~fits.all(axis=1)
    if bad.any():
        raise InvalidInput(f"{what}, got {a[bad][0].tolist()}")
    return kept


def quantized(forces: ArrayLike) -> Array:
    """Round forces in units of the largest force to whole multiples of 1 / FORCE_BINS.

    The result holds the float32 numbers of an action, so what is simulated with it is what the
    action does.
    """
    # + 0.0 makes -0.0 to 0.0, which a whole number can't tell apart
    bins = np.rint(np.asarray(forces, dtype=np.float64) * FORCE_BINS) + 0.0
    return (bins / FORCE_BINS).astype(np.float32).astype(np.float64)


def drawn_actions(key: tuple[int, ...], steps: int) -> NDArray[np.float32]:
    """Draw the actions of a random walk, float32 (steps, 6), uniform in [-1, 1].

    The walk can be reproduced from the key of its random stream alone. A shorter walk with the
    same key is a prefix of a longer one.
    """
    return Stream.generator_of(key).uniform(-1, 1, (steps, 6)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class TowBound:
    """Limit on the displacement of one rope's centre, or of each of n.

    Attributes:
        origin: float64 (3,) or (n, 3), the centre at reset, metres.
        limit: largest allowed distance from the origin, metres; or (n,).
    """

    origin: Array
    limit: Any

    @staticmethod
    def centres(points: ArrayLike) -> Array:
        """Return the mean vertex of each rope (n, beads, 3): float64 (n, 3), metres."""
        # Beads are alike and each lies between two vertices, so round the loop the mean vertex is
        # their centre of mass.
        return np.asarray(points, dtype=np.float64).mean(axis=1)

    def exceeded(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return which configurations (n, beads, 3) exceed the limit: bool (n,)."""
        towed = np.linalg.norm(self.centres(points) - self.origin, axis=1)
        return ~np.asarray(towed <= self.limit)  # NaN is beyond, too
