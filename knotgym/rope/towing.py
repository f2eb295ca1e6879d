"""Towing: how far a rope's centre has been taken from where it began.

The medium is viscous, so the centre moves as the sum of all forces does, and a rope pulled one way
long enough trails behind its bead, stretched and untangled. A bound on the centre's way leaves an
agent its hands, whose pulls cancel out over an episode, and takes the towing away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


def centres(points: ArrayLike) -> NDArray[np.float64]:
    """Mean vertices of ropes (n, beads, 3): float64 (n, 3), metres."""
    mean: NDArray[np.float64] = np.asarray(points, dtype=np.float64).mean(axis=1)
    return mean


def distances_towed(points: ArrayLike, origins: ArrayLike) -> NDArray[np.float64]:
    """How far the centres of ropes are from where they began.

    Args:
        points: float64 (n, beads, 3), metres.
        origins: float64 (n, 3) or (3,), the `centres` at reset, metres.

    Returns:
        float64 (n,), metres.
    """
    far: NDArray[np.float64] = np.linalg.norm(centres(points) - np.asarray(origins), axis=1)
    return far


@dataclass(frozen=True, eq=False)
class TowBound:
    """Where the centre of one rope may be.

    Attributes:
        origin: float64 (3,), of the centre at reset, metres.
        limit: metres that it may be from there.
    """

    origin: NDArray[np.float64]
    limit: float

    @classmethod
    def of_episode(cls, points: ArrayLike, limit: float) -> TowBound:
        """The bound of an episode that goes through `points`, float64 (T + 1, beads, 3)."""
        return cls(centres(np.asarray(points)[:1])[0], limit)

    def exceeded(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which configurations (n, beads, 3) of the rope lie beyond: bool (n,)."""
        return distances_towed(points, self.origin) > self.limit
