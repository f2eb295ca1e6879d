"""Which codes there are, which states are too alike, and how they are split."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from knotgym.datasets.near_duplicates import NEAR, distances
from knotgym.datasets.states import States
from knotgym.generate.states.curation import codes_of, is_near_duplicate, split
from knotgym.rope import noised
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import knot_type

EIGHT = list(codes_of("0_1", 2))

kinds = st.lists(st.integers(0, 7), min_size=1, max_size=60)
shares = st.floats(0, 1)
seeds = st.integers(0, 2**32)


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


@given(kinds, shares, seeds)
def test_the_train_share_is_met_within_one_state(drawn: list[int], share: float, seed: int) -> None:
    out = split([EIGHT[k] for k in drawn], "state", share, np.random.default_rng(seed))
    assert set(out) <= {"train", "test"} and abs((out == "train").sum() - share * len(drawn)) <= 1


@given(kinds, shares, seeds)
def test_the_train_share_of_each_code_is_met_within_one_state(
    drawn: list[int], share: float, seed: int
) -> None:
    out = split([EIGHT[k] for k in drawn], "state", share, np.random.default_rng(seed))
    for kind, count in Counter(drawn).items():
        train = sum(one == "train" for one, k in zip(out, drawn, strict=True) if k == kind)
        assert abs(train - share * count) <= 1


@given(kinds, shares, seeds)
def test_split_by_code_shares_no_code(drawn: list[int], share: float, seed: int) -> None:
    out = split([EIGHT[k] for k in drawn], "code", share, np.random.default_rng(seed))
    train, test = (
        {k for one, k in zip(out, drawn, strict=True) if one == name} for name in ("train", "test")
    )
    assert not train & test and abs(len(train) - share * len(set(drawn))) <= 0.5


@given(kinds, st.sampled_from(("state", "code")), seeds)
def test_a_split_is_the_same_for_the_same_seed(drawn: list[int], by: str, seed: int) -> None:
    one, other = (
        split([EIGHT[k] for k in drawn], by, 0.5, np.random.default_rng(seed)) for _ in range(2)
    )
    assert np.array_equal(one, other)


def test_another_seed_splits_otherwise() -> None:
    codes = EIGHT * 5
    first, second = (split(codes, "state", 0.5, np.random.default_rng(seed)) for seed in (0, 1))
    assert not np.array_equal(first, second)


def test_codes_with_chirality_are_split_as_the_code_they_show() -> None:
    both = [GaussCode((1, -1), "a"), GaussCode((1, -1), "c")] * 4
    assert set(split(both, "code", 0.5, np.random.default_rng(0))) in ({"train"}, {"test"})


def test_nothing_is_split_into_nothing() -> None:
    assert [len(split([], by, 0.5, np.random.default_rng(0))) for by in ("state", "code")] == [0, 0]
