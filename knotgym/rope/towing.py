"""Towing: displacement of a rope's centre from where the episode began.

The medium is viscous, so the centre follows the sum of all applied forces. A rope that is pulled in
one direction for long enough trails behind the pulled bead, stretches and untangles. A limit on the
displacement rules this out, but still allows pulls that cancel out over an episode.

After a change run `pytest tests/rope/test_towing.py`: the expert's plans must keep to the bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


def centres(points: ArrayLike) -> NDArray[np.float64]:
    """Return the mean vertex of each rope (n, beads, 3): float64 (n, 3), metres."""
    # Beads are alike and each lies between two vertices, so round the loop the mean vertex is their
    # centre of mass.
    mean: NDArray[np.float64] = np.asarray(points, dtype=np.float64).mean(axis=1)
    return mean


def distances_towed(points: ArrayLike, origins: ArrayLike) -> NDArray[np.float64]:
    """Return the distance of each rope's centre from its origin.

    Args:
        points: float64 (n, beads, 3), metres.
        origins: float64 (n, 3) or (3,), the `centres` at reset, metres.

    Returns:
        float64 (n,), metres.
    """
    distances: NDArray[np.float64] = np.linalg.norm(centres(points) - np.asarray(origins), axis=1)
    return distances


@dataclass(frozen=True, eq=False)
class TowBound:
    """Limit on the displacement of one rope's centre.

    Attributes:
        origin: float64 (3,), the centre at reset, metres.
        limit: largest allowed distance from the origin, metres.
    """

    origin: NDArray[np.float64]
    limit: float

    def exceeded(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return which configurations (n, beads, 3) exceed the limit: bool (n,)."""
        return distances_towed(points, self.origin) > self.limit
