"""A whole prompt to look at, without asking anybody."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from knotgym.prompting.prompted_episodes import PromptConfig, begun, goal_shown, now_shown
from knotgym.prompting.prompts import (
    READ,
    STATEFUL,
    Shown,
    Turn,
    first,
    message,
    messages,
    opening,
    reading,
)

_ANSWER = "(the model's words) <answer>[0.1, 0, 0, 1, 0, 0]</answer>"
_ACTION = (0.1, 0.0, 0.0, 1.0, 0.0, 0.0)


def sample_prompt(
    config: PromptConfig, rows: Sequence[Mapping[str, Any]] = ()
) -> tuple[list[dict[str, Any]], list[Shown]]:
    """The messages that a run begins with, and the pictures in them.

    In mode stateful those of the second turn, after a first answer of ours.

    Args:
        config: of the run.
        rows: of a perception table, for mode read.
    """
    if config.mode == READ:
        picture = Shown(rows[0]["image"], "picture")
        return [message(reading(picture))], [first(), picture]
    episodes = begun(config, 0)
    goal, now, turns = goal_shown(episodes), now_shown(episodes, config), []
    pictures = [first(), goal, now]
    if config.mode == STATEFUL:
        turns = [Turn(now, _ANSWER)]
        episodes.step(np.array([_ACTION]), np.array([0]))
        now = now_shown(episodes, config)
        pictures.append(now)
    return messages(opening(goal), turns, config.mode, config.task.horizon, now), pictures
