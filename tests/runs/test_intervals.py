"""Intervals of success rates: over states that were drawn, not over episodes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from knotgym.runs.intervals import _wilson, cluster_interval

STARTS, GOALS, EPISODES = 20, 9, 256  # of a cell of the benchmark whose goals are plain loops


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(0, 10, 0.0, 0.2775), (5, 10, 0.2366, 0.7634), (10, 10, 0.7225, 1.0)],
)
def test_wilson_intervals_are_exact(successes: int, trials: int, low: float, high: float) -> None:
    assert _wilson(successes, trials) == pytest.approx((low, high), abs=1e-4)


def drawn(
    rng: np.random.Generator, spread: float, odds: float = -1.0, most_goals: int = GOALS
) -> tuple[list[int], list[int], list[int]]:
    """Success, starts and goals of a cell: log odds plus an effect of each start, and half as much
    of each goal.
    """
    effects = rng.normal(size=STARTS) * spread, rng.normal(size=most_goals) * spread / 2
    starts, goals = rng.integers(STARTS, size=EPISODES), rng.integers(most_goals, size=EPISODES)
    chance = 1 / (1 + np.exp(-odds - effects[0][starts] - effects[1][goals]))
    success = (rng.random(EPISODES) < chance).astype(int)
    return success.tolist(), starts.tolist(), goals.tolist()


def test_the_same_episodes_have_the_same_interval_in_any_order() -> None:
    success, starts, goals = drawn(np.random.default_rng(0), 1.0)
    low, high = cluster_interval(success, starts, goals)
    assert 0 < low < np.mean(success) < high < 1
    assert cluster_interval(success, starts, goals) == (low, high)
    turned = cluster_interval(success[::-1], starts[::-1], goals[::-1])
    assert turned == pytest.approx((low, high), abs=1e-12)


def test_states_that_decide_all_make_it_far_wider_than_wilson_s() -> None:
    starts = [number % 20 for number in range(240)]
    success = [int(start < 5) for start in starts]
    low, high = cluster_interval(success, starts, list(range(240)))
    narrow = _wilson(sum(success), len(success))
    assert high - low > 3 * (narrow[1] - narrow[0])


@pytest.mark.parametrize("outcome", [0, 1])
def test_a_cell_without_a_difference_counts_states_and_not_episodes(outcome: int) -> None:
    starts, goals = ([number % count for number in range(240)] for count in (20, 8))
    assert cluster_interval([outcome] * 240, starts, goals) == _wilson(20 * outcome, 20)


def test_a_side_of_one_state_adds_nothing_and_one_episode_has_an_interval() -> None:
    success, starts, _ = drawn(np.random.default_rng(0), 1.0)
    low, high = cluster_interval(success, starts, [0] * len(starts))
    assert math.isfinite(low) and low < np.mean(success) < high
    assert cluster_interval([1], [3], [4]) == _wilson(1, 1)
    assert cluster_interval([0, 1], [3, 3], [4, 4]) == _wilson(1, 2)


def test_trainings_that_differ_make_it_wider() -> None:
    starts, seeds = [*range(60)] * 4, [seed for seed in range(4) for _ in range(60)]
    success = [
        int((7 * start) % 10 < 2 + 2 * seed) for start, seed in zip(starts, seeds, strict=True)
    ]
    of_states = cluster_interval(success, starts, [0] * 240)
    of_both = cluster_interval(success, starts, [0] * 240, seeds)
    assert of_both[0] < of_states[0] < 0.5 < of_states[1] < of_both[1]


def coverage(spread: float, odds: float, most_goals: int, cells: int = 300) -> float:
    """How often the interval holds the mean success rate over all starts and goals."""
    rng = np.random.default_rng(0)
    effects = rng.normal(size=400_000) * spread * math.hypot(1, 0.5)
    rate = float((1 / (1 + np.exp(-odds - effects))).mean())
    found = (cluster_interval(*drawn(rng, spread, odds, most_goals)) for _ in range(cells))
    return sum(low <= rate <= high for low, high in found) / cells


@pytest.mark.slow  # its parts are tested above
@pytest.mark.parametrize("odds", [-1.0, -3.5, 3.0])
@pytest.mark.parametrize("spread", [0.0, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("most_goals", [GOALS, 20])
def test_it_holds_the_rate_of_all_states_in_19_of_20_cells_or_nearly(
    spread: float, odds: float, most_goals: int
) -> None:
    assert coverage(spread, odds, most_goals) > 0.92
