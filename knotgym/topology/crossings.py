"""Crossings of ropes seen from above, and the Gauss code that they spell.

Two edges of the closed polyline through the beads (including the closing edge) cross where their
projections onto the plane z = 0 meet; edges that share a bead never cross. Which edges cross, in
which order along the rope and which strand is above is decided exactly, without a tolerance
(`crossing_kernel`); places and heights are given in float64. A vertex on the spot of the one
before, as at the end of a curve that repeats its first point, counts as one with it (`same_spot`).

If two strands have the same height at a crossing, the one visited first counts as the upper one.
Strands that overlap exactly for a stretch, as on integer grids but not on ropes, and crossings that
lie exactly on one another may give a code that isn't planar.

An open rope lacks the closing edge, and all else is the same; several ropes cross each other, too.

Coordinates are in metres. A place along the rope is a fractional bead index: 2.25 is a quarter of
the way from bead 2 to bead 3.

After a change run `pytest tests/topology/test_crossings.py`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Literal, NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array, Ids, InvalidInput, Threads, inner, kernel
from knotgym.topology.crossing_kernel import CROSSING, SAME, count_hits, scan_curves, scan_rows
from knotgym.topology.gauss import GaussCode, RopesCode
from knotgym.topology.symmetry import Symmetry

_FINITE = "every x, y, z must be a finite number"
WIDTH = 32  # crossings that arrays have room for at first


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """The n crossings of ropes, in order of first visit; the arrays are read-only.

    Places are in beads from the first of the first rope on; rope k begins where those before end.

    Attributes:
        visits: int64 (2 n,), +label over, -label under, in the order of the walk.
        table: float64 (n, 7), one row per crossing; see `crossing_kernel.CROSSING`.
    """

    visits: Ids
    table: Array

    def __post_init__(self) -> None:
        self.visits.setflags(write=False)
        self.table.setflags(write=False)

    @property
    def nx(self) -> int:
        """The number of crossings."""
        return len(self.table)

    @property
    def over_place(self) -> Array:
        """Fractional bead index of the upper strands, float64 (n,), in [0, beads]."""
        return self.table[:, CROSSING.over_place]

    @property
    def under_place(self) -> Array:
        """Fractional bead index of the lower strands, float64 (n,), in [0, beads]."""
        return self.table[:, CROSSING.under_place]

    @property
    def over_z(self) -> Array:
        """Heights of the upper strands, float64 (n,), metres."""
        return self.table[:, CROSSING.over_z]

    @property
    def under_z(self) -> Array:
        """Heights of the lower strands, float64 (n,), metres."""
        return self.table[:, CROSSING.under_z]

    @property
    def position(self) -> Array:
        """Where they are, x and y, float64 (n, 2), metres."""
        return self.table[:, CROSSING.x : CROSSING.y + 1]

    @property
    def sign(self) -> NDArray[np.int8]:
        """+1 if (d_over x d_under) points up, d being the direction of walking, else -1: (n,)."""
        return self.table[:, CROSSING.sign].astype(np.int8)

    @property
    def over_points(self) -> Array:
        """Where the upper strands pass, float64 (n, 3), metres."""
        return np.column_stack([self.position, self.over_z])


@dataclass(frozen=True, slots=True, eq=False)
class Crossings(_Table):
    """The crossings of one closed rope.

    Attributes:
        code: the Gauss code, with chirality.
    """

    code: GaussCode

    def texts_after(self, symmetries: Symmetry, beads: int) -> list[str]:
        """Write the codes of the ropes, of so many beads, that symmetries make of this one.

        Args:
            symmetries: their fields are arrays (n,).
        """
        places = np.sort(self.table[:, : CROSSING.under_place + 1], axis=None)
        start = symmetries.base_shift % beads
        # A reversed walk goes from the old vertex -start backwards; what lies beyond comes last.
        back = (-symmetries.base_shift) % beads
        beyond = len(places) - np.searchsorted(places, np.where(back == 0, beads, back), "right")
        passed = np.where(symmetries.reverse, beyond, np.searchsorted(places, start))
        each = symmetries.switch, symmetries.reverse, passed % max(len(places), 1)
        return _texts_after(self.code.plain)[tuple(map(np.int64, each))].tolist()


@dataclass(frozen=True, slots=True, eq=False)
class RopesCrossings(_Table):
    """The crossings of several ropes, or of an open one.

    Attributes:
        code: their code, with chirality.
    """

    code: RopesCode


@lru_cache(maxsize=2**12)
def _texts_after(code: GaussCode) -> NDArray[np.object_]:
    """Write a code after each symmetry: objects, by switch, reverse, and visits that are passed."""
    # a reflection changes letters alone
    sides = [[oriented, oriented.reversed()] for oriented in (code, code.switched())]
    starts = range(max(len(code.visits), 1))
    texts = [
        [[str(turned.rebased(start)) for start in starts] for turned in side] for side in sides
    ]
    return np.array(texts, dtype=object)


def find_crossings(points: ArrayLike) -> Crossings:
    """Find every crossing of one rope.

    Args:
        points: (beads, 3), at least 3 beads, metres.

    Raises:
        InvalidInput: the shape is wrong, or a coordinate is not finite.
    """
    rope = _checked(points, 2)
    visits, table, _ = _scan(rope, (np.array([len(rope)]), np.array([True])))
    return Crossings(visits, table, _gauss_code(visits, table[:, CROSSING.sign]))


def find_ropes_crossings(
    ropes: Sequence[ArrayLike], closed: bool | Sequence[bool] = True
) -> RopesCrossings:
    """Find every crossing of ropes with themselves and with each other.

    Args:
        ropes: each (beads, 3), at least 3 beads if it is closed and 2 if not, metres.
        closed: whether the last bead of each rope, or of all, is joined to its first.

    Raises:
        InvalidInput: a shape is wrong, a coordinate is not finite, or not every rope is said to be
            open or closed.
    """
    each = (closed,) * len(ropes) if isinstance(closed, bool) else tuple(map(bool, closed))
    if len(each) != len(ropes) or not ropes:
        raise InvalidInput(
            f"{len(ropes)} ropes, and whether {len(each)} are closed; expected one or more, and all"
        )
    checked = [_checked(rope, 2, shut) for rope, shut in zip(ropes, each, strict=True)]
    ends = np.cumsum([len(rope) for rope in checked])
    visits, table, owners = _scan(np.concatenate(checked), (ends, np.array(each)))
    stops = np.searchsorted(owners, ends).tolist()
    walk = [tuple(visits[i:j].tolist()) for i, j in zip([0, *stops], stops, strict=False)]
    code = RopesCode(tuple(walk), each, GaussCode.letters_of(table[:, CROSSING.sign].tolist()))
    return RopesCrossings(visits, table, code)


@overload
def label(
    points: ArrayLike, most: int | None = None, *, closed: Literal[True] = True
) -> GaussCode: ...
@overload
def label(points: ArrayLike, most: int | None = None, *, closed: Literal[False]) -> RopesCode: ...
def label(
    points: ArrayLike, most: int | None = None, *, closed: bool = True
) -> GaussCode | RopesCode:
    """Read the Gauss code of one rope, with chirality.

    Args:
        points: as for `find_crossings`; an open rope has at least 2 beads.
        most: crossings; n points may have n^2 / 2, and the search ends when there are more. No
            limit if None.
        closed: whether the last bead is joined to the first; the code of an open rope is read from
            its first bead to its last.

    Raises:
        InvalidInput: as `find_crossings`; or there are more crossings.
    """
    rope = _checked(points, 2, closed)
    curve = np.array([len(rope)]), np.array([closed])
    if most is not None and count_hits(rope, *curve, most) > most:
        raise InvalidInput(f"it has more than {most} crossings")
    visits, table, _ = _scan(rope, curve)
    code = _gauss_code(visits, table[:, CROSSING.sign])
    return code if closed else RopesCode((code.visits,), (False,), code.chirality)


def label_many(points: ArrayLike) -> list[GaussCode]:
    """Read the Gauss codes of many ropes in one compiled call, which releases the GIL.

    Args:
        points: (ropes, beads, 3), at least 3 beads, metres.

    Raises:
        InvalidInput: the shape is wrong, or a coordinate is not finite.
    """
    # one object for equal codes, of which a batch shows few
    return CodeArrays.read(_checked(points, 3)).objects()


class CodeArrays(NamedTuple):
    """The Gauss codes of n ropes as arrays of integers, without an object per rope.

    The width is the same for all rows of a batch, at least WIDTH, and grows with the rope that
    shows the most crossings, so no code is ever cut.

    Attributes:
        visits: int16 (n, 2 width), +label over, -label under, in the order of the walk, then 0.
        signs: int8 (n, width), +1 or -1 for crossing 1, 2, ..., then 0; None without chirality.
        crossings: int64 (n,), how many there are.
    """

    visits: NDArray[np.int16]
    signs: Any = None
    crossings: Any = None

    @classmethod
    def read(
        cls,
        points: Array,
        width: int = WIDTH,
        threads: Threads | None = None,
        ids: Ids | None = None,
    ) -> "CodeArrays":
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
            scan = partial(_scan_many, points, (which, visits, signs, crossings))
            most = max((threads or Threads()).spread(scan, count, Threads.FEW), default=0)
            if count and crossings.min() < 0:
                raise InvalidInput(
                    f"no closed rope: a coordinate of rope {int(crossings.argmin())} is not finite;"
                    f" {_FINITE}"
                )
            if most <= width:
                return cls(visits, signs, crossings)
            width = _room(most)

    @classmethod
    def of(cls, codes: Sequence[GaussCode], width: int = WIDTH) -> "CodeArrays":
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


def _scan_many(points: Array, arrays: Sequence[NDArray[Any]], rows: slice) -> int:
    which, *codes = (array[rows] for array in arrays)
    return int(scan_rows(points[which], *codes))


def _bytes(array: NDArray[Any]) -> list[bytes]:
    """Return the bytes of each row of an array (n, width)."""
    # one opaque item a row: its bytes are a key that is hashed as fast as memory is read
    width = array.shape[1] * array.itemsize
    return np.ascontiguousarray(array).view(f"V{width}")[:, 0].tolist()


@lru_cache(maxsize=2**14)
def _code(visits: bytes, signs: bytes | None) -> GaussCode:
    numbers = np.frombuffer(visits, dtype=np.int16)
    walk = tuple(numbers[numbers != 0].tolist())
    if signs is None:
        return GaussCode.trusted(walk, None if walk else "")
    # signs are padded, too; a code of n visits has n / 2 of them
    senses = np.frombuffer(signs, dtype=np.int8)[: len(walk) // 2]
    return GaussCode.trusted(walk, GaussCode.letters_of(senses.tolist()))


@lru_cache(maxsize=2**14)
def _text(visits: bytes, signs: bytes | None) -> str:
    code = _code(visits, signs)
    return str(code) if signs is None else code.chiral


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


def _checked(points: ArrayLike, ndim: int, closed: bool = True) -> Array:
    rope = np.ascontiguousarray(points, dtype=np.float64)
    if not rope.flags.writeable:  # numba would compile everything again for a read-only array
        rope = rope.copy()
    no_rope, least = ("no closed rope", 3) if closed else ("no open rope", 2)
    if rope.ndim != ndim or rope.shape[-1] != 3 or rope.shape[-2] < least:
        expected = "(beads, 3)" if ndim == 2 else "(ropes, beads, 3)"
        raise InvalidInput(
            f"{no_rope}: the array has shape {rope.shape}; expected {expected} with at least"
            f" {least} beads"
        )
    # products of up to six coordinates are compared, which must neither overflow nor vanish
    reach = np.abs(rope).max(initial=0.0)
    if 1e30 < reach < np.inf or 0 < reach < 1e-30:
        raise InvalidInput(
            f"{no_rope}: coordinates reach {reach:.3g}; scale them to between 1e-30 and 1e30"
        )
    return rope


def _scan(points: Array, curves: tuple[Ids, NDArray[np.bool_]]) -> tuple[Ids, Array, Ids]:
    finite, visits, table, owners = scan_curves(points, *curves)
    if not finite:
        raise InvalidInput(f"no rope: a coordinate is not finite; {_FINITE}")
    return visits, table, owners


def _gauss_code(visits: Ids, signs: NDArray[Any]) -> GaussCode:
    # what the kernel found needs no check that each label comes once over and once under
    return GaussCode.trusted(tuple(visits.tolist()), GaussCode.letters_of(signs.tolist()))


@kernel
def visited(pixels: Array, table: Array) -> tuple[Array, Array, Array]:
    """Find where a rope visits its crossings.

    Args:
        pixels: float64 (beads, 2), contiguous; the vertices in a picture from above.
        table: that of `Crossings`.

    Returns:
        along: float64 (beads + 1,), arc length of the drawing at each vertex, and in total.
        places: float64 (2 n,), along the rope; visits 2 k and 2 k + 1 belong to crossing k.
        at: float64 (2 n,), the same as arc lengths.
    """
    beads = len(pixels)
    along, places, at = np.empty(beads + 1), np.empty(2 * len(table)), np.empty(2 * len(table))
    along[0] = 0.0
    for i in range(beads):
        j = i + 1 if i + 1 < beads else 0
        dx, dy = pixels[j, 0] - pixels[i, 0], pixels[j, 1] - pixels[i, 1]
        along[i + 1] = along[i] + np.sqrt(dx * dx + dy * dy)
    for k in range(len(places)):
        places[k] = table[k // 2, CROSSING.under_place if k % 2 else CROSSING.over_place]
        bead = min(int(places[k]), beads - 1)
        at[k] = along[bead] + (places[k] - bead) * (along[bead + 1] - along[bead])
    return along, places, at


@kernel
def strand_spacing(pixels: Array, along: Array, at: Array, walk: float, most: float) -> float:
    """Return the smallest distance in the picture, pixels, of vertices on different strands.

    Two vertices are on different strands if every path between them along the drawing, straight on
    or turning at crossings, is longer than `walk` pixels. Near a crossing the strands that cross
    are connected by a short path, and don't count.

    Args:
        pixels: float64 (beads, 2), contiguous; the vertices in a picture from above.
        along, at: as `visited` returns them.
        walk: pixels.
        most: pixels; returned if no distance is smaller.
    """
    beads, visits, total = len(pixels), len(at), along[-1]
    between, nearest, turning = _paths(at, total), most, np.empty(visits)
    longest = 0.0
    for i in range(beads):
        longest = max(longest, along[i + 1] - along[i])
    # the margin is far more than the sums are rounded by
    steps = 1 / (longest * (1 + 1e-6))
    # from cheap to expensive: along the rope, in the picture, then through any crossing
    for i in range(beads):
        known, after = False, i + 1
        while after < beads:
            j = after
            after += 1
            gap = _shorter(along[j] - along[i], total)
            if gap <= walk:
                continue
            dx, dy = pixels[i, 0] - pixels[j, 0], pixels[i, 1] - pixels[j, 1]
            apart = np.sqrt(dx * dx + dy * dy)
            if apart >= nearest:
                # no vertex comes nearer by more than the longest edge than the one before it
                after = j + max(1, int((apart - nearest) * steps))
                continue
            # a path that turns at crossings reaches j straight from the last of them, so those
            # with turns are needed from i alone
            for b in range(visits if not known else 0):
                turning[b] = np.inf
                for a in range(visits):
                    straight = _shorter(along[i] - at[a], total)
                    turning[b] = min(turning[b], straight + between[a, b])
            known = True
            for b in range(visits):
                gap = min(gap, turning[b] + _shorter(along[j] - at[b], total))
            if gap > walk:
                nearest = apart
    return nearest


@inner
def _paths(at: Array, total: float) -> Array:
    """Return the shortest paths between visits at arc lengths `at` (Floyd-Warshall)."""
    visits = len(at)
    between = np.empty((visits, visits))
    for a in range(visits):
        for b in range(visits):
            # the two visits of a crossing are the same point of the picture, at distance 0
            between[a, b] = 0.0 if a ^ 1 == b else _shorter(at[a] - at[b], total)
    # after round m, paths that turn at no visit beyond m are right
    for m in range(visits):
        for a in range(visits):
            for b in range(visits):
                between[a, b] = min(between[a, b], between[a, m] + between[m, b])
    return between


@inner
def _shorter(gap: float, total: float) -> float:
    """Return the shorter of the two ways round a closed curve."""
    return min(abs(gap), total - abs(gap))
