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


def test_its_scale_prints_and_patches_of_numpy_are_kept_from_users(
    capfd: pytest.CaptureFixture[str],
) -> None:
    for scale in (1e-6, 0.013, 1.0, 1e6):
        assert pyknotid_code(EIGHT * scale).chiral == "1+c,1-c"
    assert not {"float", "int", "complex"} & set(vars(np))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "points", [np.zeros((2, 3)), np.zeros((4, 2)), np.zeros((4, 3)), np.full((4, 3), np.nan)]
)
def test_no_curve_is_refused(points: np.ndarray) -> None:
    with pytest.raises(InvalidInput):
        pyknotid_code(points)
