"""The hard unknots that ship: what they are, and that an environment begins with them."""

import gymnasium
import pytest

import knotgym
from knotgym.datasets.states import States, read_states, shipped
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import is_unknot
from knotgym.topology.reidemeister import without_bigons


@pytest.fixture(scope="module")
def hard() -> States:
    """The states that ship, without pictures."""
    return read_states(shipped("hard-unknots"), images=False)


def test_four_hard_unknots_ship_in_both_splits(hard: States) -> None:
    for split in ("train", "test"):
        codes = set(hard.gauss_code_chiral[hard.split == split])
        assert sorted(GaussCode.parse(code).nx for code in codes) == [7, 10, 10, 11]


def test_they_are_unknots_and_but_the_first_have_neither_kink_nor_bigon(hard: States) -> None:
    for text in set(hard.gauss_code_chiral):
        code = GaussCode.parse(text)
        assert is_unknot(code) and (code.nx == 7 or without_bigons(code) is code)


def test_they_keep_their_code_through_reset_noise(hard: States) -> None:
    assert hard.quality["noise_survival"].min() >= 0.95
    assert hard.quality["clearance"].min() >= 8.0


@pytest.mark.slow
def test_the_hard_unknots_that_ship_have_no_fault() -> None:
    assert knotgym.verify(shipped("hard-unknots")) == []


@pytest.mark.parametrize("nx", [7, 10, 11])
def test_the_unknot_task_begins_with_one(nx: int) -> None:
    env = gymnasium.make(
        "knotgym/Unknot-v0", nx=nx, states="hard-unknots", split="test", observation="state"
    )
    info = env.reset(seed=0)[1]
    assert GaussCode.parse(info["gauss_code"]).nx == nx and info["goal_gauss_code"] == ""
