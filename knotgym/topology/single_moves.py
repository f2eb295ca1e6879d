"""Reidemeister's moves one at a time, on codes with chirality: what a diagram may show next.

The base point stays on its strand. First and second moves are given as they take crossings out;
put in again, a kink curls up one arc, and a finger of one arc is laid over another. Arc 0 runs from
the base point to the first visit, arc k from visit k to the next.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from knotgym.topology.diagrams import faces
from knotgym.topology.gauss import GaussCode


class Removal(NamedTuple):
    """A first or second move that takes crossings out.

    Attributes:
        code: what is left.
        kink: it was a first move.
        over, under: arcs of it that the crossings taken out lay on, the upper strand's and the
            lower one's; the same for a kink.
    """

    code: GaussCode
    kink: bool
    over: int
    under: int


def removals(code: GaussCode) -> Iterator[Removal]:
    """Every kink and every bigon taken out by itself.

    A bigon may be the outer face: the rope's upper strand is laid over all the rest.

    >>> [move.code.chiral for move in removals(GaussCode.parse("1+a,1-a,2-c,2+c"))]
    ['', '1-c,1+c', '1+a,1-a']
    """
    visits, signs = code.visits, code.signs
    count = len(visits)
    place = {visit: k for k, visit in enumerate(visits)}
    for k in range(1, 2) if count == 2 else range(count):
        first, second = visits[k - 1], visits[k]
        if first == -second:
            arc = k - 1 if k else 0
            yield Removal(_without(code, {abs(first)}), True, arc, arc)
        elif (
            first > 0
            and second > 0
            and signs[first - 1] != signs[second - 1]
            and (place[-first] - place[-second]) % count in (1, count - 1)
        ):
            taken = {first, second}
            over, under = [
                sum(abs(visit) not in taken for visit in visits[:start])
                for start in (k, _later(place[-first], place[-second]))
            ]
            yield Removal(_without(code, taken), False, over, under)


def sideways(code: GaussCode) -> Iterator[GaussCode]:
    """Codes as long, one move away: the base point past a crossing, and every third move.

    >>> sum(1 for _ in sideways(GaussCode.parse("1+a,1-a")))
    2
    """
    if code.nx:
        yield code.rebased(1)
        yield code.rebased(-1)
    visits, count = code.visits, len(code.visits)
    for face in faces(code) if code.nx >= 3 else ():
        edges = [dart // 2 for dart in face]
        ends = [(visits[edge], visits[(edge + 1) % count]) for edge in edges]
        labels = {abs(visit) for pair in ends for visit in pair}
        heights = sorted((a > 0) + (b > 0) for a, b in ends)
        if len(face) == len(labels) == 3 and heights == [0, 1, 2]:
            moved = list(visits)
            for edge in edges:
                after = (edge + 1) % count
                moved[edge], moved[after] = moved[after], moved[edge]
            yield code.of_visits(tuple(moved))


def _later(one: int, other: int) -> int:
    """The place that ends the edge between two neighbouring places; 0 if it holds the base."""
    return 0 if abs(one - other) > 1 else max(one, other)


def _without(code: GaussCode, taken: set[int]) -> GaussCode:
    """The code after some labels are gone."""
    return code.of_visits(tuple([visit for visit in code.visits if abs(visit) not in taken]))
