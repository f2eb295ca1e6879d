"""The state file gives back what was written, and refuses what it cannot read in one line."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from knotgym.common.errors import InvalidFile
from knotgym.datasets.state_verification import state_faults
from knotgym.rendering.picture import draw
from knotgym.rope.model import Rope
from knotgym.states.schema import ROOT
from knotgym.states.state_file import SHIPPED, States, read_states, shipped, write_states
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import diagram_form

COLUMNS = [column.name for column in ROOT]


@pytest.fixture
def copy(states_path: str, tmp_path: Path) -> Path:
    """A state file to do harm to."""
    path = tmp_path / "copy.h5"
    path.write_bytes(Path(states_path).read_bytes())
    return path


def test_states_come_back_as_written(states: States, states_path: str) -> None:
    read = read_states(states_path)
    for name in COLUMNS:
        ours, theirs = getattr(states, name), getattr(read, name)
        assert np.array_equal(ours, theirs) and ours.dtype.kind == theirs.dtype.kind, name
    for name in ("quality", "source"):
        assert getattr(read, name).keys() == getattr(states, name).keys()
        for key, values in getattr(states, name).items():
            assert np.array_equal(getattr(read, name)[key], values), key
    assert read.units == states.units
    assert read.attributes == states.attributes


def test_numbers_keep_their_types(states_path: str) -> None:
    read = read_states(states_path)
    assert (
        read.qpos.dtype == read.points.dtype == np.float64
        and read.image is not None
        and read.image.dtype == np.uint8
    )
    assert read.gauss_code.dtype.kind == "U" and read.nx.dtype.kind == "i"


def test_images_are_left_out_when_not_asked_for(states_path: str) -> None:
    assert read_states(states_path, images=False).image is None


def test_read_arrays_cannot_be_written_to(states_path: str) -> None:
    read = read_states(states_path)
    for array in (
        read.qpos,
        read.points,
        read.nx,
        read.gauss_code,
        *read.quality.values(),
        *read.source.values(),
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = array[1]


def test_every_reading_has_memory_of_its_own(states_path: str) -> None:
    assert not np.shares_memory(read_states(states_path).qpos, read_states(states_path).qpos)


def test_rows_are_those_of_nx_and_split(states: States) -> None:
    for nx in range(5):
        for split in ("train", "test"):
            rows = states.rows(nx, split)
            assert (
                len(rows) == 3
                and set(states.nx[rows]) == {nx}
                and set(states.split[rows]) == {split}
            )
    assert len(states.rows(9, "train")) == len(states.rows(2, "dev")) == 0


def test_no_states_at_all_come_back(states: States, tmp_path: Path) -> None:
    assert states.image is not None
    none = replace(
        states,
        **{name: getattr(states, name)[:0] for name in COLUMNS},
        quality={},
        source={},
        units={},
    )
    write_states(tmp_path / "none.h5", none)
    assert len(read_states(tmp_path / "none.h5")) == 0


def test_configurations_in_the_attributes_become_json(states: States, tmp_path: Path) -> None:
    write_states(tmp_path / "a.h5", replace(states, attributes={"configuration": {"seed": 3}}))
    assert read_states(tmp_path / "a.h5").attributes == {"configuration": '{"seed": 3}'}


def test_columns_of_different_lengths_are_refused(states: States) -> None:
    with pytest.raises(InvalidFile, match="column nx has 29 rows, qpos has 30"):
        replace(states, nx=states.nx[1:])


def test_states_without_images_are_not_written(states: States, tmp_path: Path) -> None:
    with pytest.raises(InvalidFile, match="read without"):
        write_states(tmp_path / "a.h5", replace(states, image=None))
    assert list(tmp_path.iterdir()) == []


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no state file at .*absent\.h5"):
        read_states(tmp_path / "absent.h5")


@pytest.mark.parametrize("kept", [0, 7, 100, 2000, 0.3, 0.7, 0.999])
def test_a_truncated_file_is_refused_in_one_line(copy: Path, kept: float) -> None:
    raw = copy.read_bytes()
    copy.write_bytes(raw[: int(kept if kept >= 1 else kept * len(raw))])
    with pytest.raises(InvalidFile, match="isn't a whole state file") as caught:
        read_states(copy)
    assert "\n" not in str(caught.value) and str(copy) in str(caught.value)


def test_a_file_that_is_no_hdf5_is_refused_in_one_line(copy: Path) -> None:
    copy.write_text("qpos,points\n1,2\n")
    with pytest.raises(InvalidFile, match="isn't a whole state file") as caught:
        read_states(copy)
    assert "\n" not in str(caught.value)


def test_a_foreign_hdf5_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["qpos"] = np.zeros(3)
    with pytest.raises(
        InvalidFile,
        match="format 'none' version none; this version reads 'knotgym-states' version 1",
    ):
        read_states(tmp_path / "foreign.h5")


def test_another_format_version_is_refused(copy: Path) -> None:
    with h5py.File(copy, "a") as file:
        file.attrs["format_version"] = 2
    with pytest.raises(
        InvalidFile,
        match="format 'knotgym-states' version 2; this version reads .* version 1",
    ):
        read_states(copy)


@pytest.mark.parametrize("name", [*COLUMNS, "quality", "source"])
def test_a_missing_column_is_refused(copy: Path, name: str) -> None:
    with h5py.File(copy, "a") as file:
        del file[name]
    with pytest.raises(InvalidFile, match=name):
        read_states(copy)


@pytest.mark.parametrize("name", ["gauss_code", "quality", "source", "qpos"])
def test_a_column_of_another_kind_is_refused(copy: Path, name: str) -> None:
    with h5py.File(copy, "a") as file:
        del file[name]
        file[name] = 3.0
    with pytest.raises(InvalidFile):
        read_states(copy)


def test_flipped_bytes_are_read_as_written_or_refused(copy: Path, states: States) -> None:
    raw, rng = copy.read_bytes(), np.random.default_rng(0)
    refused = 0
    for _ in range(60):
        harmed = bytearray(raw)
        for at in rng.integers(0, len(raw), 20):
            harmed[at] = int(rng.integers(256))
        copy.write_bytes(harmed)
        try:
            assert len(read_states(copy)) == len(states)
        except InvalidFile:
            refused += 1
    assert refused > 50


def test_curated_states_ship() -> None:
    assert shipped().is_file()


@pytest.mark.thorough
def test_curated_states_are_replayed_from_the_actions_that_the_file_holds() -> None:
    states = read_states(shipped())
    few = states.taken(np.arange(0, len(states), 16))
    assert set(few.nx) == {0, 1, 2, 3, 4} and list(state_faults(few)) == []


def test_curated_states_are_17_loops_and_40_of_each_nx_half_of_them_to_train_on() -> None:
    states = read_states(shipped(), images=False)
    assert Counter(states.nx.tolist()) == {0: 17, 1: 40, 2: 40, 3: 40, 4: 40}
    for nx in range(5):
        train, test = len(states.rows(nx, "train")), len(states.rows(nx, "test"))
        assert abs(train - test) <= 1 and train + test == (40 if nx else 17)


def test_curated_states_are_what_their_labels_say() -> None:
    states, rope = read_states(shipped()), Rope()
    assert states.attributes["rope"] == rope.config.fingerprint and states.image is not None
    for row in range(len(states)):
        points = rope.points(states.qpos[row])
        code = label(points)
        assert np.abs(points - states.points[row]).max() < 1e-9
        assert (str(code), code.chiral, code.nx) == (
            states.gauss_code[row],
            states.gauss_code_chiral[row],
            states.nx[row],
        )
        assert GaussCode.parse(str(states.gauss_code_chiral[row])) == code
        assert np.array_equal(draw(states.points[row]), states.image[row])


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("qpos", np.full((30, 421), 1j), "qpos is complex128, should be float64"),
        ("points", np.full((30, 100, 3), np.nan), r"points holds nan at \[0, 0, 0\]"),
        ("nx", np.zeros(30), "nx is float64, should be int64"),
        ("nx", np.full(30, -1), "nx is -1, should be at least 0"),
        ("split", np.zeros(29), "split is float64, should be text"),
        ("knot", np.array([b"0_1"] * 29), r"knot is of shape \(29,\), should be \(30\)"),
        ("image", np.zeros((30, 8, 8, 3)), "image is float64, should be uint8"),
    ],
)
def test_a_column_that_misses_the_schema_is_named(
    copy: Path, name: str, values: np.ndarray, said: str
) -> None:
    with h5py.File(copy, "a") as file:
        del file[name]
        file[name] = values
    with pytest.raises(InvalidFile, match=said):
        read_states(copy)


@pytest.mark.parametrize(("name", "nx"), [(s, nx) for s in SHIPPED for nx in (2, 3, 4, 7)])
def test_splits_by_code_share_no_diagram_and_are_parts_of_the_splits(name: str, nx: int) -> None:
    states = read_states(shipped(name), images=False)
    train, test = states.rows(nx, "train-code"), states.rows(nx, "test-code")
    assert {*train} <= {*states.rows(nx, "train")} and {*test} <= {*states.rows(nx, "test")}
    diagrams = [
        {diagram_form(GaussCode.parse(code)) for code in states.gauss_code[rows].tolist()}
        for rows in (train, test)
    ]
    assert not diagrams[0] & diagrams[1]
    if name != "hard-unknots" and nx < 7:
        assert len(train) >= 10 and len(test) >= 1


def test_loops_and_curls_are_in_both_splits_by_code() -> None:
    states = read_states(shipped(), images=False)
    for nx in (0, 1):
        assert np.array_equal(states.rows(nx, "test-code"), states.rows(nx, "test"))
