"""How often a random policy meets each code: the published regime, where a handful of codes make up
most goals.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from knotgym.rope import Rope, RopeConfig
from knotgym.simulation import Simulation
from knotgym.streams import Stream, generator
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import is_unknot

ROPES = 64
LONGEST = 1000  # actions after which ropes start over from the plain loop


def frequencies(
    nx: int, frames: int, seed: int, rope: RopeConfig, most_actions: int = 100_000
) -> Counter[GaussCode]:
    """Roll a random policy out of the plain loop and count the codes, without chirality, of frames
    with nx crossings.

    Args:
        nx: crossings.
        frames: with nx crossings, after which to stop.
        seed: of the policy.
        rope: physics.
        most_actions: after which to stop in any case.
    """
    rng = generator(Stream.FREQUENCIES, seed, nx)
    simulation = Simulation(ROPES, Rope(rope), threads=0)
    loop = np.repeat(simulation.rope.qpos(simulation.rope.loop())[None], ROPES, axis=0)
    met: Counter[GaussCode] = Counter()
    for step in range(most_actions // ROPES):
        if step % LONGEST == 0:
            simulation.lay(loop)
        simulation.act(rng.uniform(-1, 1, (ROPES, 6)).astype(np.float32))
        met.update(
            code.plain
            for code in label_many(simulation.points)
            if code.nx == nx and is_unknot(code)
        )
        if met.total() >= frames:
            break
    return met


def empirical_shares(nx: int, count: int, seed: int, rope: RopeConfig) -> dict[GaussCode, int]:
    """Draw `count` codes with nx crossings as a random policy meets them: code -> how often it was
    drawn.
    """
    met = frequencies(nx, 1000 if nx else 1, seed, rope)
    codes = sorted(met, key=lambda code: code.visits)
    weights = np.array([met[code] for code in codes], dtype=np.float64)
    drawn = generator(Stream.FREQUENCY_SHARES, seed, nx).multinomial(count, weights / weights.sum())
    return {code: int(times) for code, times in zip(codes, drawn, strict=True) if times}
