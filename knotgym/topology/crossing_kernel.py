"""The compiled search for the crossings of a closed polyline, behind `topology.crossings`.

edges           by blocks of neighbours, whose bounding boxes rule out most pairs
  -> hits       (edge i, edge j > i, side of i to which j leads), decided by four signs of
                knotgym.topology.orientation
  -> strands    two a hit: strand 2 h runs on edge i, strand 2 h + 1 on edge j
  -> walk       the strands in order of place

Arrays are copied number by number, here and in the other kernels: with a slice assignment numba
compiles the wording of its error too, seconds of a first start.
"""

import logging
from pathlib import Path

import numpy as np
from numba import njit

from knotgym.topology.orientation import side

OVER_PLACE, UNDER_PLACE, OVER_Z, UNDER_Z, SIGN, X, Y = range(7)

_log = logging.getLogger("knotgym")
_BLOCK = 8  # edges that share one bounding box


@njit(cache=True, nogil=True)
def scan(points: np.ndarray) -> tuple[bool, np.ndarray, np.ndarray]:
    """Find all crossings of one rope.

    Args:
        points: float64 (beads, 3), contiguous.

    Returns:
        whether all points are finite (nothing is searched otherwise); the visits, int64 (2 n,),
        signed labels; the crossings in order of labels, float64 (n, 7), columns OVER_PLACE to Y.
    """
    if not _all_finite(points):
        return False, np.empty(0, np.int64), np.empty((0, 7))
    hits = _hits(points)
    fractions, heights = _locate(points, hits)
    walk = _walk(points.shape[0], hits, fractions)
    visits = np.empty(len(walk), np.int64)
    table = np.empty((len(hits), 7))
    firsts = np.zeros(len(hits), np.int64)  # the signed label of a hit's first visit
    nx = 0
    for k in range(len(walk)):
        h = walk[k] // 2
        if firsts[h] == 0:  # first visit: equal heights put this strand over
            nx += 1
            over = walk[k] if heights[walk[k]] >= heights[walk[k] ^ 1] else walk[k] ^ 1
            row = table[nx - 1]
            row[OVER_PLACE] = hits[h, over % 2] + fractions[over]
            row[UNDER_PLACE] = hits[h, 1 - over % 2] + fractions[over ^ 1]
            row[OVER_Z], row[UNDER_Z] = heights[over], heights[over ^ 1]
            row[SIGN] = hits[h, 2] if over % 2 == 0 else -hits[h, 2]
            start, end = hits[h, 0], (hits[h, 0] + 1) % points.shape[0]
            row[X] = points[start, 0] + fractions[2 * h] * (points[end, 0] - points[start, 0])
            row[Y] = points[start, 1] + fractions[2 * h] * (points[end, 1] - points[start, 1])
            visits[k] = nx if over == walk[k] else -nx
            firsts[h] = visits[k]
        else:
            visits[k] = -firsts[h]
    return True, visits, table


