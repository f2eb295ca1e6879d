"""Play episodes with a model, or have it read pictures; record each as a transcript.

The model is asked once per action, or in mode open once per episode. Where an answer is invalid, or
the actions of mode open are used up, the step is a no-op: an action without force. So a transcript
always has a full sequence of actions, which `knotgym evaluate --policy prompt:FILE` replays to the
same codes.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np

from knotgym.common.configuration import Count, NonNegative, Seed, as_json, choice, configuration
from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream, derived_seed
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.prompting.answers import read_actions, read_code
from knotgym.prompting.chat import ChatConfig, Reply
from knotgym.prompting.kept_replies import Asking
from knotgym.prompting.prompts import (
    MODES,
    OPEN,
    READ,
    STATEFUL,
    TEXTS,
    Picture,
    Turn,
    caption,
    encode_picture,
    message,
    messages,
    opening,
    reading,
)
from knotgym.prompting.transcripts import PRICES

_NO_OP = (0.0,) * 6  # an action without force


@configuration
class PromptConfig:
    """Settings of a run.

    Attributes:
        mode: what is asked; open: one answer with all actions; stateless: one action per request;
            stateful: the same, with past pictures and answers; read: the Gauss code of a picture.
        chat: settings of the client.
        task: the environment; its horizon limits the actions, and its image_size is that of each
            picture. Unused in mode read.
        episodes: number of episodes, or of pictures from the start of the split.
        seed: random seed of the episodes. Episode i is the same in every mode and in `evaluate`.
        window: past turns included in mode stateful.
        tell_centre: tell the model the world coordinates of the picture's centre.
        prompt_price: price of a million prompt tokens.
        completion_price: price of a million completion tokens.
        side_by_side: concurrent requests to the server.
        pictures: in mode read, the split of the pictures, then the SHA-256 of each.
    """

    mode: Annotated[str, choice(*MODES)] = "stateless"
    chat: ChatConfig
    task: TaskConfig = TaskConfig(task="tie", image_size=256)
    episodes: Count = 100
    seed: Seed = 0
    window: Count = 4
    tell_centre: bool = False
    prompt_price: NonNegative | None = None
    completion_price: NonNegative | None = None
    side_by_side: Count = 4
    pictures: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        prices = [name for name in PRICES if getattr(self, name) is not None]
        if len(prices) == 1:
            raise InvalidInput("give the prices of both prompt and completion tokens, or neither")
        if self.task.views != ("top",) or self.task.depth:
            raise InvalidInput("prompts support only the view from the top, without depth")


def _totals(replies: Sequence[Reply]) -> dict[str, Any]:
    """Add up the retries and tokens of an episode's replies, as fields of a transcript."""
    return {
        "retries": dict(sum((Counter(reply.retries) for reply in replies), Counter())),
        "prompt_tokens": sum(reply.prompt_tokens for reply in replies),
        "completion_tokens": sum(reply.completion_tokens for reply in replies),
    }


def begin_episode(config: PromptConfig, number: int) -> EpisodeBatch:
    """Reset to episode `number` of a run, in a batch of one."""
    episodes = EpisodeBatch(config.task)
    seed = derived_seed(Stream.EVALUATION_EPISODE, config.seed, number)
    episodes.begin(0, np.random.default_rng(seed))
    return episodes


def goal_picture(episodes: EpisodeBatch) -> Picture:
    """Encode the goal's picture."""
    size = episodes.config.image_size
    return encode_picture(episodes.picture(0)[:, size:], "goal", TEXTS["goal"])


def current_picture(episodes: EpisodeBatch, config: PromptConfig) -> Picture:
    """Encode the current picture, with its caption."""
    size = episodes.config.image_size
    middle = episodes.simulation.points[0].mean(axis=0) / episodes.simulation.rope.config.reach
    heading = caption(middle[:2].tolist() if config.tell_centre else None)
    return encode_picture(episodes.picture(0)[:, :size], f"now-{int(episodes.steps[0])}", heading)


def play(config: PromptConfig, number: int, ask: Asking) -> dict[str, Any]:
    """Play episode `number` of a run; return its transcript."""
    episodes, most = begin_episode(config, number), config.task.horizon
    replies: list[Reply] = []
    goal = goal_picture(episodes)
    before = opening(goal)
    start, done = episodes.info(0), False
    codes = [str(start["gauss_code"])]
    turns: list[dict[str, Any]] = []
    window: list[Turn] = []
    actions: list[list[float]] = []
    planned: list[list[float]] = []
    while not done:
        if config.mode != OPEN or not actions:
            now = current_picture(episodes, config)
            reply = ask(messages(before, window, config.mode, most, now))
            replies.append(reply)
            answered, fault = read_actions(reply.text, most if config.mode == OPEN else 1)
            if reply.refused:
                answered, fault = [], "refusal"
            planned = list(answered)
            turns.append(
                {
                    "step": len(actions),
                    "picture": now.sha256,
                    "window": len(window),
                    "answer": reply.text,
                    "fault": fault,
                    "actions": answered,
                    "retries": reply.retries,
                    "prompt_tokens": reply.prompt_tokens,
                    "completion_tokens": reply.completion_tokens,
                }
            )
            if config.mode == STATEFUL:
                window = [*window, Turn(now, reply.text)][-config.window :]
        # float32, as in policies, so that a replay is the same to the bit
        action = np.array(planned.pop(0) if planned else _NO_OP, dtype=np.float32)
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
        **_totals(replies),
    }


def read(config: PromptConfig, number: int, row: Mapping[str, Any], ask: Asking) -> dict[str, Any]:
    """Ask for the Gauss code of one picture; return the transcript.

    Args:
        number: index of the picture in its split.
        row: the picture's row of a perception table.
    """
    picture = Picture(row["image"], "picture")
    parts = reading(picture)
    reply = ask([message(parts)])
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
        **_totals([reply]),
    }


def flat(config: PromptConfig) -> dict[str, Any]:
    """Convert settings to the JSON of a transcript; in mode read, without the task."""
    fields = as_json(config)
    if config.mode == READ:
        del fields["task"]
    return fields
