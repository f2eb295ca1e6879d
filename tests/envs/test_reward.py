"""Rewards and ends of episodes."""

import numpy as np
import pytest

from knotgym.envs.reward import outcome
from knotgym.envs.tasks import TaskConfig

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
    reached: bool,
    step: int,
    failed: bool,
    towed: bool,
    right: tuple[float, bool, bool],
    endless: tuple[float, bool, bool],
) -> None:
    given = [np.array([value]) for value in (reached, step, failed, towed)]
    for task, expected in ((TASK, right), (ENDLESS, endless)):
        assert tuple(column.item() for column in outcome(task, *given)) == expected
