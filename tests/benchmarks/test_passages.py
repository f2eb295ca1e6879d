"""`benchmarks/passages.py` sees strands that pass through each other, and nothing else."""

import json
import runpy
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from knotgym.drawing import drawn_curve
from knotgym.topology import GaussCode

from ..scripts import ROOT, run_script

SCRIPT = ROOT / "benchmarks" / "passages.py"
TREFOIL = GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c")


@pytest.fixture(scope="module")
def passages() -> dict[str, Any]:
    with mock.patch.object(sys, "path", [str(SCRIPT.parent), *sys.path]):
        return runpy.run_path(str(SCRIPT))


@pytest.mark.thorough
def test_switched_crossings_are_passages_and_a_turn_is_none(passages: dict[str, Any]) -> None:
    rope = drawn_curve(TREFOIL, np.random.default_rng(0))
    heights = np.linspace(1.0, -1.0, 102)[:, None, None]  # even: none is 0
    steps = rope * np.concatenate([np.ones((102, 1, 2)), heights], axis=2)
    changes = passages["linking"](steps[:-1], steps[1:])
    assert np.abs(changes - np.round(changes)).max() < 1e-9
    assert abs(changes.sum()) == pytest.approx(6)  # two for each of three crossings
    # turned about the x axis
    flat = (rope[:, 1] + 1j * rope[:, 2]) * np.exp(1j * np.linspace(0, 2 * np.pi, 100))[:, None]
    steps = np.stack([rope[:, 0] + 0 * flat.real, flat.real, flat.imag], axis=2)
    assert np.abs(passages["linking"](steps[:-1], steps[1:])).max() < 1e-9
    assert {tuple(passages["knot"](step)) for step in steps} == {tuple(passages["knot"](rope))}


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["chain", "mujoco"])
def test_hard_play_is_looked_at_and_goes_on(engine: str, tmp_path: Path) -> None:
    for slices in (1, 13):
        words = ("--ropes", 4, "--length", 1, "--actions", 4 * slices, "--out", tmp_path / "out")
        run_script(SCRIPT, "--engine", engine, *words)
        played = [json.loads(line) for line in (tmp_path / "out").read_text().splitlines()]
        assert [one["number"] for one in played] == [*range(slices)]
        counts = [one["counts"] for one in played]
        assert not any(one.get("passages", 0) + one["other knots"] for one in counts)
    assert [played[k]["shortest"] for k in (0, 6, 12)] == [False, False, engine == "chain"]
