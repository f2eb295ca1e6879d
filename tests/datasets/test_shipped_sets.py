"""The sets of states that ship: what is in them, and that environments begin with them."""

import numpy as np
import pytest

from knotgym.datasets.row_verification import _state_faults
from knotgym.states import read_states, shipped


@pytest.mark.parametrize("most", [1, pytest.param(None, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("name", ["readable", "random-walk", "hard-unknots", "bench"])
def test_shipped_states_are_without_fault(name: str, most: int | None) -> None:
    states = read_states(shipped(name), images=name != "bench")
    shortest = np.argsort(states.source["steps"], kind="stable")[:most]
    assert list(_state_faults(states.take(np.sort(shortest)))) == []
