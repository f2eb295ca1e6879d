"""The independent labeller of `benchmarks/labels.py` agrees with the package."""

import runpy

import numpy as np

from knotgym.states import read_states, shipped
from knotgym.topology import label_many

from ..scripts import ROOT

LABELS = runpy.run_path(str(ROOT / "benchmarks" / "labels.py"))


def test_two_labellers_agree_on_the_states_that_ship() -> None:
    points = read_states(shipped(), images=False).points
    codes, margins = LABELS["labels"](points)
    assert codes == [code.chiral for code in label_many(points)]
    assert (margins > LABELS["MARGIN"]).all()


def test_a_strand_switched_at_a_crossing_is_another_code() -> None:
    points = read_states(shipped(), images=False).points
    codes, _ = LABELS["labels"](points * np.array([1.0, 1.0, -1.0]))
    ours = [code.chiral for code in label_many(points)]
    assert [one == other for one, other in zip(codes, ours, strict=True)] == [not c for c in ours]
