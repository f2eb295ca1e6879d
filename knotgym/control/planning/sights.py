"""What planners see of a rope: its diagram from above, and where along the rope its arcs end.

A Gauss code describes a curve on a sphere. Which face of its diagram is the outer one tells whether
a kink lies inside the loop or outside, and which strands a bead meets on a straight path: the same
pass on the same code has other outcomes. So a `Diagram` is a code and its outer face.

Arcs are the stretches between consecutive visits of crossings. Arc 0 runs from the base bead to the
first visit, the last arc from the last visit back to the base bead, so a code of nx crossings has
2 nx + 1 arcs. A *position* is an arc plus a fraction: 2.25 is a quarter of the way along arc 2.

After a change run `pytest tests/control/planning/test_passes.py`: a symmetry of the rope must be
the same symmetry of its diagram.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from knotgym.common import Array, kernel
from knotgym.topology import CROSSING, GaussCode, Symmetry, faces, images, label_many, scan

# The eight symmetries are numbered as `symmetry.images` numbers a code's images. The bits of a
# number say which are applied, so applying k after j is applying k ^ j.
IMAGES = 8


class Diagram(NamedTuple):
    """A diagram as seen from above.

    Attributes:
        code: with chirality.
        outer: the darts of the outer face in increasing order; empty if the face doesn't matter.
            Edge k runs from visit k to the next; dart 2 k stands for its left side, dart 2 k + 1
            for its right. The plain loop has one edge and no visits.
    """

    code: GaussCode
    outer: tuple[int, ...] = ()

    @property
    def nx(self) -> int:
        """The number of crossings."""
        return self.code.nx

    def image(self, number: int) -> Diagram:
        """Apply a symmetry; applying it twice gives the diagram back."""
        return _images(self)[number] if number else self

    def canonical(self) -> tuple[Diagram, int]:
        """Return the first of the images, and the number of the symmetry that gives it."""
        return _canonical(self)


class Sight(NamedTuple):
    """What a rope looks like from above.

    Attributes:
        diagram: with its outer face.
        cuts: the ends of the arcs in beads from the base bead, increasing: the first is 0, the last
            the number of beads.
    """

    diagram: Diagram
    cuts: Sequence[float]

    @staticmethod
    def of(points: Array) -> list[Sight]:
        """See ropes at `points`, float64 (n, beads, 3), metres."""
        codes = label_many(points)
        most = 2 * max([code.nx for code in codes], default=0)
        cuts, darts = (array.tolist() for array in _sights(np.ascontiguousarray(points), most))
        beads = float(points.shape[1])
        return [
            Sight(_seen(code, dart), (0.0, *ends[: 2 * code.nx], beads))
            for code, dart, ends in zip(codes, darts, cuts, strict=True)
        ]

    def bead(self, position: float) -> int:
        """The bead at a position, which is clipped to the arcs there are."""
        arc = min(max(int(position), 0), len(self.cuts) - 2)
        start, end = self.cuts[arc], self.cuts[arc + 1]
        # The place is inside the arc, and the bead is the one that it lies on: rounded down.
        return int(start + min(max(position - arc, 0.0), 1.0) * (end - start)) % int(self.cuts[-1])


@lru_cache(maxsize=200_000)
def _canonical(diagram: Diagram) -> tuple[Diagram, int]:
    members = _images(diagram)
    number = min(range(IMAGES), key=lambda k: (*_order(members[k]), k))
    return members[number], number


@lru_cache(maxsize=10_000)
def first_goal(goal: GaussCode) -> tuple[GaussCode, int]:
    """Return the first of a goal's images, without chirality, and the symmetry that gives it."""
    members = images(goal.plain)
    number = min(range(IMAGES), key=lambda k: (members[k].visits, k))
    return members[number], number


@lru_cache(maxsize=100_000)
def _seen(code: GaussCode, dart: int) -> Diagram:
    """The diagram of a code whose outer face has a dart."""
    # a dart has exactly one face on its left, so one face has it
    outer = next(face for face in faces(code) if dart in face) if code.nx else [dart]
    return Diagram(code, tuple(sorted(outer)))


@lru_cache(maxsize=200_000)
def _images(diagram: Diagram) -> tuple[Diagram, ...]:
    edges, members = max(1, 2 * diagram.nx), images(diagram.code)
    diagrams = []
    for number, code in enumerate(members):
        outer: Sequence[int] = diagram.outer
        # visit k becomes visit edges - 1 - k, and edges are walked backwards
        if number & Symmetry.REVERSE:
            outer = [2 * ((edges - 2 - dart // 2) % edges) + 1 - dart % 2 for dart in outer]
        if number & Symmetry.REFLECT:
            outer = [dart ^ 1 for dart in outer]
        # sorted, as a face is a cycle that may begin anywhere
        diagrams.append(Diagram(code, tuple(sorted(outer))))
    return tuple(diagrams)


def _order(diagram: Diagram) -> tuple[tuple[int, ...], str, tuple[int, ...]]:
    return diagram.code.visits, diagram.code.chirality or "", diagram.outer


@kernel
def _sights(points, most):  # type: ignore[no-untyped-def]
    """Where arcs end, and a dart of each outer face.

    Returns:
        float64 (n, most), the places of the visits along the rope, sorted; int64 (n,) darts.
    """
    ropes, beads = points.shape[0], points.shape[1]
    cuts, darts = np.zeros((ropes, most)), np.empty(ropes, np.int64)
    for rope in range(ropes):
        # the crossings again: `label_many` keeps codes only, and places are needed of few ropes
        _, _, table = scan(points[rope])
        visits = 0
        for k in range(len(table)):
            for column in (CROSSING.over_place, CROSSING.under_place):
                # inserted in order: `np.sort` of so few would take seconds to compile
                place, at = table[k, column], visits
                while at > 0 and cuts[rope, at - 1] > place:
                    cuts[rope, at] = cuts[rope, at - 1]
                    at -= 1
                cuts[rope, at] = place
                visits += 1
        # The vertex farthest to the right lies on the outer face. Where the curve turns left there,
        # it goes up, and has the outside on its right.
        vertex, visited = 0, 0
        for k in range(beads):
            if points[rope, k, 0] > points[rope, vertex, 0]:
                vertex = k
        # how many visits come before the vertex, so that the edge that it lies on is known
        while visited < visits and cuts[rope, visited] < vertex:
            visited += 1
        before, after = (vertex - 1) % beads, (vertex + 1) % beads
        ax = points[rope, vertex, 0] - points[rope, before, 0]
        ay = points[rope, vertex, 1] - points[rope, before, 1]
        bx = points[rope, after, 0] - points[rope, vertex, 0]
        by = points[rope, after, 1] - points[rope, vertex, 1]
        # edge k runs from visit k to the next, and the last one over the base bead
        edge = (visited - 1) % visits if visits else 0
        darts[rope] = 2 * edge + (1 if ax * by - ay * bx > 0 else 0)
    return cuts, darts
