"""Runs make the arrays that they made, and survive kills, company and changed bytes."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from pytest_types import Capture

from ..scripts import ROOT, run_script

FOLDER = ROOT / "benchmarks"


def figures(name: str, folder: Path, *words: object) -> dict[str, Any]:
    """What a benchmark writes to --out; every number in it is finite."""
    out = folder / f"{name}.json"
    run_script(FOLDER / f"{name}.py", *words, "--out", out)
    text = out.read_text(encoding="utf-8")
    assert re.search(r"\d", text) and not re.search(r"\b(NaN|Infinity)\b", text)
    written: dict[str, Any] = json.loads(text)
    return written


@pytest.mark.thorough
def test_golden_runs_make_the_arrays_that_they_made(capsys: Capture) -> None:
    with pytest.raises(SystemExit) as ended:
        run_script(FOLDER / "golden.py", "--compare", ROOT / "tests/data/golden.json")
    assert ended.value.code == 0, capsys.readouterr().out


@pytest.mark.slow
def test_a_collection_that_is_killed_ends_with_the_same_bytes(tmp_path: Path) -> None:
    told = figures("kills", tmp_path, "--kinds", "collect", "--kills", 1)["collect"]
    assert told["kills"] == told["finished"] == 1 and told["faults"] == []


@pytest.mark.slow
def test_commands_at_once_leave_one_output_and_a_changed_byte_is_found(tmp_path: Path) -> None:
    told = figures("together", tmp_path, "--kinds", "select", "--rounds", 1)["select"]
    assert told["rounds"] == 1 and told["faults"] == []
    told = figures("damage", tmp_path, "--kinds", "columns", "--changes", 2)["columns"]
    assert told["bytes"] > 0 and told["faults"] == []
