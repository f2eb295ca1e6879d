"""The set of states as random play meets them that ships with the package."""

from collections import Counter

import gymnasium
import numpy as np
import pytest

import knotgym
from knotgym.common.errors import InvalidFile
from knotgym.states.state_file import States, read_states, shipped


@pytest.fixture(scope="module")
def random_states() -> States:
    """The states of random walks that ship, without pictures."""
    return read_states(shipped("random-walk"), images=False)


def test_random_states_ship_forty_a_crossing_number_and_seventeen_loops(
    random_states: States,
) -> None:
    counts = Counter(zip(random_states.nx.tolist(), random_states.split.tolist(), strict=True))
    assert counts == {(0, "train"): 9, (0, "test"): 8} | {
        (nx, split): 20 for nx in (1, 2, 3, 4) for split in ("train", "test")
    }


def test_the_loops_of_random_play_are_crumpled(random_states: States) -> None:
    loops = random_states.points[random_states.nx == 0]
    centred = loops - loops.mean(axis=1, keepdims=True)
    assert np.median(np.sqrt((centred**2).sum(axis=2).mean(axis=1))) < 0.18
    assert np.median(np.ptp(loops[..., 2], axis=1)) > 0.04


@pytest.mark.slow
def test_the_random_states_that_ship_have_no_fault() -> None:
    assert knotgym.verify(shipped("random-walk")) == []


def test_an_environment_resets_from_them_by_name() -> None:
    env = gymnasium.make("knotgym/Tie-v0", nx=3, states="random-walk", observation="state")
    start, info = env.reset(seed=0)
    states = read_states(shipped("random-walk"), images=False)
    assert (
        states.nx[info["start"]] == 0 and states.gauss_code[info["goal"]] == info["goal_gauss_code"]
    )


def test_another_name_of_a_set_is_refused() -> None:
    assert shipped("readable") == shipped()
    with pytest.raises(InvalidFile, match="there are readable, random-walk, hard-unknots"):
        shipped("published")
