"""Rewards and ends of episodes."""

from typing import Any

import numpy as np
import pytest
from synthetic_episodes import TINY

from knotgym.adapters import goal_env
from knotgym.control import replay
from knotgym.datasets import open_episodes
from knotgym.envs import reward
from knotgym.envs.reward import Situation
from knotgym.envs.tasks import TaskConfig
from knotgym.generate import faults as dataset_faults
from knotgym.loaders import Transitions

Outcome = tuple[float, bool, bool]  # reward, terminated, truncated
RULE = {"horizon": 9, "success_reward": 3.0, "failure_reward": -1.0}
TASK, ENDLESS = (TaskConfig(task="tie", endless=endless, **RULE) for endless in (False, True))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("reached", "step", "failed", "towed", "right", "endless"),
    [
        (False, 4, False, False, (0.0, False, False), (0.0, False, False)),
        (True, 4, False, False, (3.0, True, False), (3.0, False, False)),
        (True, 9, False, False, (3.0, True, False), (3.0, False, True)),
        (False, 9, False, False, (-1.0, False, True), (0.0, False, True)),
        (False, 4, True, False, (0.0, False, True), (0.0, False, True)),
        (False, 9, True, False, (0.0, False, True), (0.0, False, True)),
        (False, 4, False, True, (-1.0, False, True), (0.0, False, True)),
        (False, 9, False, True, (-1.0, False, True), (0.0, False, True)),
        (False, 4, True, True, (0.0, False, True), (0.0, False, True)),
    ],
)
def test_the_rule(
    reached: bool, step: int, failed: bool, towed: bool, right: Outcome, endless: Outcome
) -> None:
    code = np.zeros((1, 2), np.int16)
    held, *given = (np.array([value]) for value in (2 * reached, step, failed, towed))
    for task, expected in ((TASK, right), (ENDLESS, endless)):
        found = Situation(code, code, held, 2, *given).outcome(task)
        assert tuple(column.item() for column in found) == expected


def test_a_reward_is_changed_in_one_place(monkeypatch: pytest.MonkeyPatch) -> None:
    before = reward.reward

    def dearer(task: TaskConfig, seen: Situation) -> Any:
        """Pay -0.1 a step, and -1 for each crossing."""
        return before(task, seen) - 0.1 - np.count_nonzero(seen.visits, axis=1) / 2

    stored = open_episodes(TINY["expert"])
    monkeypatch.setattr(reward, "reward", dearer)
    # episodes that are played, and those that `dataset verify` plays again
    steps = stored.episodes.steps
    played = replay(stored.episodes, stored.task).steps
    before_last = np.delete(np.arange(steps.rows), stored.episodes.last())
    paid = -0.1 - steps["crossings"][before_last + 1]
    np.testing.assert_allclose(played["reward"][before_last], steps["reward"][before_last] + paid)
    assert any("reward differs" in fault for fault in dataset_faults(TINY["expert"]))
    # goals in hindsight, for pulls and for macro-actions
    for action in ("pull", "macro"):
        opened = Transitions(stored, relabel="all", action=action)
        assert opened.segments > 3
        for k in range(len(opened)):
            rows = np.arange(opened._segments.before[k], opened._segments.after[k])
            due = 5.0 * opened.terminals[k] - (0.1 + steps["crossings"][rows + 1]).sum()
            assert opened.rewards[k] == pytest.approx(due)
    # goal environments
    env = goal_env("tie", nx=2, engine="chain", observation="state")
    env.reset(seed=0)
    for _ in range(3):
        seen, found, _, _, info = env.step(env.action_space.sample())
        assert found == -0.1 - info["crossings"]
        assert env.compute_reward(seen["achieved_goal"], seen["desired_goal"], info) == found
