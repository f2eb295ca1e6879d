"""Rewards and ends of episodes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.envs.reward import RewardRule, consecutive, success_at_last
from knotgym.envs.tasks import TaskConfig

RULE = RewardRule(hold=2, horizon=9, success_reward=3.0, failure_reward=-1.0)


@pytest.mark.parametrize(
    ("held", "step", "failed", "right"),
    [
        (0, 4, False, (0.0, False, False)),
        (1, 4, False, (0.0, False, False)),
        (2, 4, False, (3.0, True, False)),
        (2, 9, False, (3.0, True, False)),
        (1, 9, False, (-1.0, False, True)),
        (0, 4, True, (0.0, False, True)),
        (2, 4, True, (0.0, False, True)),
        (0, 9, True, (0.0, False, True)),
    ],
)
def test_the_rule(held: int, step: int, failed: bool, right: tuple[float, bool, bool]) -> None:
    assert tuple(column.item() for column in RULE.outcome([held], [step], [failed])) == right


def test_towing_too_far_pays_as_the_horizon_does() -> None:
    outcome = RULE.outcome([0, 0, 0], [4, 9, 4], [False, False, True], [True, True, True])
    assert outcome.rewards.tolist() == [-1.0, -1.0, 0.0]
    assert outcome.truncated.all() and not outcome.terminated.any()


def test_an_endless_task_pays_while_the_goal_is_shown_and_ends_at_the_horizon() -> None:
    task = TaskConfig(task="tie", hold=2, horizon=9, success_reward=3.0, endless=True)
    failed = [False, False, False, False, True]
    outcome = task.reward_rule.outcome([1, 2, 5, 0, 3], [4, 4, 9, 9, 4], failed)
    assert outcome.rewards.tolist() == [0.0, 3.0, 3.0, 0.0, 0.0]
    assert not outcome.terminated.any()
    assert outcome.truncated.tolist() == [False, False, True, True, True]


@given(st.integers(0, 60), st.integers(1, 60), st.booleans())
def test_no_step_is_both_terminated_and_truncated(held: int, step: int, failed: bool) -> None:
    outcome = RULE.outcome([held], [step], [failed])
    assert not (outcome.terminated & outcome.truncated).any()


def test_the_rule_of_a_task_has_its_numbers() -> None:
    task = TaskConfig(task="tie", hold=2, horizon=9, success_reward=3.0, failure_reward=-1.0)
    assert task.reward_rule == RULE


@given(st.lists(st.booleans(), max_size=30))
def test_consecutive_counts_as_one_would_by_hand(shown: list[bool]) -> None:
    counted, running = [], 0
    for now in shown:
        running = running + 1 if now else 0
        counted.append(running)
    assert consecutive(shown).tolist() == counted


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_success_at_last_is_what_the_rule_says_of_it(steps: int) -> None:
    held, at = np.arange(1, steps + 1) == steps, np.arange(1, steps + 1)
    rule = RewardRule(horizon=steps + 1)
    for ours, theirs in zip(
        success_at_last(steps), rule.outcome(held, at, np.zeros(steps)), strict=True
    ):
        assert ours.dtype == theirs.dtype and np.array_equal(ours, theirs)
