"""Codes drawn at random: every planar one, each as likely as any other."""

from collections import Counter

import numpy as np
import pytest

from knotgym.topology.diagrams import planar_codes, uniform_code


def chi_square(counts: Counter[str], kinds: int) -> float:
    """Pearson's statistic against the uniform distribution, per degree of freedom."""
    expected = counts.total() / kinds
    missing = (kinds - len(counts)) * expected
    off = sum((count - expected) ** 2 / expected for count in counts.values())
    return (off + missing) / (kinds - 1)


@pytest.mark.parametrize(("nx", "draws"), [(1, 100), (2, 400), (3, 2000)])
def test_every_planar_code_is_as_likely_as_any_other(nx: int, draws: int) -> None:
    rng = np.random.default_rng(nx)
    counts = Counter(str(uniform_code(nx, rng)) for _ in range(draws))
    codes = {str(code) for code in planar_codes(nx)}
    assert set(counts) == codes
    assert chi_square(counts, len(codes)) < 2


def test_the_same_generator_draws_the_same_code() -> None:
    one, other = (uniform_code(8, np.random.default_rng(3)) for _ in range(2))
    assert one == other and one.nx == 8
