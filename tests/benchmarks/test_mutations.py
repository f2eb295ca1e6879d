"""Damaged files are refused, found or read right; the script that shows it counts every copy."""

from pathlib import Path

import numpy as np

from benchmarks.mutations import CLASSES, run
from knotgym.datasets.states import read_states, shipped, write_states


def test_no_damaged_file_ends_in_a_traceback_or_a_crash(tmp_path: Path) -> None:
    path = tmp_path / "states.h5"
    write_states(path, read_states(shipped()).taken(np.array([0])))
    report = run({"states": path}, len(CLASSES))
    assert sum(sum(row.values()) for row in report["counts"].values()) == len(CLASSES)
    assert not [line for line in report["bad"] if ": wrong" not in line]
