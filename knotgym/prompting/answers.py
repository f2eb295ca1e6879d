"""What a model's answer says, read strictly: one block, bracketed lists of six numbers in [-1, 1],
or one Gauss code. What isn't so has one of FAULTS, which are counted apart from failures at a task.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from knotgym.topology.gauss import GaussCode, InvalidGaussCode

FAULTS = (
    "refusal",  # the model would not, even when asked again
    "no block",
    "several blocks",
    "malformed",  # not lists of numbers, or no Gauss code
    "not six numbers",
    "not finite",
    "out of range",
    "number of actions",  # none, several where one was asked for, or more than may be
)
_LIST = re.compile(r"\[([^\[\]]*)\]")
_NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[+-]?(nan|inf|infinity)", re.IGNORECASE)
_LONGEST_CODE = 1000  # characters


class ActionsRead(NamedTuple):
    """Actions that an answer names, six numbers each; or none, and one of FAULTS."""

    actions: list[list[float]]
    fault: str = ""


class CodeRead(NamedTuple):
    """The code that an answer names; or None, and one of FAULTS."""

    code: GaussCode | None
    fault: str = ""


def read_actions(text: str, most: int) -> ActionsRead:
    """The actions in an answer, `most` of them at most.

    >>> read_actions("So: <answer>[0.1, 0, 0, 1, 0, 0]</answer>", 1)
    ActionsRead(actions=[[0.1, 0.0, 0.0, 1.0, 0.0, 0.0]], fault='')
    >>> read_actions("<answer>[0.1, 0, 0, 1.5, 0, 0]</answer>", 1).fault
    'out of range'
    """
    inside, fault = _block(text)
    if fault:
        return ActionsRead([], fault)
    if re.sub(r"[\s,]", "", _LIST.sub("", inside)):
        return ActionsRead([], "malformed")
    actions = []
    for match in _LIST.finditer(inside):
        words = [word.strip() for word in match[1].split(",")]
        fault = _fault_of(words)
        if fault:
            return ActionsRead([], fault)
        actions.append([float(word) for word in words])
    if not 1 <= len(actions) <= most:
        return ActionsRead([], "number of actions")
    return ActionsRead(actions)


def read_code(text: str) -> CodeRead:
    """The Gauss code in an answer, with brackets around it or without; of a flat loop nothing.

    >>> str(read_code("<answer>[1+, 1-]</answer>").code)
    '1+,1-'
    """
    inside, fault = _block(text)
    if fault:
        return CodeRead(None, fault)
    whole = _LIST.fullmatch(inside.strip())
    inside = whole[1] if whole else inside
    if len(inside) > _LONGEST_CODE:
        return CodeRead(None, "malformed")
    try:
        return CodeRead(GaussCode.parse(inside))
    except InvalidGaussCode:
        return CodeRead(None, "malformed")


def _block(text: str) -> tuple[str, str]:
    """What stands in the one block, and what is wrong."""
    opened, closed = text.count("<answer>"), text.count("</answer>")
    start, end = text.find("<answer>"), text.find("</answer>")
    if opened > 1 or closed > 1:
        return "", "several blocks"
    if start < 0 or end < start:
        return "", "no block"
    return text[start + len("<answer>") : end], ""


def _fault_of(words: list[str]) -> str:
    """What is wrong with the numbers of one action, "" if nothing."""
    if not all(_NUMBER.fullmatch(word) or _NOT_FINITE.fullmatch(word) for word in words):
        return "malformed"
    if len(words) != 6:
        return "not six numbers"
    values = [float(word) for word in words]
    if not all(map(math.isfinite, values)):
        return "not finite"
    return "" if all(abs(value) <= 1 for value in values) else "out of range"
