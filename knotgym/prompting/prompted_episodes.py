"""Episodes and pictures put to a model, each with its transcript.

An episode is the environment's own, `horizon` actions long. Every action asks the model once, but
in mode open, where it is asked once in all. Where an answer can't be taken, and after the last
action of mode open, the rope is left alone: an action without force. So a transcript is an episode
of actions, which `knotgym evaluate --policy prompt:FILE` plays again to the same codes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from knotgym.configuration import as_json, check_numbers
from knotgym.episode_batch import EpisodeBatch
from knotgym.errors import KnotgymError
from knotgym.prompting.answers import read_actions, read_code
from knotgym.prompting.chat import ChatConfig, Reply
from knotgym.prompting.kept_replies import Asking
from knotgym.prompting.prompts import (
    GOAL,
    MODES,
    OPEN,
    READ,
    STATEFUL,
    Shown,
    Turn,
    caption,
    message,
    messages,
    opening,
    reading,
    shown,
)
from knotgym.streams import Stream, derived_seed
from knotgym.tasks import TaskConfig

ALONE = (0.0,) * 6  # an action without force


class InvalidPrompting(KnotgymError, ValueError):
    """A model that cannot be put to the test as asked."""


@dataclass(frozen=True, kw_only=True)
class PromptConfig:
    """What a model is put to.

    Attributes:
        mode: "open", "stateless" or "stateful"; or "read", a picture's code.
        chat: whom to ask, and how.
        task: the environment; its horizon is the limit on actions, its image_size that of each
            picture. Not used in mode read.
        episodes: how many, or of mode read how many pictures at most.
        seed: of the episodes; episode i is the same in every mode, and in `evaluate`.
        window: past pictures and answers that mode stateful shows.
        tell_centre: say with the current picture where its middle is, which can't be seen.
        prompt_price, completion_price: of a million tokens; None for no cost.
        pictures: of mode read, the split that they are of, and their SHA-256 in a row.
    """

    mode: str
    chat: ChatConfig
    task: TaskConfig = TaskConfig(task="tie", image_size=256)
    episodes: int = 100
    seed: int = 0
    window: int = 4
    tell_centre: bool = False
    prompt_price: float | None = None
    completion_price: float | None = None
    pictures: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise InvalidPrompting(f"no mode {self.mode!r}; there is {', '.join(MODES)}")
        told = [
            name for name in ("prompt_price", "completion_price") if getattr(self, name) is not None
        ]
        check_numbers(
            self,
            counts=("episodes", "window"),
            whole=("seed",),
            non_negative=told,
            error=InvalidPrompting,
        )
        if len(told) == 1:
            raise InvalidPrompting("give both prices, of prompt and completion tokens, or neither")
        if self.task.views != ("top",) or self.task.depth:
            raise InvalidPrompting("prompts show the view from the top, without depth")


class Counts:
    """What an episode's replies count up to."""

    def __init__(self) -> None:
        self.retries: Counter[str] = Counter()
        self.prompt_tokens = self.completion_tokens = 0

    def add(self, reply: Reply) -> None:
        """Count one more."""
        self.retries.update(reply.retries)
        self.prompt_tokens += reply.prompt_tokens
        self.completion_tokens += reply.completion_tokens

    def as_fields(self) -> dict[str, Any]:
        """As a transcript has them."""
        return {
            "retries": dict(self.retries),
            "prompt_tokens": self.prompt_tokens,
            "completion_tokens": self.completion_tokens,
        }


def begun(config: PromptConfig, number: int) -> EpisodeBatch:
    """Episode `number` of a run at its beginning, alone in its batch."""
    episodes = EpisodeBatch(config.task)
    seed = derived_seed(Stream.EVALUATION_EPISODE, config.seed, number)
    episodes.begin(0, np.random.default_rng(seed))
    return episodes


def goal_shown(episodes: EpisodeBatch) -> Shown:
    """The goal's picture."""
    size = episodes.config.image_size
    return shown(episodes.picture(0)[:, size:], "goal", GOAL)


def now_shown(episodes: EpisodeBatch, config: PromptConfig) -> Shown:
    """The current picture."""
    size = episodes.config.image_size
    middle = episodes.simulation.points[0].mean(axis=0) / episodes.simulation.rope.config.reach
    above = caption(middle[:2].tolist() if config.tell_centre else None)
    return shown(episodes.picture(0)[:, :size], f"now-{int(episodes.steps[0])}", above)


def play(config: PromptConfig, number: int, ask: Asking) -> dict[str, Any]:
    """Play episode `number` of a run, every question put by `ask`; its transcript."""
    episodes, counts, most = begun(config, number), Counts(), config.task.horizon
    goal = goal_shown(episodes)
    before = opening(goal)
    start, done = episodes.info(0), False
    codes = [str(start["gauss_code"])]
    turns: list[dict[str, Any]] = []
    window: list[Turn] = []
    actions: list[list[float]] = []
    planned: list[list[float]] = []
    while not done:
        if config.mode != OPEN or not actions:
            now = now_shown(episodes, config)
            reply = ask(messages(before, window, config.mode, most, now))
            counts.add(reply)
            told, fault = read_actions(reply.text, most if config.mode == OPEN else 1)
            if reply.refused:
                told, fault = [], "refusal"
            planned = list(told)
            turns.append(
                {
                    "step": len(actions),
                    "picture": now.sha256,
                    "window": len(window),
                    "answer": reply.text,
                    "fault": fault,
                    "actions": told,
                    "retries": reply.retries,
                    "prompt_tokens": reply.prompt_tokens,
                    "completion_tokens": reply.completion_tokens,
                }
            )
            if config.mode == STATEFUL:
                window = [*window, Turn(now, reply.text)][-config.window :]
        # as float32, in which policies act, so that a replay is the same to the bit
        action = np.array(planned.pop(0) if planned else ALONE, dtype=np.float32)
        _, terminated, truncated = episodes.step(action[None], np.array([0]))
        actions.append(action.tolist())
        codes.append(str(episodes.codes[0]))
        done = bool(terminated[0] or truncated[0])
    return {
        "number": number,
        "config": flat(config),
        "start": int(start["start"]),
        "goal": int(start["goal"]),
        "goal_gauss_code": str(start["goal_gauss_code"]),
        "success": bool(episodes.info(0)["is_success"]),
        "gauss_code": codes,
        "actions": actions,
        "prompt": [part if isinstance(part, str) else {"picture": part.sha256} for part in before],
        "turns": turns,
        **counts.as_fields(),
    }


def read(config: PromptConfig, number: int, row: Mapping[str, Any], ask: Asking) -> dict[str, Any]:
    """Ask for the code of one picture; its transcript.

    Args:
        config: of the run.
        number: of the picture in its split.
        row: of a perception table.
        ask: puts the question.
    """
    counts, picture = Counts(), Shown(row["image"], "picture")
    parts = reading(picture)
    reply = ask([message(parts)])
    counts.add(reply)
    code, fault = read_code(reply.text)
    if reply.refused:
        code, fault = None, "refusal"
    return {
        "number": number,
        "config": flat(config),
        "picture": picture.sha256,
        "gauss_code": row["gauss_code"],
        "nx": row["nx"],
        "grade": row["grade"],
        "accepted": row["accepted"],
        "answer": reply.text,
        "read": None if code is None else str(code),
        "fault": fault,
        **counts.as_fields(),
    }


def flat(config: PromptConfig) -> dict[str, Any]:
    """A configuration as a transcript has it; of mode read without the task."""
    whole = as_json(config)
    if config.mode == READ:
        del whole["task"]
    return whole
