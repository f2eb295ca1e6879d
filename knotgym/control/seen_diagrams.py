"""Diagrams as seen from above: a Gauss code and the face of its diagram that lies outside.

A code describes a curve on a sphere. Which of the faces is the outer one tells whether a kink lies
inside the loop or outside, and which strands a bead meets on a straight way: the same macro-action
on the same code has other outcomes. The symmetries of `topology.symmetry` apply to both.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from knotgym.control.transition_counts import ELEMENTS, Element, transformed
from knotgym.rope.model import Array
from knotgym.topology.crossings import Crossings
from knotgym.topology.diagrams import faces
from knotgym.topology.gauss import GaussCode


class SeenDiagram(NamedTuple):
    """A code with chirality, and the darts of the outer face in increasing order.

    Edge k runs from visit k to the next; dart 2 k stands for its left side, dart 2 k + 1 for its
    right. The plain loop has one edge and no visits.
    """

    code: GaussCode
    outer: tuple[int, ...]

    @property
    def nx(self) -> int:
        """The number of crossings."""
        return self.code.nx

    def transformed(self, element: Element) -> SeenDiagram:
        """Apply a symmetry element; applying it twice gives the diagram back."""
        return _images(self)[ELEMENTS.index(element)]

    def image(self, number: int) -> SeenDiagram:
        """Apply element `number` of ELEMENTS."""
        return _images(self)[number] if number else self  # the first element is the identity


def seen_diagram(points: Array, crossings: Crossings) -> SeenDiagram:
    """Return the diagram of a rope at `points`, float64 (beads, 3), with these crossings."""
    # The vertex farthest to the right lies on the outer face. Where the curve turns left there, it
    # goes up, and has the outside on its right.
    vertex = int(np.argmax(points[:, 0]))
    before, here, after = points[np.arange(vertex - 1, vertex + 2) % len(points), :2]
    (ax, ay), (bx, by) = here - before, after - here
    right = int(ax * by - ay * bx > 0)
    code = crossings.code
    if not code.nx:
        return SeenDiagram(code, (right,))
    visits = np.concatenate([crossings.over_place, crossings.under_place])
    edge = (int((visits < vertex).sum()) - 1) % (2 * code.nx)
    dart = 2 * edge + right
    return SeenDiagram(code, next(face for face in _faces(code) if dart in face))


@lru_cache(maxsize=200_000)
def canonical_image(diagram: SeenDiagram) -> tuple[SeenDiagram, int]:
    """Return the first of a diagram's images, and the number of the element that gives it."""
    members = _images(diagram)
    number = min(range(len(members)), key=lambda k: (*_order(members[k]), k))
    return members[number], number


@lru_cache(maxsize=50_000)
def _faces(code: GaussCode) -> list[tuple[int, ...]]:
    return [tuple(sorted(face)) for face in faces(code)]


@lru_cache(maxsize=200_000)
def _images(diagram: SeenDiagram) -> tuple[SeenDiagram, ...]:
    return tuple(_transformed(diagram, element) for element in ELEMENTS)


def _transformed(diagram: SeenDiagram, element: Element) -> SeenDiagram:
    reverse, _, reflect = element
    outer, edges = diagram.outer, max(1, 2 * diagram.nx)
    if reverse:  # visit k becomes visit edges - 1 - k, and every edge is walked the other way
        outer = tuple(2 * ((edges - 2 - dart // 2) % edges) + 1 - dart % 2 for dart in outer)
    if reflect:
        outer = tuple(dart ^ 1 for dart in outer)
    return SeenDiagram(transformed(diagram.code, element), tuple(sorted(outer)))


def _order(diagram: SeenDiagram) -> tuple[tuple[int, ...], str, tuple[int, ...]]:
    return diagram.code.visits, diagram.code.chirality or "", diagram.outer
