"""Prompts: texts and pictures in the published order, in our own words.

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
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.image_table import encode
from knotgym.prompting.first_picture import first_picture

MODES = ("open", "stateless", "stateful", "read")
OPEN, STATELESS, STATEFUL, READ = MODES

_TASK = (
    "Task: pull at single points of the closed rope in the current picture until it is tangled in"
    " the way in which the rope in the goal picture is."
)
_FIRST = (
    "This picture explains pulls and codes. Left: three pulls of full force on a flat loop, along"
    " x, y and z, each with the rope before it, the action, and the rope after it (where it lay"
    " before is grey); the pull along z is seen from the front. Right: a rope as you will see it,"
    " from above, with its Gauss code."
)
_CODE = (
    "Walk along the rope once, from the white bead towards red. Number the crossings 1, 2, 3 and so"
    " on, in the order in which you first come to them. Each time that you pass a crossing, write"
    " its number, and + if you are on the strand that lies over the other, or - if you are on the"
    " one that lies under it. So every number is written twice, once with + and once with -. A flat"
    " loop has no crossing, and its code is empty."
)
_SUCCESS = (
    "You succeed when the rope's Gauss code is the same as the goal's. Nothing else counts: not"
    f" where the rope lies, nor its shape. This is how a Gauss code is read: {_CODE}"
)
_ACTION = (
    "An action is six numbers [x, y, z, fx, fy, fz], each in [-1, 1]. The axes are right-"
    " handed: x points right in the picture, y up in it, and z out of it, towards you. (x, y, z)"
    " is a point near the rope, and is rounded to the nearest bead; the origin is the centre of"
    " the space, near the rope, and the camera follows the rope; the whole width of a picture is"
    " 0.33. (fx, fy, fz) is the force that pulls this bead; a force of 1 moves it by about 0.02"
    " in an action, and what hangs on it follows. For example, [0.1, 0, 0, 0, -0.5, 1] takes the"
    " bead nearest to a point right of the centre, lifts it with full force, and pulls it down"
    " in the picture with half the force."
)
GOAL = "The goal:"
_READ_TASK = "Task: read the Gauss code of the rope in the last picture."
_READ_FORM = (
    "The code is written like that in the first picture: visits with commas between them, a number"
    " and + or - each."
)
_READ_QUESTION = (
    "What is the Gauss code of this rope? Think it through step by step. Then give the code in one"
    " block and write nothing after it, such as <answer>1+,1-,2-,2+</answer>, or for a flat loop"
    " <answer></answer>."
)


@dataclass(frozen=True)
class Picture:
    """A picture in a prompt.

    Attributes:
        png: its bytes, as they are sent.
        name: short name for people, such as "goal".
        caption: text before the picture.
    """

    png: bytes
    name: str
    caption: str = ""

    @property
    def sha256(self) -> str:
        """SHA-256 of the PNG, hexadecimal."""
        return hashlib.sha256(self.png).hexdigest()


Part = str | Picture


@dataclass(frozen=True)
class Turn:
    """A past turn of an episode: the picture and the model's answer."""

    picture: Picture
    answer: str


def encode_picture(picture: NDArray[np.uint8], name: str, caption: str = "") -> Picture:
    """Encode a picture, uint8 (height, width, 3), RGB, for a prompt."""
    return Picture(encode(picture), name, caption)


def caption(centre: Sequence[float] | None) -> str:
    """Return the current picture's caption; `centre` is its middle's x and y in action units.

    >>> caption((0.0123, -0.1))
    'The rope now; the middle of this picture is at x = 0.012, y = -0.100:'
    """
    if centre is None:
        return "The rope now:"
    x, y = centre
    return f"The rope now; the middle of this picture is at x = {x:.3f}, y = {y:.3f}:"


@lru_cache(maxsize=1)
def first() -> Picture:
    """Return the explanatory picture with which every prompt begins."""
    return encode_picture(first_picture(), "first")


def question(mode: str, most: int) -> str:
    """Return a mode's question; `most` is the maximum number of actions."""
    if mode == OPEN:
        return (
            "Which actions, one after the other, bring the rope to the goal? You see no picture in"
            " between. Think it through step by step. Then give the actions in one block and write"
            f" nothing after it: from 1 to {most} lists of six numbers, such as"
            " <answer>[0.1, 0, 0, 0, -0.5, 1] [0, 0.1, 0, 1, 0, 0]</answer>."
        )
    return (
        "Which action is the next one on the way to the goal? Afterwards you are shown the rope"
        f" again; {most} actions in all may be taken. Think it through step by step. Then give the"
        " one action in one block and write nothing after it, such as"
        " <answer>[0.1, 0, 0, 0, -0.5, 1]</answer>."
    )


def opening(goal: Picture) -> list[Part]:
    """Return the parts with which all requests of an episode begin."""
    return [_TASK, _FIRST, first(), _SUCCESS, _ACTION, goal.caption, goal]


def turn_parts(mode: str, most: int, now: Picture) -> list[Part]:
    """Return the parts of one turn."""
    return [now.caption, now, question(mode, most)]


def reading(picture: Picture) -> list[Part]:
    """Return the parts of the request for a picture's code."""
    return [_READ_TASK, _FIRST, first(), _CODE, _READ_FORM, "The rope:", picture, _READ_QUESTION]


def messages(
    before: Sequence[Part], turns: Sequence[Turn], mode: str, most: int, now: Picture
) -> list[dict[str, Any]]:
    """Build the messages of a request, user and assistant in turn.

    Args:
        before: parts that `opening` returned.
        turns: past turns in the window, oldest first.
        mode, most, now: as for `turn_parts`.
    """
    out: list[dict[str, Any]] = []
    parts = list(before)
    for turn in turns:
        out.append(message([*parts, *turn_parts(mode, most, turn.picture)]))
        # servers may reject an empty message
        out.append({"role": "assistant", "content": turn.answer or "(no answer)"})
        parts = []
    return [*out, message([*parts, *turn_parts(mode, most, now)])]


def message(parts: Sequence[Part]) -> dict[str, Any]:
    """Build a user message of the chat-completions protocol."""
    content = [
        {"type": "text", "text": part}
        if isinstance(part, str)
        else {
            "type": "image_url",
            "image_url": {
                "url": f"data:image/png;base64,{base64.b64encode(part.png).decode('ascii')}"
            },
        }
        for part in parts
    ]
    return {"role": "user", "content": content}


def as_text(conversation: Sequence[dict[str, Any]], names: dict[str, str]) -> str:
    """Format messages for people; `names` maps the SHA-256 of each PNG to its picture's name."""
    lines = []
    for one in conversation:
        lines.append(f"--- {one['role']}")
        content = one["content"]
        if isinstance(content, str):
            lines.append(content)
            continue
        for part in content:
            if part["type"] == "text":
                lines.append(part["text"])
            else:
                png = base64.b64decode(part["image_url"]["url"].partition(",")[2])
                lines.append(f"[picture: {names[hashlib.sha256(png).hexdigest()]}]")
    return "\n".join(lines) + "\n"
