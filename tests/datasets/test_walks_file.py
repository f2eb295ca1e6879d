"""Walks are written, joined, read back and made again bit for bit."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.common.errors import InvalidFile, MissingFile
from knotgym.datasets.walks_file import (
    Walks,
    joined_walks,
    read_walks,
    retrace,
    walks_of,
    write_walks,
)
from knotgym.rope.model import Rope
from knotgym.rope.mujoco_simulation import MujocoSimulation


@dataclass(frozen=True)
class Made:
    """Some walks as a unit of work leaves them."""

    number: NDArray[np.int64]
    start: NDArray[np.int64]
    beads: NDArray[np.int16]
    forces: NDArray[np.float32]


def made(numbers: list[int], bases: list[int], steps: int) -> Made:
    rng = np.random.default_rng(numbers)
    return Made(
        np.array(numbers),
        np.array(bases),
        rng.integers(100, size=(len(numbers), steps)).astype(np.int16),
        rng.uniform(-0.5, 0.5, (len(numbers), steps, 3)).astype(np.float32),
    )


@pytest.fixture(scope="module")
def states() -> NDArray[np.float64]:
    """Integration states of three ropes in motion."""
    simulation = MujocoSimulation(3, Rope())
    simulation.act(np.random.default_rng(0).uniform(-1, 1, (3, 6)))
    return simulation.states()


@pytest.fixture
def walks(states: NDArray[np.float64]) -> Walks:
    return walks_of(states, [made([3, 5], [2, 0], 2), made([9], [2], 4)], {3, 9})


def same(one: Walks, other: Walks) -> bool:
    return all(np.array_equal(column, vars(other)[name]) for name, column in vars(one).items())


def test_only_the_walks_that_are_used_are_kept(walks: Walks, states: NDArray[np.float64]) -> None:
    assert walks.number.tolist() == [3, 9] and walks.start.tolist() == [0, 0]
    assert np.array_equal(walks.state, states[[2]])


def test_shorter_walks_end_without_force(walks: Walks) -> None:
    assert walks.beads.shape == (2, 4) and not walks.forces[0, 2:].any()


def test_walks_come_back_as_written(walks: Walks, tmp_path: Path) -> None:
    write_walks(tmp_path / "walks.h5", walks)
    assert same(read_walks(tmp_path / "walks.h5"), walks)


def test_walks_of_two_files_set_out_from_where_they_did(
    walks: Walks, states: NDArray[np.float64]
) -> None:
    others = walks_of(states, [made([11], [1], 6)], {11})
    joined = joined_walks([walks, others])
    assert joined.number.tolist() == [3, 9, 11] and joined.beads.shape == (3, 6)
    for piece, rows in ((walks, [0, 1]), (others, [2])):
        assert np.array_equal(joined.state[joined.start[rows]], piece.state[piece.start])


def test_a_walk_goes_where_it_went_in_any_company(walks: Walks) -> None:
    starts = walks.state[walks.start]
    together = retrace(starts, walks.beads, walks.forces)
    assert together.shape == (2, 5, 100, 3)
    alone = retrace(starts[1:], walks.beads[1:], walks.forces[1:])
    assert np.array_equal(together[1:], alone)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFile, match=r"walks\.h5"):
        read_walks(tmp_path / "walks.h5")


@pytest.mark.parametrize(
    ("name", "value"), [("format", "other"), ("format_version", 9), ("rope", "feedfeedfeedfeed")]
)
def test_walks_of_another_format_or_rope_are_refused(
    walks: Walks, tmp_path: Path, name: str, value: Any
) -> None:
    write_walks(tmp_path / "walks.h5", walks)
    with h5py.File(tmp_path / "walks.h5", "a") as file:
        file.attrs[name] = value
    with pytest.raises(InvalidFile, match=str(value)):
        read_walks(tmp_path / "walks.h5")
