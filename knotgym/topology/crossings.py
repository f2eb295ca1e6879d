"""Crossings of a closed rope seen from above, and the Gauss code they spell.

Two edges of the closed polyline through the beads (the closing edge included) cross where their
projections on the z-plane meet; edges that share a bead never do. Which edges cross is decided
exactly, without any tolerance (knotgym.topology.orientation), and two strands of equal height are
ordered by a rule: the one that is visited first is over. Where along an edge and at which height is
ordinary float64, so the order of visits means nothing when they lie closer than rounding (three
strands near one point): visit_spacing() says how close they are. It does not show strands that run
exactly along each other for a stretch, which whole-number curves do and ropes don't: their code
need not be planar.

Positions are in metres, places along the rope in beads: 2.25 is a quarter of the way from bead 2 to
bead 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.errors import KnotgymError
from knotgym.topology.crossing_kernel import (
    OVER_PLACE,
    OVER_Z,
    SIGN,
    UNDER_PLACE,
    UNDER_Z,
    X,
    Y,
    scan,
    scan_many,
)
from knotgym.topology.gauss import NEGATIVE, POSITIVE, GaussCode, trusted_code


class InvalidPoints(KnotgymError, ValueError):
    """These numbers are no closed polyline."""

    def __init__(self, problem: str, right: str) -> None:
        super().__init__(f"no closed rope: {problem}; {right}")


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """The n crossings of one rope, in order of first visit; the arrays are read-only.

    Attributes:
        over_place, under_place: float64 (n,), place of either strand, in [0, beads], beads.
        position: float64 (n, 2), where they meet, metres.
        over_z, under_z: float64 (n,), height of either strand there, metres.
        sign: int8 (n,), +1 when (over x under) points up.
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


class VisitSpacing(NamedTuple):
    """How far visits keep from each other and from the base bead, in beads along the rope.

    Attributes:
        visits: between two visits that follow each other, the step over the base bead included; inf
            without crossings.
        base: from the base bead to the nearest visit on either side; inf without crossings.
    """

    visits: float
    base: float


def find_crossings(points: ArrayLike) -> Crossings:
    """Find every crossing of the rope.

    Args:
        points: (beads, 3), at least 3 beads, metres.

    Raises:
        InvalidPoints: another shape, or a coordinate that is not finite.
    """
    visits, table = _scanned(points)
    places: list[NDArray[Any]] = [
        table[:, column].copy() for column in (OVER_PLACE, UNDER_PLACE, OVER_Z, UNDER_Z)
    ]
    position, sign = table[:, [X, Y]], table[:, SIGN].astype(np.int8)
    arrays: list[NDArray[Any]] = [*places, position, sign]
    for array in arrays:
        array.setflags(write=False)
    return Crossings(
        places[0], places[1], position, places[2], places[3], sign, _code(visits, sign)
    )


def label(points: ArrayLike) -> GaussCode:
    """Read the Gauss code of one rope, with chirality; arguments and errors as find_crossings()."""
    visits, table = _scanned(points)
    return _code(visits, table[:, SIGN])


def label_many(points: ArrayLike) -> list[GaussCode]:
    """Read the Gauss codes of many ropes.

    The search is one compiled call, which lets other threads run.

    Args:
        points: (ropes, beads, 3), at least 3 beads, metres.

    Raises:
        InvalidPoints: another shape, or a coordinate that is not finite.
    """
    visits, signs, counts = scan_many(_closed(points, 3))
    known: dict[tuple[bytes, bytes], GaussCode] = {}
    codes: list[GaussCode] = []
    start = 0
    for row, nx in enumerate(counts.tolist()):
        if nx < 0:
            raise InvalidPoints(
                f"a coordinate of rope {row} is not finite",
                "every x, y, z must be an ordinary number",
            )
        own, turns = visits[2 * start : 2 * (start + nx)], signs[start : start + nx]
        start += nx
        key = (own.tobytes(), turns.tobytes())
        if key not in known:
            known[key] = _code(own, turns)
        codes.append(known[key])
    return codes


def count_crossings(points: ArrayLike) -> int:
    """Count the crossings of one rope; arguments and errors as find_crossings()."""
    return len(_scanned(points)[1])


def visit_spacing(crossings: Crossings, beads: int) -> VisitSpacing:
    """Measure how close the visits come.

    Near-triple points, kinks and a crossing on the base bead show as small numbers.

    Args:
        crossings: of a rope with this many beads.
        beads: the length of the rope in beads.
    """
    if crossings.nx == 0:
        return VisitSpacing(np.inf, np.inf)
    places = np.sort(np.concatenate([crossings.over_place, crossings.under_place]))
    over_base = float(places[0] + beads - places[-1])
    return VisitSpacing(
        min(over_base, float(np.diff(places).min())),
        min(float(places[0]), float(beads - places[-1])),
    )


def _closed(points: ArrayLike, ndim: int) -> NDArray[np.float64]:
    rope = np.ascontiguousarray(points, dtype=np.float64)
    if not rope.flags.writeable:  # to numba another type, for which all would be compiled anew
        rope = rope.copy()
    if rope.ndim != ndim or rope.shape[-1] != 3 or rope.shape[-2] < 3:
        right = "(beads, 3)" if ndim == 2 else "(ropes, beads, 3)"
        raise InvalidPoints(
            f"the array has shape {rope.shape}", f"right would be {right} with at least 3 beads"
        )
    return rope


def _scanned(points: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    finite, visits, table = scan(_closed(points, 2))
    if not finite:
        raise InvalidPoints(
            "a coordinate is not finite", "every x, y, z must be an ordinary number"
        )
    return visits, table


def _code(visits: NDArray[np.int64], signs: NDArray[Any]) -> GaussCode:
    return trusted_code(
        tuple(visits.tolist()),
        "".join([POSITIVE if sign > 0 else NEGATIVE for sign in signs.tolist()]),
    )
