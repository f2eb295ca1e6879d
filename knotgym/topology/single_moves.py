"""Single Reidemeister moves on codes with chirality: the diagrams one move away.

The base point stays on its strand. First and second moves are listed in the direction that removes
crossings; the reverse of a first move makes a kink in one arc, and that of a second move lays a
finger of one arc over another. Arc 0 runs from the base point to the first visit, and arc k from
the k-th visit to the next.

After a change run `pytest tests/topology/test_single_moves.py`: removals are the faces with one
and two sides, and each can be put back.
"""

from collections.abc import Iterator
from typing import NamedTuple

from knotgym.topology.diagrams import faces
from knotgym.topology.gauss import GaussCode


class Removal(NamedTuple):
    """A first or second move that removes crossings.

    Attributes:
        code: the code after the move.
        kink: whether it was a first move.
        over, under: the arcs of `code` on which the removed crossings lay, for the upper and the
            lower strand; equal for a kink.
    """

    code: GaussCode
    kink: bool
    over: int
    under: int


def removals(code: GaussCode) -> Iterator[Removal]:
    """Yield the removal of each kink and of each bigon.

    A bigon may be the outer face: then the upper strand is moved across the whole diagram.

    >>> [move.code.chiral for move in removals(GaussCode.parse("1+a,1-a,2-c,2+c"))]
    ['', '1-c,1+c', '1+a,1-a']
    """
    visits, signs = code.visits, code.signs
    count = len(visits)
    # where each visit stands; `-first` is the other visit of the same crossing
    index = {visit: k for k, visit in enumerate(visits)}
    # k and k - 1 are neighbouring visits; with one crossing both pairs are the same kink
    for k in range(1, 2) if count == 2 else range(count):
        first, second = visits[k - 1], visits[k]
        # Two visits of one crossing in a row: the edge between them is a loop.
        if first == -second:
            arc = k - 1 if k else 0
            yield Removal(_without(code, {abs(first)}), True, arc, arc)
        elif (
            first > 0
            and second > 0
            and signs[first - 1] != signs[second - 1]
            # Both strands meet the same two crossings one after the other, one strand over at both.
            # With signs that differ they cross there and back, and bound a bigon.
            and (index[-first] - index[-second]) % count in (1, count - 1)
        ):
            taken = {first, second}
            # Arcs are counted in the code without the two crossings, so those that stay before each
            # strand are what numbers it.
            over, under = [
                sum(abs(visit) not in taken for visit in visits[:start])
                for start in (k, _edge_end(index[-first], index[-second]))
            ]
            yield Removal(_without(code, taken), False, over, under)


def sideways(code: GaussCode) -> Iterator[GaussCode]:
    """Yield the codes one move away with as many crossings: base point shifts and third moves.

    >>> sum(1 for _ in sideways(GaussCode.parse("1+a,1-a")))
    2
    """
    if code.nx:
        # the base point slides over the first crossing, or back over the last
        yield code.rebased(1)
        yield code.rebased(-1)
    visits, count = code.visits, len(code.visits)
    for face in faces(code) if code.nx >= 3 else ():
        # dart 2 k and 2 k + 1 are the two sides of edge k, which leads from visit k to the next
        edges = [dart // 2 for dart in face]
        ends = [(visits[edge], visits[(edge + 1) % count]) for edge in edges]
        labels = {abs(visit) for pair in ends for visit in pair}
        # A triangle allows a third move if one of its edges is over at both ends, one under at
        # both, and one over at one end. The move swaps the two visits of each edge.
        heights = sorted((a > 0) + (b > 0) for a, b in ends)
        if len(face) == len(labels) == 3 and heights == [0, 1, 2]:
            moved = list(visits)
            # each strand passes its two crossings in the other order
            for edge in edges:
                after = (edge + 1) % count
                moved[edge], moved[after] = moved[after], moved[edge]
            yield code.of_visits(tuple(moved))


def _edge_end(one: int, other: int) -> int:
    """Return the later of two consecutive indices; 0 if they are the first and the last."""
    return 0 if abs(one - other) > 1 else max(one, other)


def _without(code: GaussCode, taken: set[int]) -> GaussCode:
    """Return the code without these crossings."""
    return code.of_visits(tuple([visit for visit in code.visits if abs(visit) not in taken]))
