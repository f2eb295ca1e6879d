"""A particle filter for the rope's position in the world, which no picture shows.

The camera follows the rope's middle (the mean of its beads), and an action names a point of the
world and pulls the bead nearest to it. So to pull a bead that is visible in the picture, the agent
must also know where the middle is. Each particle is one possible middle; observing which bead an
action moved reweights them. Positions are in metres.

After a change run what `shape_hypotheses` says.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Values below were set by hand; no record says what others would score.
PARTICLES = 384
# Standard deviation around a start position met in training, metres: smooths that empirical prior.
_START_NOISE = 0.02
# Prior probability that every particle is wrong and the rope lies where ropes start.
_RESTART = 0.02
# Standard deviation added after each pull, metres. It keeps resampled particles distinct and covers
# the error of the engine's predicted motion.
_DRIFT = 0.004
# Worth of pulling the intended bead, its neighbours, and theirs: neighbours move much alike.
_NEAR = np.array([1.0, 0.7, 0.3])
# Distances beyond a bead at which `aim` tries points, metres. A point farther out on the free side
# names the bead more robustly, but also comes nearer to beads of other strands.
_MARGINS = (0.0, 0.015, 0.04, 0.12, 0.5)
REACH = 2.0  # metres for which an action's coordinate of 1 stands


class PositionBelief:
    """Particles for the position of one rope's middle.

    Attributes:
        positions: float64 (PARTICLES, 3), metres, equally likely.
    """

    def __init__(self, starts: Array, rng: np.random.Generator) -> None:
        """Draw particles around `starts`, the start positions met in training, float64 (n, 3)."""
        self._rng = rng
        self._starts = starts
        self.positions: Array = self._draw_starts(PARTICLES)

    def aim(self, points: Array, bead: int) -> tuple[Array, float]:
        """Choose the point of the world that best names a bead.

        Args:
            points: float64 (beads, 3), the rope relative to its middle, metres.
            bead: to be pulled.

        Returns:
            The point, float64 (3,), and its expected worth in [0, 1], as `_NEAR` weighs beads.
        """
        middle = np.median(self.positions, axis=0)
        away = _directions(points, bead)
        candidates = np.concatenate([points[bead] + middle + margin * away for margin in _MARGINS])
        candidates = np.clip(candidates, -REACH, REACH)
        worth = _expected_worth(points, self.positions, candidates, bead, _NEAR)
        best = int(worth.argmax())
        return candidates[best], float(worth[best])

    def most_informative(self, points: Array) -> Array:
        """Choose a point whose pull would tell most about the position, float64 (3,).

        Which bead a named point pulls is a function of the particle, so the expected information
        gain is the entropy of the distribution over pulled beads.
        """
        some = points[self._rng.integers(len(points), size=24)]
        particles = self.positions[self._rng.integers(PARTICLES, size=24)]
        candidates = np.concatenate([some + particles, some + self.positions.mean(0)])
        distributions = [self.bead_probabilities(points, one) for one in candidates]
        entropy = [-(own[own > 0] * np.log(own[own > 0])).sum() for own in distributions]
        return candidates[int(np.argmax(entropy))]

    def bead_probabilities(self, points: Array, named: Array) -> Array:
        """Return the probability that naming a point pulls each bead, float64 (beads,)."""
        nearest = _nearest_beads(points, self.positions, named)
        return np.bincount(nearest, minlength=len(points)) / PARTICLES

    def update(self, points: Array, named: Array, likelihood: Array) -> None:
        """Reweight and resample the particles after a pull.

        Args:
            points: float64 (beads, 3), the rope before the pull, relative to its middle.
            named: float64 (3,), the point that the action named.
            likelihood: float64 (beads,), of the next picture if that bead was pulled.
        """
        # Fresh draws from the prior share the weight _RESTART, so that the filter recovers when no
        # particle explains what happened.
        positions = np.concatenate([self.positions, self._draw_starts(PARTICLES)])
        # the floor keeps weights normalizable where every likelihood underflows
        weights = likelihood[_nearest_beads(points, positions, named)] + 1e-9
        weights[:PARTICLES] *= 1 - _RESTART
        weights[PARTICLES:] *= _RESTART
        picked = self._rng.choice(len(positions), size=PARTICLES, p=weights / weights.sum())
        self.positions = positions[picked] + self._rng.normal(0, _DRIFT, (PARTICLES, 3))

    def shift(self, by: Array) -> None:
        """Move all particles by the middle's displacement, float64 (3,), metres."""
        self.positions = self.positions + by

    def _draw_starts(self, count: int) -> Array:
        drawn = self._starts[self._rng.integers(len(self._starts), size=count)]
        return drawn + self._rng.normal(0, _START_NOISE, (count, 3))


def _directions(points: Array, bead: int) -> Array:
    """Return unit vectors in which to look for a point that names a bead, float64 (n, 3)."""
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    around = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    # twelve horizontal, twelve each tilted up and down by 35 degrees, straight up and down
    tilted = np.concatenate([around + (0, 0, 0.7), around - (0, 0, 0.7), [(0, 0, 1), (0, 0, -1)]])
    # and away from the beads nearby: the side on which the bead is likely to be the nearest one
    others = points - points[bead]
    near = np.linalg.norm(others, axis=1)
    outward = -(others[near < 0.1]).mean(axis=0)[None]
    directions = np.concatenate([around, tilted, outward + 1e-9])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@njit(cache=True, nogil=True)
def _nearest_beads(points: Array, positions: Array, named: Array) -> NDArray[np.int64]:
    """Return, for each particle, the bead that naming a point would pull, int64 (particles,)."""
    found = np.empty(len(positions), np.int64)
    for k in range(len(positions)):
        # bead i lies at points[i] + positions[k]; moving the named point instead costs 3
        # subtractions per particle, not 3 per bead
        x = named[0] - positions[k, 0]
        y = named[1] - positions[k, 1]
        z = named[2] - positions[k, 2]
        best, at = np.inf, 0
        for i in range(len(points)):
            far = (points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2 + (points[i, 2] - z) ** 2
            if far < best:
                best, at = far, i
        found[k] = at
    return found


@njit(cache=True, nogil=True)
def _expected_worth(
    points: Array, positions: Array, candidates: Array, bead: int, near: Array
) -> Array:
    """Average over particles how well each candidate point names a bead, float64 (candidates,)."""
    worth = np.zeros(len(candidates))
    beads = len(points)
    for t in range(len(candidates)):
        found = _nearest_beads(points, positions, candidates[t])
        for k in range(len(positions)):
            # distance along the closed rope, either way round
            off = abs(found[k] - bead)
            off = min(off, beads - off)
            if off < len(near):
                worth[t] += near[off]
    return worth / len(positions)
