"""Build a sample prompt for inspection, without sending it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from knotgym.prompting.prompted_episodes import (
    PromptConfig,
    begin_episode,
    current_picture,
    goal_picture,
)
from knotgym.prompting.prompts import (
    READ,
    STATEFUL,
    Picture,
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
) -> tuple[list[dict[str, Any]], list[Picture]]:
    """Return the messages of a run's first request, and the pictures in them.

    In mode stateful it is the second request, after a made-up first answer.

    Args:
        rows: rows of a perception table, for mode read.
    """
    if config.mode == READ:
        picture = Picture(rows[0]["image"], "picture")
        return [message(reading(picture))], [first(), picture]
    episodes = begin_episode(config, 0)
    goal, now, turns = goal_picture(episodes), current_picture(episodes, config), []
    pictures = [first(), goal, now]
    if config.mode == STATEFUL:
        turns = [Turn(now, _ANSWER)]
        episodes.step(np.array([_ACTION]), np.array([0]))
        now = current_picture(episodes, config)
        pictures.append(now)
    return messages(opening(goal), turns, config.mode, config.task.horizon, now), pictures
