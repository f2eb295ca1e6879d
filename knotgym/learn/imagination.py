"""Imagined ropes: the chain engine moves ropes that lie as the learner believes.

It is the engine of the house, `knotgym.rope.chain`, and gets nothing of the episode.
"""

import numpy as np
from numpy.typing import NDArray

from knotgym.rope import Array, ChainSimulation


def imagine(
    chain: ChainSimulation,
    points: Array,
    velocities: Array,
    beads: NDArray[np.int64],
    forces: Array,
) -> tuple[Array, Array]:
    """Predict what one action does to ropes.

    Args:
        chain: at least n ropes, overwritten.
        points, velocities: float64 (n, BEADS, 3), metres and m/s; left as they were.
        beads: int64 (n,), pulled.
        forces: float64 (n, 3), in units of the largest force.

    Returns:
        Points and velocities after it.
    """
    ids = np.arange(len(points))
    chain.lay_points(points, velocities, ids)
    chain.step(beads, chain.max_force * forces, ids)
    return chain.points[ids], chain.velocities(ids)
