"""Where action sequences begin: knots by name, and curves from files; any other file is refused."""

from pathlib import Path

import numpy as np
import pytest

from knotgym.common.errors import InvalidFile, InvalidInput
from knotgym.generate.states.curves import start_of
from knotgym.rope.model import Rope
from knotgym.topology.crossings import label
from knotgym.topology.knots import shows

from ..conftest import curled, trefoil


def test_the_unknot_begins_as_the_plain_loop(rope: Rope) -> None:
    assert np.array_equal(start_of("0_1").points, rope.loop())


@pytest.mark.parametrize("knot", ["3_1", "m3_1", "4_1"])
def test_a_named_knot_begins_as_its_least_diagram_the_same_each_time(knot: str) -> None:
    start, again = start_of(knot), start_of(knot)
    assert np.array_equal(start.points, again.points)
    assert start.code == label(start.points) and start.code.nx == int(knot.strip("m")[0])
    assert shows(start.code, knot)


def test_a_curve_is_read_from_text_from_csv_and_from_npy(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.txt", trefoil())
    np.savetxt(tmp_path / "a.csv", trefoil(), delimiter=",")
    np.save(tmp_path / "a.npy", trefoil())
    for path in tmp_path.iterdir():
        assert start_of(str(path)).knot == "m3_1", path.name


def test_a_file_is_certified_whatever_it_is_called(tmp_path: Path) -> None:
    np.save(tmp_path / "unknown.npy", trefoil())
    np.save(tmp_path / "3_1.npy", curled(2))
    np.save(tmp_path / "mirror.npy", trefoil() * (1, 1, -1))
    named = {path.stem: start_of(str(path)).knot for path in tmp_path.iterdir()}
    assert named == {"unknown": "m3_1", "mirror": "3_1", "3_1": "0_1"}


def test_an_unknown_name_is_told_what_there_is() -> None:
    with pytest.raises(
        InvalidFile, match="no knot '9_50'; there are 0_1, .*; or a file with a closed curve"
    ):
        start_of("9_50")


@pytest.mark.parametrize("name", ["a.txt", "a.csv", "a.npy"])
@pytest.mark.parametrize(
    "content",
    [b"", b"# nothing\n", b"1 2 3\n4 5\n", b"one two three\n", bytes(range(256)), b"\x93NUMPY\x01"],
)
def test_a_file_without_numbers_is_refused_in_one_line(
    tmp_path: Path, name: str, content: bytes
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InvalidFile, match=f"{name} holds no curve: .") as caught:
        start_of(str(tmp_path / name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "array", [np.array(["a", "b"]), trefoil() + 1j, np.array([{}, 1], dtype=object)]
)
def test_an_array_of_anything_but_real_numbers_is_refused(
    tmp_path: Path, array: np.ndarray
) -> None:
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(InvalidFile, match="holds no curve"):
        start_of(str(tmp_path / "a.npy"))


def test_several_arrays_in_one_file_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", one=trefoil(), other=trefoil())
    (tmp_path / "a.npz").rename(tmp_path / "a.npy")
    with pytest.raises(InvalidFile, match="it isn't one array of real numbers"):
        start_of(str(tmp_path / "a.npy"))


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
    with pytest.raises(InvalidInput, match=problem) as caught:
        start_of(str(tmp_path / "a.npy"))
    assert "\n" not in str(caught.value)
