"""The symmetries of a rope's diagrams: what one way to a diagram teaches about others.

Turning the rope about z, looking at it in a mirror (x -> -x), switching over and under (z -> -z), walking it the other way
and starting the walk at another bead take rope motions to rope motions: the physics doesn't see them, but for where the
loop is cut into sub-chains. A way to one Gauss code is so a way to every code of its *class*.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from knotgym.gauss import GaussCode
from knotgym.rope import Array


@dataclass(frozen=True)
class Symmetry:
    """Mirror and switch and turn the rope, then walk it the other way, then start at another vertex.

    Attributes:
        reflect: x -> -x first.
        switch: z -> -z.
        turn: about z, radians, after the reflection.
        reverse: the new vertex j is the old vertex -j.
        roll: then, the new vertex j is the old vertex j + roll.
    """

    reflect: bool = False
    switch: bool = False
    turn: float = 0.0
    reverse: bool = False
    roll: int = 0

    def vectors(self, v: Array) -> Array:
        """Positions or forces (..., 3), as the symmetry moves them."""
        out = v * (-1.0 if self.reflect else 1.0, 1.0, -1.0 if self.switch else 1.0)
        c, s = np.cos(self.turn), np.sin(self.turn)
        return np.asarray(np.stack([c * out[..., 0] - s * out[..., 1], s * out[..., 0] + c * out[..., 1], out[..., 2]], axis=-1))

    def configuration(self, points: Array) -> Array:
        """A configuration (beads, 3), moved and renumbered."""
        index = np.arange(len(points)) + self.roll
        return self.vectors(points)[(-index if self.reverse else index) % len(points)]

    def beads(self, beads: NDArray[np.integer], count: int) -> NDArray[np.int64]:
        """New numbers of beads; bead b lies between the vertices b and b + 1."""
        old = np.asarray(beads, dtype=np.int64)
        return ((-old - 1 if self.reverse else old) - self.roll) % count


def variants(code: GaussCode) -> Iterator[tuple[GaussCode, Symmetry, int]]:
    """Every code of the class of `code` with a symmetry that leads there.

    Yields:
        The code, the symmetry with roll and turn still 0, and how many visits of the reversed (or not) code the new base
        point lies after; a class member comes as often as there are ways to it.
    """
    for reverse in (False, True):
        walked = code.reversed() if reverse else code
        for visits in range(max(1, 2 * code.nx)):
            based = walked.rebased(visits)
            for switch in (False, True):
                for reflect in (False, True):
                    shown = based.mirrored() if switch else based
                    yield shown.reflected() if reflect else shown, Symmetry(reflect=reflect, switch=switch, reverse=reverse), visits


@lru_cache(maxsize=200_000)
def class_of(code: GaussCode) -> GaussCode:
    """The member that stands for the whole class: the first in order of visits and chirality.

    >>> class_of(GaussCode.parse("1+a,1-a")) == class_of(GaussCode.parse("1-c,1+c"))
    True
    """
    return min((member for member, _, _ in variants(code)), key=lambda member: (member.visits, member.chirality))


def members(code: GaussCode) -> list[GaussCode]:
    """Every code of the class, with chirality, once each, in order."""
    return sorted({member for member, _, _ in variants(code)}, key=lambda member: (member.visits, member.chirality or ""))
