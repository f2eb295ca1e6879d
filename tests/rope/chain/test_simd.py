"""Lanes reckon as NumPy does, each for itself."""

import math

import numpy as np
from numba import njit

from knotgym.rope.chain.simd import LANES, any_below, fma, load, put, where_below


@njit
def reckoned(one: np.ndarray, other: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(one)):
        x, y = load(one, (i, 1)), load(other, (i,))
        put(out, (i, 1), where_below(x, y, 1, -1))
        put(out, (i, 2), min(x, y))
        put(out, (i, 3), fma(x, y, -x * y))
        put(out, (i, 4), 7)
        x += 2 * y
        x -= 1
        x *= y / 3.0
        if any_below(y, 0.25):
            x = max(abs(-x), 0.5)
        put(out, (i, 0), math.sqrt(abs(x - y)))


def test_lanes_reckon_as_numpy_does_and_fma_rounds_once() -> None:
    rng = np.random.default_rng(0)
    one, other = rng.random((20, 2, LANES)), rng.random((20, LANES))
    one[0, 1, 0], other[0, 0] = 1 / 3, 3.0
    one[1, 1, 1] = np.nan  # in a comparison of its own lane alone
    out = np.empty((20, 5, LANES))
    reckoned(one, other, out)
    first = one[:, 1]
    x = (first + 2 * other - 1) * (other / 3.0)
    low = (other < 0.25).any(axis=1)
    assert 0 < low.sum() < 20
    x[low] = np.maximum(abs(x[low]), 0.5)
    assert np.array_equal(out[:, 0], np.sqrt(abs(x - other)), equal_nan=True)
    assert np.array_equal(out[:, 1], np.where(first < other, 1.0, -1.0))
    assert np.array_equal(np.delete(out[:, 2], 1, 0), np.delete(np.minimum(first, other), 1, 0))
    assert out[0, 3, 0] == -(2.0**-54)  # what the product's rounding to 1 left out
    assert (out[:, 4] == 7).all()
