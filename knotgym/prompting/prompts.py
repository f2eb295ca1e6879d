"""What a model is asked: texts and pictures in the published order, in our own words.

    the task in a line
    the first picture
    what success means
    what an action is
    the goal's picture
    the current picture
    the question, and the form of the answer

In mode stateful the last two come again for each turn of the window, the model's own answer between
them, and last for the turn that is asked about. Source of the order: arXiv 2505.18028.
"""

from __future__ import annotations

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
class Shown:
    """A picture in a prompt.

    Attributes:
        png: its bytes, as they are sent.
        name: what it shows, for people.
        caption: what stands above it.
    """

    png: bytes
    name: str
    caption: str = ""

    @property
    def sha256(self) -> str:
        """Hexadecimal, of the PNG."""
        return hashlib.sha256(self.png).hexdigest()


Part = str | Shown


@dataclass(frozen=True)
class Turn:
    """A turn of an episode that is over: what was shown, and what the model answered."""

    shown: Shown
    answer: str


def shown(picture: NDArray[np.uint8], name: str, caption: str = "") -> Shown:
    """A picture, uint8 (height, width, 3), RGB, as a prompt has it."""
    return Shown(encode(picture), name, caption)


def caption(centre: Sequence[float] | None) -> str:
    """What stands above the current picture; its middle, x and y in units of an action, if told.

    >>> caption((0.0123, -0.1))
    'The rope now; the middle of this picture is at x = 0.012, y = -0.100:'
    """
    if centre is None:
        return "The rope now:"
    x, y = centre
    return f"The rope now; the middle of this picture is at x = {x:.3f}, y = {y:.3f}:"


@lru_cache(maxsize=1)
def first() -> Shown:
    """The first picture of every prompt."""
    return shown(first_picture(), "first")


def question(mode: str, most: int) -> str:
    """The question of a mode; in mode open an answer holds `most` actions at most."""
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


def opening(goal: Shown) -> list[Part]:
    """The parts that all questions of an episode begin with."""
    return [_TASK, _FIRST, first(), _SUCCESS, _ACTION, goal.caption, goal]


def asked(mode: str, most: int, now: Shown) -> list[Part]:
    """The parts of one turn."""
    return [now.caption, now, question(mode, most)]


def reading(picture: Shown) -> list[Part]:
    """The parts of the question for a picture's code."""
    return [_READ_TASK, _FIRST, first(), _CODE, _READ_FORM, "The rope:", picture, _READ_QUESTION]


def messages(
    before: Sequence[Part], turns: Sequence[Turn], mode: str, most: int, now: Shown
) -> list[dict[str, Any]]:
    """A question as the protocol has it, user and assistant in turn.

    Args:
        before: as of `opening`.
        turns: those of the window, the oldest first.
        mode, most, now: as of `asked`.
    """
    out: list[dict[str, Any]] = []
    parts = list(before)
    for turn in turns:
        out.append(message([*parts, *asked(mode, most, turn.shown)]))
        # a server may refuse a message without words
        out.append({"role": "assistant", "content": turn.answer or "(no answer)"})
        parts = []
    return [*out, message([*parts, *asked(mode, most, now)])]


def message(parts: Sequence[Part]) -> dict[str, Any]:
    """What the user says, as the protocol has it."""
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


def as_text(said: Sequence[dict[str, Any]], names: dict[str, str]) -> str:
    """Messages for people: pictures by their names, SHA-256 of a PNG -> name."""
    lines = []
    for one in said:
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
