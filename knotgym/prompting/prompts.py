"""Prompts: texts (`prompts.toml`) and pictures in the published order, in our own words; settings.

    the task in one line
    the first picture
    what success means
    what an action is
    the goal's picture
    the current picture
    the question and the format of the answer

In mode stateful, the last two are repeated for each turn of the window, followed by the model's
answer, and then for the current turn. Source of the order: arXiv 2505.18028.
"""

import base64
import hashlib
import tomllib
from collections.abc import Sequence
from importlib.resources import files
from typing import Annotated, Any, NamedTuple

from knotgym.common import Count, InvalidInput, Seed, choice, configuration
from knotgym.envs import TaskConfig
from knotgym.prompting.chat import ChatConfig

MODES = ("open", "stateless", "stateful", "read")


_FOLDER = files("knotgym.prompting")
TEXTS = tomllib.loads((_FOLDER / "prompts.toml").read_text("utf-8"))
_SUCCESS = TEXTS["success"].format(code=TEXTS["code"])


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
        pictures: in mode read, the split of the pictures, then the SHA-256 of them all.
        side_by_side: concurrent requests to the server; makes no difference to them.
    """

    mode: Annotated[str, choice(*MODES)] = "stateless"
    chat: ChatConfig
    task: TaskConfig = TaskConfig(task="tie", image_size=256)
    episodes: Count = 100
    seed: Seed = 0
    window: Count = 4
    tell_centre: bool = False
    pictures: tuple[str, ...] = ()
    side_by_side: Count = 4

    def __post_init__(self) -> None:
        if self.task.views != ("top",) or self.task.depth:
            raise InvalidInput("prompts support only the view from the top, without depth")


class Picture(NamedTuple):
    """A picture in a prompt.

    Attributes:
        png: its bytes, as they are sent.
        caption: text before the picture.
    """

    png: bytes
    caption: str = ""

    @property
    def sha256(self) -> str:
        """SHA-256 of the PNG, hexadecimal."""
        return hashlib.sha256(self.png).hexdigest()


Part = str | Picture


class Turn(NamedTuple):
    """A past turn of an episode: the picture and the model's answer."""

    picture: Picture
    answer: str


# the explanatory picture with which every prompt begins; see docs/first_picture.py
FIRST = Picture((_FOLDER / "first-picture.png").read_bytes())


def opening(goal: Picture) -> list[Part]:
    """Return the parts with which all requests of an episode begin."""
    beginning = [TEXTS["task"], TEXTS["first"], FIRST, _SUCCESS, TEXTS["action"]]
    return [*beginning, goal.caption, goal]


def _turn_parts(mode: str, most: int, now: Picture) -> list[Part]:
    """Return the parts of one turn; `most` is the maximum number of actions."""
    question = TEXTS["open_question" if mode == "open" else "step_question"]
    return [now.caption, now, str(question.format(most=most))]


def reading(picture: Picture) -> list[dict[str, Any]]:
    """Build the messages of the request for a picture's code."""
    before = [TEXTS["read_task"], TEXTS["first"], FIRST, TEXTS["code"], TEXTS["read_form"]]
    return [_message([*before, TEXTS["rope"], picture, TEXTS["read_question"]])]


def messages(
    before: Sequence[Part], turns: Sequence[Turn], mode: str, most: int, now: Picture
) -> list[dict[str, Any]]:
    """Build the messages of a request, user and assistant in turn.

    Args:
        before: parts that `opening` returned.
        turns: past turns in the window, oldest first.
        mode, most, now: as for `_turn_parts`.
    """
    out: list[dict[str, Any]] = []
    parts = list(before)
    for turn in turns:
        out.append(_message([*parts, *_turn_parts(mode, most, turn.picture)]))
        # servers may reject an empty message
        out.append({"role": "assistant", "content": turn.answer or "(no answer)"})
        parts = []
    return [*out, _message([*parts, *_turn_parts(mode, most, now)])]


def _message(parts: Sequence[Part]) -> dict[str, Any]:
    """Build a user message of the chat-completions protocol."""
    return {"role": "user", "content": [*map(_content, parts)]}


def _content(part: Part) -> dict[str, Any]:
    if isinstance(part, str):
        return {"type": "text", "text": part}
    url = f"data:image/png;base64,{base64.b64encode(part.png).decode('ascii')}"
    return {"type": "image_url", "image_url": {"url": url}}
