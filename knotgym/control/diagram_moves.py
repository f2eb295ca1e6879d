"""What single moves of a diagram cost, and templates that make them, where none were counted.

Costs are macro-actions, as those of the changes counted, so that both can make up one path. Of
random ones from codes of four crossings 1.9 % make a given kink, 1.2 % lay a given finger (from
three), 4.5 and 5.1 % take one back, 2.1 % make a third move, 2.2 % move the base point.
Templates make them oftener. Acted out from twelve drawn states of six crossings: the base point
41 %, a third move 26 %, a bigon taken back 59 %, a kink 24 %; from eight, a finger laid 8 %, a kink
made 5 %. Kinks need an arc of ten beads or more, so they cost what a finger does.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import product
from typing import NamedTuple

from knotgym.control.transition_counts import MacroTemplate
from knotgym.topology.gauss import GaussCode
from knotgym.topology.single_moves import Sideways, removals, sideways

KINK_COST, FINGER_COST, DOWN_COST, SIDEWAYS_COST = 80.0, 80.0, 21.0, 40.0  # macro-actions
_SPOTS = (0.2, 0.5, 0.8)  # along an arc


class Move(NamedTuple):
    """A move, by the code at its other end: what it costs, and templates of it."""

    code: GaussCode
    cost: float
    templates: list[MacroTemplate]


def leading_to(code: GaussCode) -> Iterator[Move]:
    """From which codes of as many crossings, or fewer, one move leads to `code`."""
    for move in removals(code):
        cost = KINK_COST if move.kink else FINGER_COST
        yield Move(move.code, cost, _laying(move.kink, move.over, move.under))
    for back in sideways(code):
        if back.triangle:
            yield Move(back.code, SIDEWAYS_COST, _shifting(back.code, back))
        elif _rolls(code, back.slid):
            yield Move(back.code, KINK_COST, [])
        else:
            yield Move(back.code, SIDEWAYS_COST, _sliding(back.code, -back.slid))


def _rolls(code: GaussCode, way: int) -> bool:
    """Whether the base point would be moved into a kink or out of one: rolling a kink along."""
    visits = code.visits
    passed = visits[0 if way == 1 else -1]
    return -passed in (visits[0], visits[-1], visits[1 if way == 1 else -2])


def leading_down(code: GaussCode) -> Iterator[Move]:
    """To which codes of fewer crossings one move leads from `code`."""
    for move in removals(code):
        if move.kink:
            loop = move.upper
            templates = [
                MacroTemplate("curl", side, loop + at, float(loop))
                for at, side in product(_SPOTS, (1, -1))
            ]
        else:
            templates = _exchanging(move.upper, move.lower)
        yield Move(move.code, DOWN_COST, templates)


@lru_cache(maxsize=50_000)
def below(code: GaussCode) -> tuple[GaussCode, ...]:
    """The codes with fewer crossings to which one move leads, each once."""
    return tuple(dict.fromkeys(move.code for move in removals(code)))


@lru_cache(maxsize=4096)
def _laying(kink: bool, over: int, under: int) -> list[MacroTemplate]:
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


def _exchanging(upper: int, lower: int) -> list[MacroTemplate]:
    """Lead one side of a bigon past the other's middle."""
    return [
        template
        for at in _SPOTS
        for template in (
            MacroTemplate("pass", 1, upper + at, lower + 0.5),
            MacroTemplate("pass", -1, lower + at, upper + 0.5),
        )
    ]


def _shifting(code: GaussCode, move: Sideways) -> list[MacroTemplate]:
    """Lead the upper side of a triangle past the lower ones' crossing, or the lower one below."""
    upper, middle, lower = move.triangle

    def crossing(side: int, other: int) -> float:
        """Where the two cross, as a place on the first."""
        labels = {
            abs(visit) for visit in (code.visits[other - 1], code.visits[other % len(code.visits)])
        }
        return side + (0.02 if abs(code.visits[side - 1]) in labels else 0.98)

    return [
        MacroTemplate("pass", way, led + at, target)
        for way, led, targets in (
            (1, upper, (crossing(middle, lower), crossing(lower, middle))),
            (-1, lower, (crossing(middle, upper), crossing(upper, middle))),
        )
        for at, target in product(_SPOTS, targets)
    ]


def _sliding(code: GaussCode, way: int) -> list[MacroTemplate]:
    """Lead the strand that the base point's crosses first (1) or last (-1) past the base point."""
    last = len(code.visits)
    visit = code.visits[0 if way == 1 else -1]
    partner = code.visits.index(-visit) + 1
    targets = (last + 0.3, last + 0.7, last + 0.98) if way == 1 else (0.02, 0.3, 0.7)
    side = -1 if visit > 0 else 1
    return [
        MacroTemplate("pass", side, partner + at, target)
        for at, target in product((-0.15, 0.15), targets)
    ]
