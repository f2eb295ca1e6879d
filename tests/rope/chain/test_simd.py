"""Lanes reckon as NumPy does, each for itself."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from numba import njit

from knotgym.rope.chain.simd import LANES, NUMBA, any_below, fma, load, put, where_below

from ...scripts import ROOT


@njit
def reckoned(one: np.ndarray, other: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(one)):
        x, y = load(one, (i, 1)), load(other, (i,))
        x += 2 * y
        x -= 1
        x *= y / 3.0
        if any_below(y, 0.25):
            x = max(abs(-x), 0.5)
        put(out, (i,), math.sqrt(abs(x - y)))


def test_numba_is_bounded_as_in_the_package() -> None:
    (low, high), text = NUMBA, (ROOT / "pyproject.toml").read_text("utf-8")
    assert f'"numba>={low[0]}.{low[1]},<{high[0]}.{high[1]}"' in text


@pytest.mark.parametrize("version", [(0, 60), (0, 69), (1, 0)])
def test_another_numba_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, version: tuple[int, int]
) -> None:
    monkeypatch.setattr("numba.version_info", SimpleNamespace(short=version))
    source = (ROOT / "knotgym" / "rope" / "chain" / "simd.py").read_text("utf-8")
    with pytest.raises(ImportError, match=r"from 0\.61 to before 0\.69, installed is"):
        exec(compile(source.partition("# Four float64 fill")[0], "simd", "exec"), {})


def test_lanes_reckon_as_numpy_does() -> None:
    rng = np.random.default_rng(0)
    one, other = rng.random((20, 2, LANES)), rng.random((20, LANES))
    out = np.empty((20, LANES))
    reckoned(one, other, out)
    x = (one[:, 1] + 2 * other - 1) * (other / 3.0)
    low = (other < 0.25).any(axis=1)
    assert 0 < low.sum() < 20
    x[low] = np.maximum(abs(x[low]), 0.5)
    assert np.array_equal(out, np.sqrt(abs(x - other)))


def test_a_number_goes_into_every_lane() -> None:
    @njit
    def fill(array: np.ndarray) -> None:
        put(array, (1,), 7)

    array = np.zeros((2, LANES))
    fill(array)
    assert array.tolist() == [[0.0] * LANES, [7.0] * LANES]


@njit
def chosen(one: np.ndarray, other: np.ndarray, out: np.ndarray) -> None:
    x, y = load(one, (0,)), load(other, (0,))
    put(out, (0,), where_below(x, y, 1, -1))
    put(out, (1,), min(x, y))
    put(out, (2,), fma(x, y, -x * y))


def test_lanes_choose_and_round_once() -> None:
    one, other = np.full((1, LANES), 1 / 3), np.full((1, LANES), 3.0)
    one[0, 0], other[0, 1] = 5.0, np.nan
    out = np.empty((3, LANES))
    chosen(one, other, out)
    assert out[0].tolist() == [-1.0, -1.0, *[1.0] * (LANES - 2)]
    assert out[1, 0] == 3.0 and (out[1, 2:] == 1 / 3).all()
    assert out[2, 2] == -(2.0**-54)  # what the product's rounding to 1 left out
