"""Symmetries of the rope and of its Gauss codes, used to transfer demonstrations between codes.

Rotating the rope about z, reflecting it (x -> -x) and switching over and under (z -> -z) map rope
motions to rope motions exactly. Two more symmetries are approximate: walking the rope in the other
direction, and starting the walk at another sub-chain. Starting at any other bead is no symmetry,
because the rope bends more easily where its sub-chains meet (their closures have no damping): with
the base shifted by one bead, one step ends 9 mm away; shifted by a sub-chain, 0.5 mm.

After a change run `pytest tests/topology/test_symmetry.py`: what a symmetry says of a code must be
what the moved rope shows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from knotgym.topology.gauss import GaussCode

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Symmetry:
    """Reflect, switch and rotate the rope, then reverse the walk, then shift its base point.

    Attributes:
        reflect: whether to map x -> -x, first.
        switch: whether to map z -> -z.
        turn: rotation about z after the reflection, radians.
        reverse: whether the new vertex j is the old vertex -j.
        base_shift: number of vertices; after the reversal, the new vertex j is the old vertex
            j + base_shift.
    """

    reflect: bool = False
    switch: bool = False
    turn: float = 0.0
    reverse: bool = False
    base_shift: int = 0

    def vectors(self, v: Array) -> Array:
        """Transform positions or forces, shape (..., 3), without renumbering them."""
        mirrored = v * (-1.0 if self.reflect else 1.0, 1.0, -1.0 if self.switch else 1.0)
        x, y, z = mirrored[..., 0], mirrored[..., 1], mirrored[..., 2]
        c, s = np.cos(self.turn), np.sin(self.turn)
        return np.asarray(np.stack([c * x - s * y, s * x + c * y, z], axis=-1))

    def configuration(self, points: Array) -> Array:
        """Transform a configuration, shape (beads, 3), and renumber its vertices."""
        index = np.arange(len(points)) + self.base_shift
        return self.vectors(points)[(-index if self.reverse else index) % len(points)]

    def beads(self, beads: NDArray[np.integer], count: int) -> NDArray[np.int64]:
        """Renumber beads, of `count` in all; bead b lies between the vertices b and b + 1."""
        old = np.asarray(beads, dtype=np.int64)
        return ((-old - 1 if self.reverse else old) - self.base_shift) % count


def images(code: GaussCode) -> tuple[GaussCode, ...]:
    """Return the eight codes of a rope reflected, switched and walked either way; some are equal.

    Reflecting, switching and reversing are commuting involutions, the bits 0, 1 and 2 of the index,
    so image i of image k is image i ^ k.
    """
    members = []
    for walked in (code, code.reversed()):
        switched = walked.mirrored()
        members += [walked, walked.reflected(), switched, switched.reflected()]
    return tuple(members)


@lru_cache(maxsize=200_000)
def canonical_form(code: GaussCode) -> GaussCode:
    """Return the representative of the code's images: the first by visits, then chirality.

    >>> canonical_form(GaussCode.parse("1+a,1-a")) == canonical_form(GaussCode.parse("1-c,1+c"))
    True
    """
    return min(images(code), key=_order)


@lru_cache(maxsize=200_000)
def diagram_form(code: GaussCode) -> GaussCode:
    """Return the representative of all codes of the same diagram up to symmetry.

    It is the first, by visits, of the codes without chirality over all base points, both
    directions, and with crossings switched or not. Reflection changes only the chirality.

    >>> diagram_form(GaussCode.parse("1-,2+,2-,1+")) == diagram_form(GaussCode.parse("1+,1-,2+,2-"))
    True
    """
    based = [code.plain.rebased(visit) for visit in range(max(1, 2 * code.nx))]
    walked = [*based, *(one.reversed() for one in based)]
    return min((*walked, *(one.mirrored() for one in walked)), key=lambda one: one.visits)


def _order(code: GaussCode) -> tuple[tuple[int, ...], str]:
    return code.visits, code.chirality or ""