@njit(cache=True, nogil=True)
def scan_many(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Run scan() over ropes, float64 (ropes, beads, 3).

    Returns:
        all visits and, per crossing, all signs (int64, int64), one rope after the other; the number
        of crossings per rope, int64 (ropes,), -1 where a point is not finite.
    """
    counts = np.empty(points.shape[0], np.int64)
    visits, signs = np.empty(256, np.int64), np.empty(128, np.int64)
    used = 0
    for rope in range(points.shape[0]):
        finite, walked, table = scan(points[rope])
        nx = len(table)
        if used + nx > len(signs):
            room = 2 * (used + nx)
            visits, signs = _grown(visits, 2 * room), _grown(signs, room)
        for k in range(2 * nx):
            visits[2 * used + k] = walked[k]
        for row in range(nx):
            signs[used + row] = 1 if table[row, SIGN] > 0 else -1
        used += nx
        counts[rope] = nx if finite else -1
    return visits[: 2 * used], signs[:used], counts


@njit(cache=True, nogil=True)
def _grown(array: np.ndarray, room: int) -> np.ndarray:
    larger = np.empty(room, np.int64)
    for k in range(len(array)):
        larger[k] = array[k]
    return larger


@njit(cache=True, nogil=True)
def _all_finite(points: np.ndarray) -> bool:
    for bead in range(points.shape[0]):
        if not (
            np.isfinite(points[bead, 0])
            and np.isfinite(points[bead, 1])
            and np.isfinite(points[bead, 2])
        ):
            return False
    return True


@njit(cache=True, nogil=True)
def _boxes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounding boxes (x from, to, y from, to) of the edges, float64 (4, beads), and the blocks."""
    beads = points.shape[0]
    edges = np.empty((4, beads))
    blocks = np.empty((4, (beads + _BLOCK - 1) // _BLOCK))
    blocks[0], blocks[1], blocks[2], blocks[3] = np.inf, -np.inf, np.inf, -np.inf
    for i in range(beads):
        end = i + 1 if i + 1 < beads else 0
        for axis in range(2):
            low = min(points[i, axis], points[end, axis])
            high = max(points[i, axis], points[end, axis])
            edges[2 * axis, i], edges[2 * axis + 1, i] = low, high
            blocks[2 * axis, i // _BLOCK] = min(blocks[2 * axis, i // _BLOCK], low)
            blocks[2 * axis + 1, i // _BLOCK] = max(blocks[2 * axis + 1, i // _BLOCK], high)
    return edges, blocks


@njit(cache=True, nogil=True)
def _apart(boxes: np.ndarray, one: int, other: int) -> bool:
    # No early exit: four comparisons cost less than a mispredicted branch.
    apart_in_x = (boxes[0, one] > boxes[1, other]) | (boxes[0, other] > boxes[1, one])
    apart_in_y = (boxes[2, one] > boxes[3, other]) | (boxes[2, other] > boxes[3, one])
    return bool(apart_in_x | apart_in_y)


@njit(cache=True, nogil=True)
def _hits(points: np.ndarray) -> np.ndarray:
    """Every pair of edges i < j that cross, int64 (n, 3): i, j, and the sign of (d_i x d_j)_z."""
    beads = points.shape[0]
    edges, blocks = _boxes(points)
    hits = np.empty((16, 3), np.int64)
    count = 0
    for a in range(blocks.shape[1]):
        for b in range(a, blocks.shape[1]):
            if _apart(blocks, a, b):
                continue
            for i in range(_BLOCK * a, min(_BLOCK * (a + 1), beads)):
                last = beads - 1 if i == 0 else beads  # edge 0 and the closing edge share bead 0
                for j in range(max(i + 2, _BLOCK * b), min(_BLOCK * (b + 1), last)):
                    if _apart(edges, i, j):
                        continue
                    turn = _crosses(points, i, j)
                    if turn != 0:
                        if count == len(hits):
                            larger = np.empty((2 * count, 3), np.int64)
                            for h in range(count):
                                for k in range(3):
                                    larger[h, k] = hits[h, k]
                            hits = larger
                        hits[count, 0], hits[count, 1], hits[count, 2] = i, j, turn
                        count += 1
    return hits[:count]


@njit(cache=True, nogil=True)
def _crosses(points: np.ndarray, i: int, j: int) -> int:
    """0 when edges i and j do not cross, else the side of edge i to which edge j leads."""
    beads = points.shape[0]
    i_end, j_end = (i + 1) % beads, (j + 1) % beads
    turn: int = side(points, i, i_end, j_end)
    if side(points, i, i_end, j) == turn:
        return 0
    if side(points, j, j_end, i) == side(points, j, j_end, i_end):
        return 0
    return turn


@njit(cache=True, nogil=True)
def _locate(points: np.ndarray, hits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far along its edge every strand is hit, float64 (2 n,) in [0, 1], and how high."""
    beads = points.shape[0]
    fractions, heights = np.empty(2 * len(hits)), np.empty(2 * len(hits))
    for h in range(len(hits)):
        for late in range(2):
            i, j = hits[h, late], hits[h, 1 - late]
            fraction = _fraction(points, i, (i + 1) % beads, j, (j + 1) % beads)
            fractions[2 * h + late] = fraction
            climb = points[(i + 1) % beads, 2] - points[i, 2]
            heights[2 * h + late] = points[i, 2] + fraction * climb
    return fractions, heights


@njit(cache=True, nogil=True)
def _fraction(points: np.ndarray, i: int, i_end: int, j: int, j_end: int) -> float:
    """How far along the edge from bead i to bead i_end it meets that from bead j to bead j_end."""
    dx, dy = points[j_end, 0] - points[j, 0], points[j_end, 1] - points[j, 1]
    before = dx * (points[i, 1] - points[j, 1]) - dy * (points[i, 0] - points[j, 0])
    after = dx * (points[i_end, 1] - points[j, 1]) - dy * (points[i_end, 0] - points[j, 0])
    if before != after:
        return float(min(max(before / (before - after), 0.0), 1.0))
    # The edges lie on one line (or one has no length): they meet in the middle of what they share.
    axis = 0 if abs(points[i_end, 0] - points[i, 0]) >= abs(points[i_end, 1] - points[i, 1]) else 1
    start, end = points[i, axis], points[i_end, axis]
    if start == end:
        return 0.5
    low = max(min(start, end), min(points[j, axis], points[j_end, axis]))
    high = min(max(start, end), max(points[j, axis], points[j_end, axis]))
    return float(min(max((0.5 * (low + high) - start) / (end - start), 0.0), 1.0))


@njit(cache=True, nogil=True)
def _walk(beads: int, hits: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    """The strands in order of place.

    They are dealt out by edge, then each edge is sorted by fraction, ties by the other edge.
    """
    starts = np.zeros(beads + 1, np.int64)
    for strand in range(len(fractions)):
        starts[hits[strand // 2, strand % 2] + 1] += 1
    for edge in range(beads):
        starts[edge + 1] += starts[edge]
    walk = np.empty(len(fractions), np.int64)
    filled = starts[:beads].copy()
    for strand in range(len(fractions)):
        edge = hits[strand // 2, strand % 2]
        other = hits[strand // 2, 1 - strand % 2]
        place = filled[edge]
        filled[edge] += 1
        while place > starts[edge]:
            rival = walk[place - 1]
            if fractions[rival] < fractions[strand]:
                break
            if fractions[rival] == fractions[strand] and hits[rival // 2, 1 - rival % 2] < other:
                break
            walk[place] = rival
            place -= 1
        walk[place] = strand
    return walk


def is_compiled() -> bool:
    """Return whether an earlier process has left machine code of `scan` in numba's cache."""
    return any(Path(scan.stats.cache_path).glob("crossing_kernel.scan-*.nbi"))


def warn_of_compilation() -> None:
    """Log once, on standard error by default, that compiling is what the first run waits for."""
    if not _warned and not is_compiled():
        _log.warning("compiling, in the first run only; `knotgym compile` does it beforehand")
    _warned.append(True)


_warned: list[bool] = []
