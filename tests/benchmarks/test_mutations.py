"""Damaged files are refused, found or read right; the script that shows it counts every copy."""

import json
from pathlib import Path

import numpy as np
import pytest

from knotgym.states.state_file import read_states, shipped, write_states

from ..scripts import ROOT, run_script

COPIES = 4


@pytest.mark.slow  # tests/datasets/test_state_schema.py harms in the ways that there are
def test_no_damaged_file_ends_in_a_traceback_or_a_crash(tmp_path: Path) -> None:
    path = tmp_path / "states.h5"
    write_states(path, read_states(shipped()).taken(np.array([0])))
    out = tmp_path / "report.json"
    words = ("--count", COPIES, "--states", path, "--out", out)
    run_script(ROOT / "benchmarks" / "mutations.py", *words)
    report = json.loads(out.read_text(encoding="utf-8"))["states"]
    assert sum(sum(row.values()) for row in report["classes"].values()) == COPIES
    assert not [line for line in report["bad"] if ": wrong" not in line]


@pytest.mark.slow  # tests/runs/test_kills.py spoils checkpoints in the ways that there are
def test_no_damaged_checkpoint_is_gone_on_with(
    killed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved, out = killed.with_name(f".{killed.name}.partial") / "run.json", tmp_path / "report.json"
    words = ("--count", 6, "--searches", saved, "--out", out)
    run_script(ROOT / "benchmarks" / "mutations.py", *words)
    report = json.loads(out.read_text(encoding="utf-8"))["searches"]
    assert report["bad"] == []
    assert "| searches | 6 |" in capsys.readouterr().out
