"""What the first minute compiles: nothing twice."""

import runpy

import pytest

from ..scripts import ROOT

FIRST = """
import gymnasium, knotgym
env = gymnasium.make("knotgym/Tie-v0", nx=2, engine="chain")
env.reset(seed=0)
env.step(env.action_space.sample())
"""


@pytest.mark.thorough  # compiles for half a minute
def test_the_first_step_compiles_each_function_once_and_no_error_message() -> None:
    script = runpy.run_path(str(ROOT / "benchmarks/compiled.py"))
    lines = script["compiled"](["-c", FIRST])
    assert script["twice"](lines) == ([], [])
    names = [name for _, name, *_ in lines]
    assert "knotgym.rope.chain.solver.advance" in names
    assert not [name for name in names if "unicode" in name]  # of a slice assignment's message
    assert len(lines) < 120
