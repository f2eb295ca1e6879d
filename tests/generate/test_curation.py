"""Which codes there are, which states are too alike, and how they are split."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from knotgym.generate.states.curation import is_near_duplicate, most_unlike
from knotgym.rope.model import Rope
from knotgym.rope.reset_noise import noised
from knotgym.states.near_duplicates import NEAR, distances
from knotgym.states.state_file import States
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import codes_of, knot_type

EIGHT = list(codes_of("0_1", 2))


def turned(points: NDArray[np.float64], turn: float) -> NDArray[np.float64]:
    return points @ np.array(
        [[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )


@pytest.mark.parametrize(("nx", "count"), [(0, 1), (1, 2), (2, 8), (3, 46), (4, 344)])
def test_as_many_unknot_codes_as_are_known_to_exist(nx: int, count: int) -> None:
    assert len(codes_of("0_1", nx)) == len(set(codes_of("0_1", nx))) == count


@pytest.mark.parametrize(("knot", "nx", "count"), [("3_1", 2, 0), ("3_1", 3, 2), ("4_1", 3, 0)])
def test_a_knot_has_no_diagram_below_its_crossing_number(knot: str, nx: int, count: int) -> None:
    assert len(codes_of(knot, nx)) == count


def test_codes_of_a_knot_are_of_that_knot() -> None:
    assert {knot_type(code) for code in codes_of("3_1", 4)} == {"3_1"}


def test_codes_come_in_order_and_without_chirality() -> None:
    codes = codes_of("0_1", 3)
    assert list(codes) == sorted(codes, key=lambda code: code.visits) and all(
        code.chirality is None for code in codes
    )


@given(st.integers(0, 29), st.floats(-np.pi, np.pi), st.tuples(*[st.floats(-2, 2)] * 3))
def test_a_rope_turned_and_moved_is_no_distance_away(
    states: States, row: int, turn: float, shift: tuple[float, float, float]
) -> None:
    points = states.points[row]
    assert distances(points, (turned(points, turn) + shift)[None])[0] < 1e-7


@given(st.integers(0, 29), st.integers(0, 29), st.floats(-np.pi, np.pi), st.floats(-2, 2))
def test_distances_do_not_see_turns_and_shifts(
    states: States, row: int, other: int, turn: float, shift: float
) -> None:
    one, two = states.points[row], states.points[other]
    assert distances(one, (turned(two, turn) + shift)[None])[0] == pytest.approx(
        distances(one, two[None])[0], abs=1e-7
    )


def test_a_rope_is_no_distance_from_itself(states: States) -> None:
    for points in states.points:
        assert distances(points, points[None])[0] < 1e-7


def test_distances_go_both_ways(states: States) -> None:
    there = np.array([distances(points, states.points) for points in states.points])
    assert np.allclose(there, there.T, atol=1e-9)


def test_a_distance_is_the_root_mean_square_over_beads(states: States) -> None:
    points = states.points[0]
    lifted = points + np.array([0.0, 0.0, 0.02]) * (-1) ** np.arange(100)[:, None]
    assert distances(points, lifted[None])[0] == pytest.approx(0.02)


def test_no_turn_brings_ropes_nearer(states: States) -> None:
    one, other = states.points[3], states.points[9] - states.points[9].mean(axis=0)
    tried = [
        np.sqrt(((one - one.mean(axis=0) - turned(other, turn)) ** 2).sum() / 100)
        for turn in np.linspace(0, 2 * np.pi, 2000)
    ]
    assert distances(one, other[None])[0] == pytest.approx(min(tried), abs=1e-5)


def test_reset_noise_makes_a_near_duplicate(states: States) -> None:
    rng = np.random.default_rng(0)
    assert all(is_near_duplicate(noised(points, 0.015, rng), [points]) for points in states.points)


def test_another_code_is_no_near_duplicate(states: States) -> None:
    assert NEAR == 0.015 and not is_near_duplicate(
        states.points[0], [states.points[12], states.points[20]]
    )


def test_the_first_state_is_a_duplicate_of_nothing(states: States) -> None:
    assert not is_near_duplicate(states.points[0], [])


def ellipses(rope: Rope, *long: float) -> list[NDArray[np.float64]]:
    return [rope.from_curve(rope.loop() * (one, 1.0, 1.0)) for one in long]


def test_the_set_is_of_the_states_most_unlike_each_other(rope: Rope) -> None:
    loops = ellipses(rope, 1.0, 1.1, 1.2, 2.0, 3.5)
    assert most_unlike(loops, [GaussCode()] * 5, {GaussCode(): 3}, 3) == [0, 3, 4]


def test_the_same_curve_from_another_base_bead_is_no_other_state(rope: Rope) -> None:
    long, wider = ellipses(rope, 3.0, 2.6)
    states = [long, np.roll(long, 30, axis=0), wider]
    assert most_unlike(states, [GaussCode()] * 3, {GaussCode(): 3}, 2) == [0, 2]


def test_codes_keep_their_shares_and_chiralities_take_turns(rope: Rope) -> None:
    loops = ellipses(rope, 1.0, 1.3, 1.6, 2.0, 2.5, 3.0)
    codes = [GaussCode.parse(text) for text in ["1+a,1-a"] * 4 + ["1+c,1-c", "1-a,1+a"]]
    shares = {codes[0].plain: 2, codes[5].plain: 2}
    chosen = most_unlike(loops, codes, shares, 4)
    assert 4 in chosen and 5 in chosen and len(chosen) == 3


def test_no_more_are_chosen_than_there_are() -> None:
    assert most_unlike([], [], {GaussCode(): 3}, 3) == []
