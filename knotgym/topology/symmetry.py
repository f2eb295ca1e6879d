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

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.topology.gauss import GaussCode


class _Motion(NamedTuple):
    """The fields of a `Symmetry`."""

    turn: Any = 0.0
    reflect: Any = False
    switch: Any = False
    reverse: Any = False
    base_shift: Any = 0


class Symmetry(_Motion):
    """Reflect, switch and turn a rope, then reverse its walk, then shift its base point.

    The fields are numbers, for one symmetry, or arrays (n,), for a symmetry of each of n ropes.

    Attributes:
        turn: float64, rotation about z after the reflection, radians.
        reflect: bool, x -> -x, first.
        switch: bool, z -> -z.
        reverse: bool, the new vertex j is the old vertex -j.
        base_shift: int, vertices; after the reversal, the new vertex j is the old vertex
            j + base_shift.

    The constants are what leads from a code to another of the same rope or diagram; their sums are
    sets of them. Letters don't count under PLAIN; MOTIONS are those of a rope whose base bead
    stays; DIAGRAM, all that keep a diagram, lacks REFLECT, which changes nothing but letters.
    """

    REFLECT, SWITCH, REVERSE, REBASE, PLAIN = 1, 2, 4, 8, 16
    MOTIONS = REFLECT | SWITCH | REVERSE
    DIAGRAM = SWITCH | REVERSE | REBASE | PLAIN

    def vectors(self, vectors: ArrayLike) -> NDArray[Any]:
        """Transform positions or forces, (..., 3) or (n, ..., 3), without renumbering them."""
        v = np.asarray(vectors)
        turn, reflect, switch = (_wide(field, v.ndim - 1) for field in self[:3])
        x, y, z = v[..., 0], v[..., 1], v[..., 2]
        # the reflection first, then the turn: the two don't commute
        x, z = np.where(reflect, -x, x), np.where(switch, -z, z)
        c, s = np.cos(turn), np.sin(turn)
        return np.stack([c * x - s * y, s * x + c * y, z], axis=-1).astype(v.dtype)

    def vertices(self, points: ArrayLike) -> NDArray[Any]:
        """Transform ropes, (..., beads, 3) or (n, ..., beads, 3), and renumber their vertices."""
        moved = self.vectors(points)
        # new vertex j is old vertex j + base_shift, and of a reversed walk -(j + base_shift)
        index = np.arange(moved.shape[-2]) + _wide(self.base_shift, moved.ndim - 1)
        old = np.where(_wide(self.reverse, moved.ndim - 1), -index, index) % moved.shape[-2]
        return np.take_along_axis(moved, old.reshape(*old.shape, 1), axis=-2)

    def beads(self, beads: ArrayLike, count: int) -> NDArray[np.int64]:
        """Renumber beads, of `count` a rope; bead b lies between the vertices b and b + 1."""
        old = np.asarray(beads, dtype=np.int64)
        # Bead b lies between vertices b and b + 1, which a reversed walk calls -b and -b - 1: so it
        # begins at -b - 1.
        new = np.where(_wide(self.reverse, old.ndim), -old - 1, old)
        return np.asarray(new - _wide(self.base_shift, old.ndim)) % count


def _wide(field: Any, dimensions: int) -> NDArray[Any]:
    """Append axes to a field of a `Symmetry`, so that it fits arrays of so many dimensions."""
    values = np.asarray(field)
    return values.reshape(values.shape + (1,) * (dimensions - values.ndim))


def images(code: GaussCode, symmetries: int = Symmetry.MOTIONS) -> tuple[GaussCode, ...]:
    """Return the codes of a rope reflected, switched, walked either way, from other base points.

    Some are equal. Reflecting, switching and reversing are commuting involutions, the bits 0, 1 and
    2 of the index, so image i of the image k of `MOTIONS` is image i ^ k.

    Args:
        code: the first of them.
        symmetries: constants of `Symmetry`, added.
    """
    code = code.plain if symmetries & Symmetry.PLAIN else code
    bases = range(max(1, 2 * code.nx)) if symmetries & Symmetry.REBASE else range(1)
    members = [code.rebased(base) if base else code for base in bases]
    # bit 2 of the index is the walk, bit 1 the heights, bit 0 the reflection
    if symmetries & Symmetry.REVERSE:
        members += [member.reversed() for member in members]
    if symmetries & Symmetry.SWITCH:
        members = [image for member in members for image in (member, member.switched())]
    if symmetries & Symmetry.REFLECT:
        members = [image for member in members for image in (member, member.reflected())]
    return tuple(members)


@lru_cache(maxsize=400_000)
def canonical(code: GaussCode, symmetries: int = Symmetry.MOTIONS) -> GaussCode:
    """Return the representative of a code's images: the first by visits, then chirality.

    Args:
        code: one of the images.
        symmetries: as in `images`.

    >>> canonical(GaussCode.parse("1+a,1-a")) == canonical(GaussCode.parse("1-c,1+c"))
    True
    >>> str(canonical(GaussCode.parse("1-,2+,2-,1+"), Symmetry.DIAGRAM))
    '1-,1+,2-,2+'
    """
    return min(images(code, symmetries), key=lambda image: (image.visits, image.chirality or ""))
