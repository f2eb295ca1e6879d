"""Where the rope is in the world, which no picture shows: a belief, sharpened by what pulls do.

The camera follows the rope's middle, and an action names a point of the world, whose nearest bead
is pulled. So a bead that is seen can only be named as far as the middle's place is known. Places
that it may have are kept as particles; which bead moved tells them apart.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

PARTICLES = 384
_BLUR = 0.02  # metres, of a place met in training
_FRESH = 0.02  # how likely it is that the particles are all wrong, and it lies where ropes begin
_DRIFT = 0.004  # metres, how much less is known after a pull
_NEAR = np.array([1.0, 0.7, 0.3])  # worth of a bead so many beads off the one that is meant
_MARGINS = (0.0, 0.015, 0.04, 0.12, 0.5)  # metres beyond a bead that a point may lie
_REACH = 2.0  # metres that an action's coordinate of 1 stands for


class Whereabouts:
    """The belief of one episode.

    Attributes:
        places: float64 (PARTICLES, 3), metres.
    """

    def __init__(self, met: Array, rng: np.random.Generator) -> None:
        """Begin with the places met in training, float64 (n, 3)."""
        self._rng = rng
        self._met = met
        self.places: Array = self._drawn(PARTICLES)

    def aim(self, points: Array, bead: int) -> tuple[Array, float]:
        """The point of the world to name for a bead, and how well it names it, in [0, 1]."""
        middle = np.median(self.places, axis=0)
        away = _directions(points, bead)
        tries = np.concatenate([points[bead] + middle + margin * away for margin in _MARGINS])
        tries = np.clip(tries, -_REACH, _REACH)
        worth = _worth(points, self.places, tries, bead, _NEAR)
        best = int(worth.argmax())
        return tries[best], float(worth[best])

    def probe(self, points: Array) -> Array:
        """The point to name that tells most of where the rope is."""
        some = points[self._rng.integers(len(points), size=24)]
        tries = np.concatenate(
            [some + self.places[self._rng.integers(PARTICLES, size=24)], some + self.places.mean(0)]
        )
        shares = [self.shares(points, one) for one in tries]
        entropy = [-(own[own > 0] * np.log(own[own > 0])).sum() for own in shares]
        return tries[int(np.argmax(entropy))]

    def shares(self, points: Array, named: Array) -> Array:
        """How likely each bead is pulled by naming a point, float64 (beads,)."""
        return np.bincount(_nearest(points, self.places, named), minlength=len(points)) / PARTICLES

    def pulled(self, points: Array, named: Array, likelihood: Array) -> None:
        """Learn from a pull: likelihood (beads,) of what was seen after, for each bead."""
        places = np.concatenate([self.places, self._drawn(PARTICLES)])
        weights = likelihood[_nearest(points, places, named)] + 1e-9
        weights[:PARTICLES] *= 1 - _FRESH
        weights[PARTICLES:] *= _FRESH
        picked = self._rng.choice(len(places), size=PARTICLES, p=weights / weights.sum())
        self.places = places[picked] + self._rng.normal(0, _DRIFT, (PARTICLES, 3))

    def _drawn(self, count: int) -> Array:
        drawn = self._met[self._rng.integers(len(self._met), size=count)]
        return drawn + self._rng.normal(0, _BLUR, (count, 3))

    def moved(self, by: Array) -> None:
        """The middle moved, (3,), metres."""
        self.places = self.places + by


def _directions(points: Array, bead: int) -> Array:
    """Unit vectors away from a bead, float64 (n, 3): all around, and away from the others."""
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    around = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    tilted = np.concatenate([around + (0, 0, 0.7), around - (0, 0, 0.7), [(0, 0, 1), (0, 0, -1)]])
    others = points - points[bead]
    near = np.linalg.norm(others, axis=1)
    outward = -(others[near < 0.1]).mean(axis=0)[None]
    all_of = np.concatenate([around, tilted, outward + 1e-9])
    return all_of / np.linalg.norm(all_of, axis=1, keepdims=True)


@njit(cache=True, nogil=True)
def _nearest(points: Array, places: Array, named: Array) -> NDArray[np.int64]:
    found = np.empty(len(places), np.int64)
    for k in range(len(places)):
        x, y, z = named[0] - places[k, 0], named[1] - places[k, 1], named[2] - places[k, 2]
        best, at = np.inf, 0
        for i in range(len(points)):
            far = (points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2 + (points[i, 2] - z) ** 2
            if far < best:
                best, at = far, i
        found[k] = at
    return found


@njit(cache=True, nogil=True)
def _worth(points: Array, places: Array, tries: Array, bead: int, near: Array) -> Array:
    worth = np.zeros(len(tries))
    beads = len(points)
    for t in range(len(tries)):
        found = _nearest(points, places, tries[t])
        for k in range(len(places)):
            off = abs(found[k] - bead)
            off = min(off, beads - off)
            if off < len(near):
                worth[t] += near[off]
    return worth / len(places)
