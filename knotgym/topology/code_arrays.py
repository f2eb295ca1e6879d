"""Gauss codes of many ropes as arrays of integers, without an object per rope.

    visits     int16 (n, 2 width)   +label over, -label under, in the order of the walk, then 0
    signs      int8 (n, width)      +1 or -1 for crossing 1, 2, ..., then 0
    crossings  int64 (n,)           how many there are

The width is the same for all rows of a batch, at least WIDTH, and grows with the rope that shows
the most crossings, so no code is ever cut.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import InvalidInput
from knotgym.topology.crossing_kernel import scan_rows
from knotgym.topology.gauss import NEGATIVE, POSITIVE, GaussCode, trusted_code

FINITE = "every x, y, z must be a finite number"
WIDTH = 32  # crossings that arrays have room for at first


class CodeArrays(NamedTuple):
    """The Gauss codes of n ropes; see this module."""

    visits: NDArray[np.int16]
    signs: NDArray[np.int8]
    crossings: NDArray[np.int64]

    def objects(self) -> list[GaussCode]:
        """Return the codes with chirality; equal codes share one object."""
        visits, signs = np.ascontiguousarray(self.visits), np.ascontiguousarray(self.signs)
        pairs = zip(visits, signs, self.crossings.tolist(), strict=True)
        return [_code(one[: 2 * nx].tobytes(), sign[:nx].tobytes()) for one, sign, nx in pairs]


def read_codes(points: NDArray[np.float64], width: int = WIDTH) -> CodeArrays:
    """Read the Gauss codes of many ropes.

    Args:
        points: float64 (n, beads, 3), metres.
        width: crossings that the arrays have room for, at least; WIDTH or a multiple.

    Raises:
        InvalidInput: a coordinate isn't finite.
    """
    count, ropes = len(points), np.ascontiguousarray(points)
    crossings = np.empty(count, dtype=np.int64)
    while True:
        visits = np.empty((count, 2 * width), dtype=np.int16)
        signs = np.empty((count, width), dtype=np.int8)
        most = scan_rows(ropes, visits, signs, crossings)
        if count and crossings.min() < 0:
            raise InvalidInput(
                f"no closed rope: a coordinate of rope {int(crossings.argmin())} is not finite;"
                f" {FINITE}"
            )
        if most <= width:
            return CodeArrays(visits, signs, crossings)
        width = WIDTH * -(-most // WIDTH)


def visits_of(codes: Sequence[GaussCode], width: int = WIDTH) -> NDArray[np.int16]:
    """Return the visits of codes as an array (n, 2 w), w at least `width`."""
    most = max((code.nx for code in codes), default=0)
    visits = np.zeros((len(codes), 2 * max(width, WIDTH * -(-most // WIDTH))), dtype=np.int16)
    for row, code in enumerate(codes):
        visits[row, : len(code.visits)] = code.visits
    return visits


def plain_code(visits: NDArray[np.int16]) -> GaussCode:
    """Return the code of one row of visits, without chirality."""
    return _code(visits[: np.count_nonzero(visits)].tobytes(), None)


@lru_cache(maxsize=2**14)
def _code(visits: bytes, signs: bytes | None) -> GaussCode:
    walk = tuple(np.frombuffer(visits, dtype=np.int16).tolist())
    if signs is None:
        return trusted_code(walk, None if walk else "")
    letters = [POSITIVE if sign > 0 else NEGATIVE for sign in np.frombuffer(signs, np.int8)]
    return trusted_code(walk, "".join(letters))
