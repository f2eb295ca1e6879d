"""What single moves of a diagram cost, and templates that make them, where none were counted.

A cost is one over the mean share of macro-actions that make a move of its kind among those counted
from codes of four crossings (from three for a finger laid over an arc), doubt included: 1.9 % a
kink, 1.2 % a finger, 4.5 and 5.1 % each taken back, 2.1 % a third move, 2.2 % the base point.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import product
from typing import NamedTuple

from knotgym.control.transition_counts import MacroTemplate
from knotgym.topology.gauss import GaussCode
from knotgym.topology.single_moves import removals, sideways

KINK_COST, FINGER_COST, DOWN_COST, SIDEWAYS_COST = 54.0, 83.0, 21.0, 47.0  # macro-actions
_SPOTS = (0.2, 0.5, 0.8)  # along an arc


class Before(NamedTuple):
    """A code from which one move leads to a given one, the move's cost, and templates of it."""

    code: GaussCode
    cost: float
    templates: list[MacroTemplate]


def leading_to(code: GaussCode) -> Iterator[Before]:
    """The codes of as many crossings, or fewer, from which one move leads to `code`.

    Those sideways come without templates.
    """
    for move in removals(code):
        cost = KINK_COST if move.kink else FINGER_COST
        yield Before(move.code, cost, _templates(move.kink, move.over, move.under))
    for before in sideways(code):
        yield Before(before, SIDEWAYS_COST, [])


@lru_cache(maxsize=50_000)
def below(code: GaussCode) -> tuple[GaussCode, ...]:
    """The codes with fewer crossings to which one move leads, each once."""
    return tuple(dict.fromkeys(move.code for move in removals(code)))


@lru_cache(maxsize=4096)
def _templates(kink: bool, over: int, under: int) -> list[MacroTemplate]:
    """Lead a bead of one arc past the other; or past the same arc, which curls it."""
    kind = "curl" if kink else "pass"
    return [
        template
        for at, past in product(_SPOTS, repeat=2)
        for template in (
            MacroTemplate(kind, 1, over + at, under + past),
            MacroTemplate(kind, -1, under + at, over + past),
        )
        if template.bead != template.target
    ]
