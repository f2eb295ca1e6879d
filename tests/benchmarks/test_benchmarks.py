"""Runs make the arrays that they made."""

import pytest
from pytest_types import Capture

from ..scripts import ROOT, run_script

FOLDER = ROOT / "benchmarks"


@pytest.mark.thorough
def test_golden_runs_make_the_arrays_that_they_made(capsys: Capture) -> None:
    run_script(FOLDER / "golden.py", "--compare", ROOT / "tests/data/golden.json")
    assert "nothing differs" in capsys.readouterr().out
