"""Crossings of a closed rope seen from above, and the Gauss code that they spell.

Two edges of the closed polyline through the beads (including the closing edge) cross where their
projections onto the plane z = 0 meet; edges that share a bead never cross. Which edges cross is
decided exactly, without a tolerance (`crossing_kernel`). A vertex on the spot of the one before, as
at the end of a curve that repeats its first point, counts as one with it (`same_spot`).

If two strands have the same height at a crossing, the one visited first counts as the upper one.
Positions along edges and heights are ordinary float64, so the order of two visits is unreliable
when they are closer than rounding error (three strands near one point). Strands that overlap
exactly for a stretch, as on integer grids but not on ropes, may give a code that isn't planar.

Coordinates are in metres. A place along the rope is a fractional bead index: 2.25 is a quarter of
the way from bead 2 to bead 3.

After a change run `pytest tests/topology/test_crossings.py`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import InvalidInput
from knotgym.topology.code_arrays import FINITE, CodeArrays
from knotgym.topology.crossing_kernel import CROSSING, SAME, Columns, count_hits, scan
from knotgym.topology.gauss import GaussCode, letters_of


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """The n crossings of one rope, in order of first visit; the arrays are read-only.

    Attributes:
        over_place, under_place: float64 (n,), fractional bead index of the upper and the lower
            strand, in [0, beads].
        position: float64 (n, 2), x and y of the crossing, metres.
        over_z, under_z: float64 (n,), height of the upper and the lower strand, metres.
        sign: int8 (n,), +1 if (d_over x d_under) points up, d being the direction of walking.
        code: the Gauss code, with chirality.
    """

    over_place: NDArray[np.float64]
    under_place: NDArray[np.float64]
    position: NDArray[np.float64]
    over_z: NDArray[np.float64]
    under_z: NDArray[np.float64]
    sign: NDArray[np.int8]
    code: GaussCode

    @property
    def nx(self) -> int:
        """The number of crossings."""
        return len(self.sign)

    @property
    def over_points(self) -> NDArray[np.float64]:
        """Where the upper strands pass, float64 (n, 3), metres."""
        return np.column_stack([self.position, self.over_z])


def find_crossings(points: ArrayLike) -> Crossings:
    """Find every crossing of one rope.

    Args:
        points: (beads, 3), at least 3 beads, metres.

    Raises:
        InvalidInput: the shape is wrong, or a coordinate is not finite.
    """
    visits, table = _scan(points)
    c = Columns(*table.T.copy())
    position, sign = table[:, [CROSSING.x, CROSSING.y]], c.sign.astype(np.int8)
    arrays = c.over_place, c.under_place, position, c.over_z, c.under_z, sign
    for array in arrays:
        array.setflags(write=False)
    return Crossings(*arrays, _gauss_code(visits, sign))


def label(points: ArrayLike, most: int | None = None) -> GaussCode:
    """Read the Gauss code of one rope, with chirality.

    Args:
        points: as for `find_crossings`.
        most: crossings; n points may have n^2 / 2, and the search ends when there are more. No
            limit if None.

    Raises:
        InvalidInput: as `find_crossings`; or there are more crossings.
    """
    if most is not None and count_hits(_checked(points, 2), most) > most:
        raise InvalidInput(f"it has more than {most} crossings")
    visits, table = _scan(points)
    return _gauss_code(visits, table[:, CROSSING.sign])


def label_many(points: ArrayLike) -> list[GaussCode]:
    """Read the Gauss codes of many ropes in one compiled call, which releases the GIL.

    Args:
        points: (ropes, beads, 3), at least 3 beads, metres.

    Raises:
        InvalidInput: the shape is wrong, or a coordinate is not finite.
    """
    # one object for equal codes, of which a batch shows few
    return CodeArrays.read(_checked(points, 3)).objects()


def same_spot(points: ArrayLike) -> NDArray[np.bool_]:
    """Tell which vertices lie on the spot of the next, so that the edge between has no length.

    They do if no coordinate differs by more than 2**-48 of the curve's largest extent.

    Args:
        points: (..., n, 3), finite, n > 0; the vertex after the last is the first.

    Returns:
        bool (..., n).

    >>> same_spot([[0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1e-16]]).tolist()
    [False, True, False, False, True]
    """
    p = 0.5 * np.asarray(points, dtype=np.float64)  # halved, so that no difference overflows
    with np.errstate(invalid="ignore"):  # what isn't finite is on no spot
        extent = SAME * np.ptp(p, axis=-2, keepdims=True).max(axis=-1)
        same: NDArray[np.bool_] = np.abs(np.roll(p, -1, axis=-2) - p).max(axis=-1) <= extent
    return same


def _checked(points: ArrayLike, ndim: int) -> NDArray[np.float64]:
    rope = np.ascontiguousarray(points, dtype=np.float64)
    if not rope.flags.writeable:  # numba would compile everything again for a read-only array
        rope = rope.copy()
    if rope.ndim != ndim or rope.shape[-1] != 3 or rope.shape[-2] < 3:
        expected = "(beads, 3)" if ndim == 2 else "(ropes, beads, 3)"
        raise InvalidInput(
            f"no closed rope: the array has shape {rope.shape}; expected {expected} with at least 3"
            " beads"
        )
    return rope


def _scan(points: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    finite, visits, table = scan(_checked(points, 2))
    if not finite:
        raise InvalidInput(f"no closed rope: a coordinate is not finite; {FINITE}")
    return visits, table


def _gauss_code(visits: NDArray[Any], signs: NDArray[Any]) -> GaussCode:
    # what the kernel found needs no check that each label comes once over and once under
    return GaussCode.trusted(tuple(visits.tolist()), letters_of(signs.tolist()))
