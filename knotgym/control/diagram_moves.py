"""Costs of single Reidemeister moves, and templates for them, where no counts exist.

A cost is a number of macro-actions: one over the mean rate at which macro-actions from codes of
four crossings make such a move in the counts that ship (three crossings for a finger), with the
same `doubt` as there. The rates are 1.9 % for adding a kink (R1), 1.2 % for a finger laid over an
arc (R2), 4.5 % and 5.1 % for undoing them, 2.1 % for a third move (R3) and 2.2 % for a move of the
base point.
"""

from collections.abc import Iterator
from functools import lru_cache
from itertools import product
from typing import NamedTuple

from knotgym.control.transition_counts import MacroTemplate
from knotgym.topology.gauss import GaussCode
from knotgym.topology.single_moves import removals, sideways

# R1 and R2 that add crossings, either of them undone, and moves that keep their number
KINK_COST, FINGER_COST, DOWN_COST, SIDEWAYS_COST = 54.0, 83.0, 21.0, 47.0  # macro-actions
_SPOTS = (0.2, 0.5, 0.8)  # fractions of an arc at which templates place their beads


class Before(NamedTuple):
    """A code from which one move leads to a given code.

    Attributes:
        code: the code before the move.
        cost: of the move, macro-actions.
        templates: macro-actions that may make it.
    """

    code: GaussCode
    cost: float
    templates: list[MacroTemplate]


def leading_to(code: GaussCode) -> Iterator[Before]:
    """Yield the codes with at most as many crossings from which one move leads to `code`.

    Codes with equally many crossings (R3, or a move of the base point) come without templates.
    """
    # a move that adds crossings is found as one that removes them, run backwards
    for move in removals(code):
        cost = KINK_COST if move.kink else FINGER_COST
        yield Before(move.code, cost, _templates(move.kink, move.over, move.under))
    for before in sideways(code):
        yield Before(before, SIDEWAYS_COST, [])


@lru_cache(maxsize=50_000)
def below(code: GaussCode) -> tuple[GaussCode, ...]:
    """Codes with fewer crossings that one move leads to, without repetitions."""
    return tuple(dict.fromkeys(move.code for move in removals(code)))


@lru_cache(maxsize=4096)
def _templates(kink: bool, over: int, under: int) -> list[MacroTemplate]:
    """Templates that lead a bead of one arc past the other; past its own arc for a kink.

    `over` and `under` are the arcs that become the upper and the lower strand. Either one may move:
    the upper over the lower, or the lower under the upper.
    """
    kind = "curl" if kink else "pass"
    return [
        template
        for at, past in product(_SPOTS, repeat=2)
        for template in (
            MacroTemplate(kind, 1, over + at, under + past),
            MacroTemplate(kind, -1, under + at, over + past),
        )
        if template.bead != template.target  # within a kink's single arc the two may coincide
    ]
