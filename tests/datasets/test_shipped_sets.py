"""The sets of states that ship: what is in them, and that environments begin with them."""

from collections import Counter
from typing import Any

import numpy as np
import pytest

from knotgym.common import InvalidInput
from knotgym.datasets.row_verification import _state_faults
from knotgym.envs import KnotEnv
from knotgym.states import read_states, shipped
from knotgym.topology import UNKNOT, GaussCode, Symmetry, canonical, shows


def test_four_hard_unknots_ship_twice_each_and_all_for_testing() -> None:
    hard = read_states(shipped("hard-unknots"), images=False)
    # a test state was 6.7 mm from a train state of the same diagram, another base bead aside
    assert set(hard.split) == {"test"}
    codes = [GaussCode.parse(code) for code in hard.gauss_code]
    diagrams = Counter(canonical(code, Symmetry.DIAGRAM) for code in codes)
    assert sorted((code.nx, count) for code, count in diagrams.items()) == [
        *((7, 2), (10, 2), (10, 2), (11, 2))
    ]
    assert all(shows(code, UNKNOT) for code in set(codes))


@pytest.mark.parametrize("nx", [7, 10, 11])
def test_the_unknot_task_begins_with_one(nx: int) -> None:
    settings: dict[str, Any] = {"nx": nx, "states": "hard-unknots", "observation": "state"}
    info = KnotEnv("unknot", split="test", **settings).reset(seed=0)[1]
    assert GaussCode.parse(info["gauss_code"]).nx == nx and info["goal_gauss_code"] == ""
    with pytest.raises(InvalidInput, match=rf"it has nx .*{nx} .*\(test\)"):
        KnotEnv("unknot", **settings)


@pytest.mark.parametrize("most", [2, pytest.param(None, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("name", ["readable", "random-walk", "hard-unknots", "bench"])
def test_shipped_states_are_without_fault(name: str, most: int | None) -> None:
    states = read_states(shipped(name), images=name != "bench")
    shortest = np.argsort(states.source["steps"], kind="stable")[:most]
    assert list(_state_faults(states.take(np.sort(shortest)))) == []
