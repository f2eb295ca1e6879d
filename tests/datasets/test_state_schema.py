"""The schema of the state file is what the file that ships, and every `States`, is made of."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.common.hdf5_files import Column
from knotgym.datasets.state_verification import state_faults
from knotgym.rope.model import Rope
from knotgym.states.schema import ATTRIBUTES, COLUMNS, ROOT
from knotgym.states.state_file import States, read_states, shipped

SIZES = {"nq": Rope().nq, "beads": Rope().config.beads}


def test_the_states_that_ship_have_every_column_but_that_of_drawings() -> None:
    columns = read_states(shipped()).columns()
    assert set(columns) == {column.name for column in COLUMNS} - {"source/drawing"}
    for column in COLUMNS:
        if column.name not in columns:
            continue
        values = columns[column.name]
        assert column.has_kind(values), column.name
        assert column.has_shape(values, len(columns["qpos"]), SIZES), column.name


def test_the_states_that_ship_have_every_attribute() -> None:
    assert set(ATTRIBUTES) <= set(read_states(shipped(), images=False).attributes)


def test_units_of_measures_are_those_in_the_file() -> None:
    with h5py.File(shipped(), "r") as file:
        for column in COLUMNS:
            if column.name.startswith("quality/"):
                assert file[column.name].attrs["unit"] == column.unit


def test_the_root_columns_are_the_fields_of_states(states: States) -> None:
    assert all(hasattr(states, column.name) for column in ROOT)


def test_taking_rows_takes_them_of_every_column(states: States) -> None:
    rows = np.array([4, 1, 1])
    for name, values in states.taken(rows).columns().items():
        assert np.array_equal(values, states.columns()[name][rows]), name


def test_a_word_in_a_shape_is_a_size_and_none_is_any() -> None:
    column = Column("a", "float64", ("beads", None), "m", "")
    assert column.full_shape(7, SIZES) == (7, 100, None)
    assert column.has_shape(np.zeros((7, 100, 3)), 7, SIZES)
    assert not column.has_shape(np.zeros((7, 99, 3)), 7, SIZES)
    assert not column.has_shape(np.zeros((7, 100)), 7, SIZES)


@pytest.mark.parametrize(
    ("name", "harm", "named"),
    [
        ("steps", lambda values: values.astype(np.float64), "source/steps is float64"),
        ("policy", lambda values: np.arange(len(values)), "source/policy is int64"),
        ("actions", lambda values: values[:, :, :5], "source/actions is of shape"),
    ],
)
def test_a_column_of_another_type_or_shape_is_a_fault(
    name: str, harm: Callable[[NDArray[Any]], NDArray[Any]], named: str
) -> None:
    states = read_states(shipped(), images=False).taken(np.arange(3))
    spoilt = replace(states, source={**states.source, name: harm(states.source[name])})
    (fault,) = state_faults(spoilt)
    assert named in fault and "should be" in fault
