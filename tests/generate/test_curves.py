"""Curves that begin a rope as a knot, by name and from files; any other file is refused."""

from pathlib import Path

import numpy as np
import pytest

from knotgym.generate.states.curves import (
    KNOTS,
    InvalidCurveFile,
    LoopConfig,
    knot_curve,
    knot_of,
    plain_loop,
)
from knotgym.quality.measures import Limits, measure
from knotgym.rope.model import InvalidCurve, Rope
from knotgym.states.spread import spread_of
from knotgym.topology.crossings import label
from knotgym.topology.knots import knot_type

from ..conftest import curled, trefoil


@pytest.mark.parametrize("knot", list(KNOTS))
def test_a_named_curve_is_certified_as_what_it_is_named(knot: str) -> None:
    assert knot_of(knot) == knot


@pytest.mark.parametrize("knot", list(KNOTS))
def test_a_named_curve_becomes_a_rope(rope: Rope, knot: str) -> None:
    assert knot_type(label(rope.from_curve(knot_curve(knot)))) == knot


def test_plain_loops_are_legible_and_unlike_each_other(rope: Rope) -> None:
    rng = np.random.default_rng(0)
    loops = [plain_loop(rope, LoopConfig(), Limits(), rng) for _ in range(6)]
    for points in loops:
        assert label(points).nx == 0 and not Limits().faults(measure(points), 0)
    spread = spread_of(np.stack(loops))
    assert spread.shape is not None and spread.shape[0] > 0.06


def test_a_plain_loop_that_cannot_be_drawn_is_the_circle(rope: Rope) -> None:
    strict = Limits(crossing_angle=91.0)
    points = plain_loop(rope, LoopConfig(draws=2), strict, np.random.default_rng(0))
    assert np.array_equal(points, rope.loop())


def test_a_curve_is_read_from_text_from_csv_and_from_npy(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.txt", trefoil())
    np.savetxt(tmp_path / "a.csv", trefoil(), delimiter=",")
    np.save(tmp_path / "a.npy", trefoil())
    for path in tmp_path.iterdir():
        assert np.array_equal(knot_curve(str(path)), trefoil()), path.name


def test_whole_numbers_are_read_as_numbers(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.arange(12).reshape(4, 3))
    assert knot_curve(str(tmp_path / "a.npy")).dtype == np.float64


def test_a_file_is_certified_whatever_it_is_called(tmp_path: Path) -> None:
    np.save(tmp_path / "unknown.npy", trefoil())
    np.save(tmp_path / "3_1.npy", curled(2))
    assert knot_of(tmp_path / "unknown.npy") == "3_1" and knot_of(tmp_path / "3_1.npy") == "0_1"


def test_an_unknown_name_is_told_what_there_is() -> None:
    with pytest.raises(
        InvalidCurveFile, match="no knot '9_42'; there is 0_1, 3_1, 4_1, 5_1, or a file"
    ):
        knot_curve("9_42")


@pytest.mark.parametrize("name", ["a.txt", "a.csv", "a.npy"])
@pytest.mark.parametrize(
    "content",
    [b"", b"# nothing\n", b"1 2 3\n4 5\n", b"one two three\n", bytes(range(256)), b"\x93NUMPY\x01"],
)
def test_a_file_without_numbers_is_refused_in_one_line(
    tmp_path: Path, name: str, content: bytes
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InvalidCurveFile, match=f"{name} holds no curve: .") as caught:
        knot_curve(str(tmp_path / name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "array", [np.array(["a", "b"]), trefoil() + 1j, np.array([{}, 1], dtype=object)]
)
def test_an_array_of_anything_but_real_numbers_is_refused(
    tmp_path: Path, array: np.ndarray
) -> None:
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(InvalidCurveFile, match="holds no curve"):
        knot_curve(str(tmp_path / "a.npy"))


def test_several_arrays_in_one_file_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", one=trefoil(), other=trefoil())
    (tmp_path / "a.npz").rename(tmp_path / "a.npy")
    with pytest.raises(InvalidCurveFile, match="it isn't one array of real numbers"):
        knot_curve(str(tmp_path / "a.npy"))


@pytest.mark.parametrize(
    ("curve", "problem"),
    [
        (np.eye(3), "at least 4 different points, got 3"),
        (trefoil()[:200], "isn't closed"),
        (trefoil()[:, :2], "an \\(n, 3\\) array"),
        (np.full((9, 3), np.nan), "finite"),
        (np.float64(3), "an \\(n, 3\\) array"),
    ],
)
def test_what_is_no_closed_curve_is_refused_in_one_line(
    tmp_path: Path, curve: np.ndarray, problem: str
) -> None:
    np.save(tmp_path / "a.npy", curve)
    with pytest.raises(InvalidCurve, match=problem) as caught:
        knot_of(tmp_path / "a.npy")
    assert "\n" not in str(caught.value)
