"""Gauss codes of many ropes as arrays of integers, without an object per rope.

    visits     int16 (n, 2 width)   +label over, -label under, in the order of the walk, then 0
    signs      int8 (n, width)      +1 or -1 for crossing 1, 2, ..., then 0
    crossings  int64 (n,)           how many there are

The width is the same for all rows of a batch, at least WIDTH, and grows with the rope that shows
the most crossings, so no code is ever cut.

After a change run `pytest tests/topology/test_crossings.py tests/envs`: codes must be those of
`crossings.label`.
"""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidInput, Threads
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
        return [_code(*row) for row in zip(_rows(self.visits), _rows(self.signs), strict=True)]


def read_codes(
    points: NDArray[np.float64],
    width: int = WIDTH,
    threads: Threads | None = None,
    ids: NDArray[np.int64] | None = None,
) -> CodeArrays:
    """Read the Gauss codes of many ropes.

    Args:
        points: float64 (n, beads, 3), metres.
        width: crossings that the arrays have room for, at least; WIDTH or a multiple.
        threads: that read them.
        ids: int64 (m,), which ropes; all by default.

    Raises:
        InvalidInput: a coordinate isn't finite.
    """
    which = np.arange(len(points)) if ids is None else ids
    count = len(which)
    # Nothing is known of the codes before they are read, so there is room for WIDTH crossings. The
    # rare rope with more makes all be read again, with room for it: twice the time once, instead of
    # wide arrays always.
    crossings = np.empty(count, dtype=np.int64)
    while True:
        visits = np.empty((count, 2 * width), dtype=np.int16)
        signs = np.empty((count, width), dtype=np.int8)
        scan = partial(_scan, points, (which, visits, signs, crossings))
        most = max((threads or Threads()).spread(scan, count, Threads.FEW), default=0)
        if count and crossings.min() < 0:
            raise InvalidInput(
                f"no closed rope: a coordinate of rope {int(crossings.argmin())} is not finite;"
                f" {FINITE}"
            )
        if most <= width:
            return CodeArrays(visits, signs, crossings)
        # rounded up to a multiple, so that batches of like ropes have arrays of one width
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
    return plain_codes(visits[None])[0]


def plain_codes(visits: NDArray[np.int16]) -> list[GaussCode]:
    """Return the codes of rows of visits, without chirality; equal codes share one object."""
    return [_code(row, None) for row in _rows(visits)]


def code_texts(
    visits: NDArray[np.int16], signs: NDArray[np.int8] | None = None
) -> NDArray[np.object_]:
    """Write codes as text, with chirality if signs are given: objects (n,), of str."""
    rows: list[Any] = _rows(visits)
    given = [None] * len(rows) if signs is None else _rows(signs)
    texts = np.empty(len(rows), dtype=object)
    texts[:] = list(map(_text, rows, given))
    return texts


def _scan(points: NDArray[np.float64], arrays: Sequence[NDArray[Any]], rows: slice) -> int:
    which, *codes = (array[rows] for array in arrays)
    return int(scan_rows(points[which], *codes))


def _rows(array: NDArray[Any]) -> list[bytes]:
    """Return the bytes of each row of an array (n, width)."""
    # one opaque item a row: its bytes are a key that is hashed as fast as memory is read
    width = array.shape[1] * array.itemsize
    listed: list[bytes] = np.ascontiguousarray(array).view(f"V{width}")[:, 0].tolist()
    return listed


@lru_cache(maxsize=2**14)
def _code(visits: bytes, signs: bytes | None) -> GaussCode:
    numbers = np.frombuffer(visits, dtype=np.int16)
    walk = tuple(numbers[numbers != 0].tolist())
    if signs is None:
        return trusted_code(walk, None if walk else "")
    # signs are padded, too; a code of n visits has n / 2 of them
    own = np.frombuffer(signs, dtype=np.int8)[: len(walk) // 2]
    return trusted_code(walk, "".join([POSITIVE if sign > 0 else NEGATIVE for sign in own]))


@lru_cache(maxsize=2**14)
def _text(visits: bytes, signs: bytes | None) -> str:
    code = _code(visits, signs)
    return str(code) if signs is None else code.chiral
