"""Rope states for the other scripts: ropes that random pulls have tangled, none chosen."""

from collections.abc import Iterator

import numpy as np

from knotgym.common import Array
from knotgym.generate import PhasedPulls
from knotgym.rope import CHAIN, RopeConfig, simulation_of
from knotgym.topology import label

ROPES, EVERY = 64, 4  # ropes side by side; pulls between two looks at a rope


def tangled(
    count: int, rng: np.random.Generator, least: int = 1, most: int = 15
) -> Iterator[Array]:
    """Yield `count` configurations (beads, 3) with `least` to `most` crossings."""
    simulation = simulation_of(ROPES, RopeConfig(), CHAIN)
    start = simulation.rope.qpos(PhasedPulls.coil(simulation.rope))
    simulation.set_qpos(np.repeat(start[None], ROPES, axis=0))
    given = 0
    while given < count:
        for _ in range(EVERY):
            simulation.act(rng.uniform(-1, 1, (ROPES, 6)).astype(np.float32))
        for points in simulation.points:
            if given < count and least <= label(points).nx <= most:
                yield points.copy()
                given += 1
