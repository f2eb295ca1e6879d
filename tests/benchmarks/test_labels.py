"""The independent labeller of `benchmarks/labels.py` agrees with the package."""

import runpy

import numpy as np
import pytest

from knotgym.states import read_states, shipped
from knotgym.topology import label_many

from ..scripts import ROOT

pytestmark = pytest.mark.thorough
LABELS = runpy.run_path(str(ROOT / "benchmarks" / "labels.py"))


def test_two_labellers_agree_and_a_strand_switched_at_a_crossing_is_another_code() -> None:
    points = read_states(shipped(), images=False).points
    switched = points * np.array([1.0, 1.0, -1.0])
    for ropes in (points, switched):
        same, exact = LABELS["compare"](ropes)
        assert same.all() and not exact
    for row, code in zip(range(0, len(points), 16), label_many(points[::16]), strict=True):
        found, margin = LABELS["labels"](points[row])
        assert found == code.chiral and margin > 1
        assert (LABELS["labels"](switched[row])[0] == code.chiral) == (not code.chiral)


def test_strands_that_are_as_high_as_each_other_are_unclear() -> None:
    points = read_states(shipped(), images=False).points[-4:] * np.array([1.0, 1.0, 0.0])
    exact = LABELS["compare"](points)[1]
    assert len(exact) == 4 and all(margin <= 1 for _, margin in exact.values())
