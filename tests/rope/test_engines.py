"""Engines are chosen by name; a process shares one simulation per engine, size and rope."""

import subprocess
import sys

import pytest

from knotgym.rope.engines import ENGINES, simulation, simulation_of
from knotgym.rope.model import RopeConfig


@pytest.mark.parametrize("engine", ENGINES)
def test_a_simulation_is_of_the_engine_that_was_named(engine: str) -> None:
    made = simulation(engine, 2)
    assert made.engine == engine and made.count == 2
    assert made.applied_shares.tolist() == [1, 1]


def test_the_same_engine_size_and_rope_are_the_same_simulation() -> None:
    assert simulation_of(2, RopeConfig()) is simulation_of(2, RopeConfig())


def test_another_engine_size_or_rope_is_another_simulation() -> None:
    other = simulation_of(2, RopeConfig(max_force=0.1))
    assert simulation_of(3, RopeConfig()).count == 3
    assert other is not simulation_of(2, RopeConfig()) and other.rope.config.max_force == 0.1
    assert simulation_of(2, RopeConfig(), "chain").engine == "chain"


@pytest.mark.thorough
def test_mujocos_engine_leaves_the_chains_kernels_alone() -> None:
    code = (
        "import sys, gymnasium, knotgym\n"
        "gymnasium.make('knotgym/Tie-v0', nx=2).reset(seed=0)\n"
        "print([name for name in sys.modules if name.startswith('knotgym.rope.chain')])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
