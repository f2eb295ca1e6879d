"""The symmetries of a rope's diagrams: what one demonstration of a diagram teaches about others.

Turning the rope about z, looking at it in a mirror (x -> -x) and switching over and under (z -> -z)
take rope motions to rope motions exactly. Two more do so nearly: walking the rope the other way,
and starting the walk at another sub-chain. A rope bends more easily where its sub-chains meet
(their closures have no damping), so that a walk that starts at any other bead is no symmetry: with
the base shifted by one bead a step ends 9 mm elsewhere, shifted by a sub-chain, 0.5 mm.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from knotgym.topology.crossings import Crossings
from knotgym.topology.gauss import GaussCode

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Symmetry:
    """Reflect, switch and turn the rope, then walk it the other way, then from another vertex.

    Attributes:
        reflect: x -> -x first.
        switch: z -> -z.
        turn: about z, radians, after the reflection.
        reverse: the new vertex j is the old vertex -j.
        base_shift: then, the new vertex j is the old vertex j + base_shift.
    """

    reflect: bool = False
    switch: bool = False
    turn: float = 0.0
    reverse: bool = False
    base_shift: int = 0

    def vectors(self, v: Array) -> Array:
        """Positions or forces (..., 3), as the symmetry moves them."""
        mirrored = v * (-1.0 if self.reflect else 1.0, 1.0, -1.0 if self.switch else 1.0)
        x, y, z = mirrored[..., 0], mirrored[..., 1], mirrored[..., 2]
        c, s = np.cos(self.turn), np.sin(self.turn)
        return np.asarray(np.stack([c * x - s * y, s * x + c * y, z], axis=-1))

    def configuration(self, points: Array) -> Array:
        """A configuration (beads, 3), moved and renumbered."""
        index = np.arange(len(points)) + self.base_shift
        return self.vectors(points)[(-index if self.reverse else index) % len(points)]

    def beads(self, beads: NDArray[np.integer], count: int) -> NDArray[np.int64]:
        """New numbers of beads; bead b lies between the vertices b and b + 1."""
        old = np.asarray(beads, dtype=np.int64)
        return ((-old - 1 if self.reverse else old) - self.base_shift) % count

    def back_to_loop(self, count: int) -> Symmetry:
        """The exact symmetry that lays a plain loop, moved by this one, down as it was.

        The numbers of its `count` beads are then the old ones too.

        A loop lies as it did after a turn; one that was mirrored, or walked the other way, after a
        reflection and a turn.
        """
        shifted, half = 2 * np.pi * self.base_shift / count, np.pi if self.reverse else 0.0
        if self.reflect != self.reverse:
            return Symmetry(reflect=True, turn=self.turn - shifted - half)
        return Symmetry(turn=-(half + shifted + self.turn))

    def undone(self) -> Symmetry:
        """The symmetry that takes back this one, which renumbers nothing."""
        return Symmetry(
            reflect=self.reflect, switch=self.switch, turn=self.turn if self.reflect else -self.turn
        )


def mirrorings(code: GaussCode) -> Iterator[tuple[GaussCode, Symmetry]]:
    """The codes that a rope showing `code` shows after reflection and switch; four, some twice.

    Each comes with its symmetry; `code` has its chirality.
    """
    for switch in (False, True):
        for reflect in (False, True):
            shown = code.mirrored() if switch else code
            yield shown.reflected() if reflect else shown, Symmetry(reflect=reflect, switch=switch)


def variants(code: GaussCode) -> Iterator[tuple[GaussCode, Symmetry]]:
    """As `mirrorings`, walked both ways; eight, some twice."""
    yield from mirrorings(code)
    yield from (
        (shown, replace(symmetry, reverse=True)) for shown, symmetry in mirrorings(code.reversed())
    )


def images(code: GaussCode) -> tuple[GaussCode, ...]:
    """The codes of `variants`, in the same order.

    Walking the other way, switching and reflecting each undo themselves and may go in any order: so
    image i of image k is image i ^ k.
    """
    members = []
    for walked in (code, code.reversed()):
        switched = walked.mirrored()
        members += [walked, walked.reflected(), switched, switched.reflected()]
    return tuple(members)


@lru_cache(maxsize=200_000)
def canonical_form(code: GaussCode) -> GaussCode:
    """The code that stands for all its variants: the first in order of visits and chirality.

    >>> canonical_form(GaussCode.parse("1+a,1-a")) == canonical_form(GaussCode.parse("1-c,1+c"))
    True
    """
    return min(images(code), key=_order)


@lru_cache(maxsize=200_000)
def diagram_form(code: GaussCode) -> GaussCode:
    """The code that stands for a code's diagram, whatever symmetry of the rope shows it.

    Of the codes without chirality that the diagram shows from any base bead, walked either way,
    switched or not, it is the first. Reflection changes chirality alone.

    >>> diagram_form(GaussCode.parse("1-,2+,2-,1+")) == diagram_form(GaussCode.parse("1+,1-,2-,2+"))
    True
    """
    based = [code.plain.rebased(visit) for visit in range(max(1, 2 * code.nx))]
    walked = [*based, *(one.reversed() for one in based)]
    return min((*walked, *(one.mirrored() for one in walked)), key=lambda one: one.visits)


@lru_cache(maxsize=200_000)
def mirror_images(code: GaussCode) -> tuple[GaussCode, ...]:
    """The codes of `mirrorings`, once each, in order; the first stands for all of them."""
    return tuple(sorted({image for image, _ in mirrorings(code)}, key=_order))


def shifted_base(crossings: Crossings, base_shift: int) -> GaussCode:
    """The code of the same rope with its walk starting at vertex `base_shift`."""
    places = np.concatenate([crossings.over_place, crossings.under_place])
    return crossings.code.rebased(int((places < base_shift).sum()))


def _order(code: GaussCode) -> tuple[tuple[int, ...], str]:
    return code.visits, code.chirality or ""
