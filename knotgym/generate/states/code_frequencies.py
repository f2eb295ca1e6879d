"""How often a random policy meets each code: the published regime, in which few codes are most."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from knotgym.common.configuration import check_numbers
from knotgym.common.errors import KnotgymError
from knotgym.common.streams import Stream, generator
from knotgym.rope.model import Rope, RopeConfig
from knotgym.rope.simulation import Simulation
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import is_unknot


class NoFrequencies(KnotgymError, RuntimeError):
    """A random policy met no code with so many crossings."""


@dataclass(frozen=True, kw_only=True)
class FrequencyConfig:
    """How codes are counted.

    Attributes:
        ropes: that the random policy moves side by side.
        longest: actions after which they start over from the plain loop.
        frames: with the crossings asked for, after which to stop; plain loops need but one.
        most_actions: after which to stop in any case.
    """

    ropes: int = 64
    longest: int = 1000
    frames: int = 1000
    most_actions: int = 100_000

    def __post_init__(self) -> None:
        check_numbers(self, counts=("ropes", "longest", "frames", "most_actions"))


def frequencies(
    nx: int, frames: int, seed: int, rope: RopeConfig, config: FrequencyConfig
) -> Counter[GaussCode]:
    """Count the codes, without chirality, of frames with nx crossings that a random policy meets.

    Args:
        nx: crossings.
        frames: with nx crossings, after which to stop.
        seed: of the policy.
        rope: physics.
        config: how they are counted.
    """
    rng = generator(Stream.FREQUENCIES, seed, nx)
    simulation = Simulation(config.ropes, Rope(rope), threads=0)
    loop = np.repeat(simulation.rope.qpos(simulation.rope.loop())[None], config.ropes, axis=0)
    met: Counter[GaussCode] = Counter()
    for step in range(config.most_actions // config.ropes):
        if step % config.longest == 0:
            simulation.lay(loop)
        simulation.act(rng.uniform(-1, 1, (config.ropes, 6)).astype(np.float32))
        met.update(
            code.plain
            for code in label_many(simulation.points)
            if code.nx == nx and is_unknot(code)
        )
        if met.total() >= frames:
            break
    return met


def empirical_shares(
    nx: int, count: int, seed: int, rope: RopeConfig, config: FrequencyConfig
) -> dict[GaussCode, int]:
    """Draw `count` codes with nx crossings as a random policy meets them: code -> times drawn.

    Raises:
        NoFrequencies: it met none.
    """
    met = frequencies(nx, config.frames if nx else 1, seed, rope, config)
    if not met:
        raise NoFrequencies(
            f"a random policy met no code with {nx} crossings in {config.most_actions} actions;"
            " allow more"
        )
    codes = sorted(met, key=lambda code: code.visits)
    weights = np.array([met[code] for code in codes], dtype=np.float64)
    drawn = generator(Stream.FREQUENCY_SHARES, seed, nx).multinomial(count, weights / weights.sum())
    return {code: int(times) for code, times in zip(codes, drawn, strict=True) if times}
