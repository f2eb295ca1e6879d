"""Parse a model's answer strictly.

An answer must have one <answer> block that holds bracketed lists of six numbers in [-1, 1], or one
Gauss code. How a model sets them off doesn't count: the marks of Markdown around them (backticks,
also fences with the name of a language, `**`, `$`, quotes), other signs for minus (U+2212, dashes),
full-width characters. Anything else has a fault, counted apart from failures at the task:

    refusal            the model refused in every attempt, or the server rejected the request
    empty              the answer was empty in every attempt
    no block           or an end without a beginning
    several blocks
    malformed          neither lists of numbers nor a Gauss code
    not six numbers
    not finite
    out of range
    number of actions  none, or more than allowed
"""

import math
import re
import unicodedata

from knotgym.common import InvalidInput
from knotgym.topology import GaussCode

_LIST = re.compile(r"\[([^\[\]]*)\]")
_NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[+-]?(nan|inf|infinity)", re.IGNORECASE)
_LONGEST_CODE = 1000  # characters
_FENCE = re.compile(r"\s*```[A-Za-z]*\n(.*)```\s*", re.DOTALL)
# what sets a text off in Markdown or TeX, or quotes it
_MARKS = "`*$\"'\u2018\u2019\u201c\u201d\u00ab\u00bb"
_MINUS = str.maketrans(dict.fromkeys("\u2010\u2011\u2012\u2013\u2014\u2212\ufe63", "-"))


def read_actions(text: str, most: int) -> tuple[list[list[float]], str]:
    """Return the actions of an answer, up to `most` of six numbers each, or none and a fault.

    >>> read_actions("So: <answer>[0.1, 0, 0, 1, 0, 0]</answer>", 1)
    ([[0.1, 0.0, 0.0, 1.0, 0.0, 0.0]], '')
    >>> read_actions("<answer>[0.1, 0, 0, 1.5, 0, 0]</answer>", 1)
    ([], 'out of range')
    """
    inside, fault = _block(text)
    if fault:
        return [], fault
    if re.sub(r"[\s,]", "", _LIST.sub("", inside)):
        return [], "malformed"
    actions = []
    for match in _LIST.finditer(inside):
        words = [word.strip() for word in match[1].split(",")]
        fault = _fault_of(words)
        if fault:
            return [], fault
        actions.append([float(word) for word in words])
    if not 1 <= len(actions) <= most:
        return [], "number of actions"
    return actions, ""


def read_code(text: str) -> tuple[GaussCode | None, str]:
    """Return an answer's Gauss code, in brackets or not, or None and a fault.

    An empty block is a flat loop.

    >>> str(read_code("<answer>[1+, 1-]</answer>")[0])
    '1+,1-'
    """
    inside, fault = _block(text)
    if fault:
        return None, fault
    whole = _LIST.fullmatch(inside.strip())
    inside = whole[1] if whole else inside
    if len(inside) > _LONGEST_CODE:
        return None, "malformed"
    try:
        return GaussCode.parse(inside), ""
    except InvalidInput:
        return None, "malformed"


def _block(text: str) -> tuple[str, str]:
    """Return the content of the only block, and a fault or \"\"."""
    opened, closed = text.count("<answer>"), text.count("</answer>")
    start, end = text.find("<answer>"), text.find("</answer>")
    if opened > 1 or closed > 1:
        return "", "several blocks"
    if start < 0 or end < start:
        return "", "no block"
    return _plain(text[start + len("<answer>") : end]), ""


def _plain(inside: str) -> str:
    """Return what is in a block without marks around it, in plain characters.

    >>> _plain("**`[1+, 1\u2212]`**")
    '[1+, 1-]'
    """
    inside = unicodedata.normalize("NFKC", inside).translate(_MINUS)
    if fenced := _FENCE.fullmatch(inside):
        inside = fenced[1]
    lines = (line.strip().strip(_MARKS) for line in inside.splitlines())
    return "\n".join(lines)


def _fault_of(words: list[str]) -> str:
    """Return the fault in the numbers of one action, or \"\"."""
    if not all(_NUMBER.fullmatch(word) or _NOT_FINITE.fullmatch(word) for word in words):
        return "malformed"
    if len(words) != 6:
        return "not six numbers"
    values = [float(word) for word in words]
    if not all(map(math.isfinite, values)):
        return "not finite"
    return "" if all(abs(value) <= 1 for value in values) else "out of range"
