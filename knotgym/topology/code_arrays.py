"""Gauss codes of many ropes as arrays of integers, without an object per rope.

    visits     int16 (n, 2 width)   +label over, -label under, in the order of the walk, then 0
    signs      int8 (n, width)      +1 or -1 for crossing 1, 2, ..., then 0
    crossings  int64 (n,)           how many there are

The width is the same for all rows of a batch, at least WIDTH, and grows with the rope that shows
the most crossings, so no code is ever cut.

After a change run `pytest tests/topology/test_crossings.py tests/envs`: codes must be those of
`crossings.label`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidInput, Threads
from knotgym.topology.crossing_kernel import scan_rows
from knotgym.topology.gauss import GaussCode

FINITE = "every x, y, z must be a finite number"
WIDTH = 32  # crossings that arrays have room for at first


class CodeArrays(NamedTuple):
    """The Gauss codes of n ropes, see this module; without chirality if `signs` are None."""

    visits: NDArray[np.int16]
    signs: Any = None
    crossings: Any = None

    @classmethod
    def read(
        cls,
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
        # Nothing is known of the codes before they are read, so there is room for WIDTH crossings.
        # The rare rope with more makes all be read again, with room for it: twice the time once,
        # instead of wide arrays always.
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
                return cls(visits, signs, crossings)
            width = _room(most)

    @classmethod
    def of(cls, codes: Sequence[GaussCode], width: int = WIDTH) -> CodeArrays:
        """Return codes as arrays, without chirality, with room for `width` crossings at least."""
        most = max((code.nx for code in codes), default=0)
        visits = np.zeros((len(codes), 2 * max(width, _room(most))), dtype=np.int16)
        for row, code in enumerate(codes):
            visits[row, : len(code.visits)] = code.visits
        return cls(visits)

    def objects(self) -> list[GaussCode]:
        """Return the codes; equal codes share one object."""
        return [_code(*row) for row in self._rows()]

    def texts(self) -> NDArray[np.object_]:
        """Write the codes as text: objects (n,), of str."""
        texts = np.empty(len(self.visits), dtype=object)
        texts[:] = [_text(*row) for row in self._rows()]
        return texts

    def _rows(self) -> Any:
        signs = [None] * len(self.visits) if self.signs is None else _bytes(self.signs)
        return zip(_bytes(self.visits), signs, strict=True)


def _room(crossings: int) -> int:
    # rounded up to a multiple, so that batches of like ropes have arrays of one width
    return WIDTH * -(-crossings // WIDTH)


def _scan(points: NDArray[np.float64], arrays: Sequence[NDArray[Any]], rows: slice) -> int:
    which, *codes = (array[rows] for array in arrays)
    return int(scan_rows(points[which], *codes))


def _bytes(array: NDArray[Any]) -> list[bytes]:
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
        return GaussCode.trusted(walk, None if walk else "")
    # signs are padded, too; a code of n visits has n / 2 of them
    own = np.frombuffer(signs, dtype=np.int8)[: len(walk) // 2]
    return GaussCode.trusted(walk, GaussCode.letters_of(own.tolist()))


@lru_cache(maxsize=2**14)
def _text(visits: bytes, signs: bytes | None) -> str:
    code = _code(visits, signs)
    return str(code) if signs is None else code.chiral
