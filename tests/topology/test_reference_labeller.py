"""pyknotid as an independent labeller: it agrees with ours, and its problems are avoided."""

import numpy as np
import pytest

from knotgym.common import InvalidInput
from knotgym.topology.crossings import label
from knotgym.topology.reference_labeller import pyknotid_code

from .test_crossings import EIGHT, random_curve


def test_both_labellers_agree() -> None:
    """On 40 curves; `benchmarks/labels.py` compares millions of ropes with another labeller."""
    for seed in range(40):
        points = random_curve(seed, modes=1 + seed % 8)
        assert label(points) == pyknotid_code(points), seed


@pytest.mark.parametrize("scale", [1e-6, 0.013, 1.0, 1e6])
def test_scale_does_not_matter(scale: float) -> None:
    assert pyknotid_code(EIGHT * scale).chiral == "1+c,1-c"


def test_the_closing_edge_counts() -> None:
    for first in range(len(EIGHT)):
        assert pyknotid_code(np.roll(EIGHT, first, axis=0)).nx == 1


def test_numpy_gets_no_lasting_aliases() -> None:
    pyknotid_code(EIGHT)
    assert not {"float", "int", "complex"} & set(vars(np))


def test_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    pyknotid_code(EIGHT)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "points", [np.zeros((2, 3)), np.zeros((4, 2)), np.zeros((4, 3)), np.full((4, 3), np.nan)]
)
def test_no_curve_is_refused(points: np.ndarray) -> None:
    with pytest.raises(InvalidInput):
        pyknotid_code(points)
