"""The sets of states that ship: what is in them, and that environments begin with them."""

from collections import Counter
from typing import Any

import numpy as np
import pytest

from knotgym.common import InvalidFile, InvalidInput
from knotgym.datasets.row_verification import _state_faults
from knotgym.envs import KnotEnv
from knotgym.states import read_states, shipped
from knotgym.topology import UNKNOT, GaussCode, Symmetry, canonical, shows


@pytest.mark.parametrize("name", ["readable", "random-walk"])
def test_forty_of_each_crossing_number_ship_and_seventeen_loops(name: str) -> None:
    states = read_states(shipped(name), images=False)
    assert Counter(states.nx.tolist()) == {0: 17, 1: 40, 2: 40, 3: 40, 4: 40}
    for nx in range(5):
        train, test = len(states.rows(nx, "train")), len(states.rows(nx, "test"))
        assert abs(train - test) <= 1 and train + test == (40 if nx else 17)


def test_another_name_of_a_set_is_refused() -> None:
    assert shipped("readable") == shipped()
    with pytest.raises(InvalidFile, match="there are readable, random-walk, hard-unknots"):
        shipped("published")


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
