"""A process keeps one simulation for each number of ropes and each configuration."""

from knotgym.rope.model import RopeConfig
from knotgym.rope.simulation_pool import simulation_of


def test_the_same_size_and_rope_are_the_same_simulation() -> None:
    assert simulation_of(2, RopeConfig()) is simulation_of(2, RopeConfig())


def test_another_size_or_rope_is_another_simulation() -> None:
    other = simulation_of(2, RopeConfig(max_force=0.1))
    assert simulation_of(3, RopeConfig()).count == 3
    assert other is not simulation_of(2, RopeConfig()) and other.rope.config.max_force == 0.1
