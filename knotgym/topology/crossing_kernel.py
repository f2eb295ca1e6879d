"""Compiled search for the crossings of polylines; `topology.crossings` is its interface.

The beads of several curves, open or closed, stand one after the other. Edge k leads from bead k to
bead after[k]; the last bead of an open curve has no edge, and after is -1 there.

The search runs in five steps:

0. `_distinct`: vertices on the spot of the one before are taken out, as edges without a length
   cross nothing; their neighbours would seem to cross each other.
1. `_hits`: pairs of edges (i, j), i < j, whose projections cross. Bounding boxes of blocks of
   neighbouring edges rule out most pairs; on which sides of each other they lie decides the rest.
2. `_locate`: each hit h has two strands, strand 2 h on edge i and strand 2 h + 1 on edge j. Find
   where along its edge (fraction in [0, 1]) and at which height each strand passes the crossing.
3. `_walk`: sort the strands by their position along the rope.
4. `scan`: follow the walk, number the crossings in order of first visit, and compare heights.

All answers are exact, without a tolerance: floating point decides where a bound on its error allows
it, and `exact_signs` otherwise.

Arrays are copied element by element, here and in the other kernels: for a slice assignment numba
also compiles its error message, which adds seconds to the first run.

After a change run `pytest tests/topology/test_crossings.py` and `python benchmarks/labels.py`: no
label may be wrong.
"""

from collections import namedtuple

import numpy as np

from knotgym.common import inlined, inner, kernel
from knotgym.topology.exact_signs import FILTER, HALF_ULP, height_order, line_order, side

Columns = namedtuple("Columns", "over_place under_place over_z under_z sign x y")
CROSSING = Columns(*range(7))  # columns of the table of crossings

ALL = np.iinfo(np.int64).max  # crossings
# Vertices that are no farther apart along any axis than this share of the curve's largest extent
# are one: 16 units of rounding. A curve that is computed round to its first point misses it by a
# few, and the edge between would seem to cross the next but one. What is farther apart is labelled
# exactly, however near.
SAME = 2.0**-48
# about speed alone
_BLOCK = 8  # edges per bounding box; a rope of 100 beads has 13 blocks, so 91 block pairs to test


@kernel
def scan(points: np.ndarray) -> tuple[bool, np.ndarray, np.ndarray]:
    """Find all crossings of one closed rope.

    Args:
        points: float64 (beads, 3), contiguous.

    Returns:
        finite: whether all coordinates are finite; if not, nothing is searched.
        visits: int64 (2 n,), signed crossing labels in the order of the walk.
        table: float64 (n, 7), one row per crossing in order of labels; see CROSSING.
    """
    finite, visits, table, _ = scan_curves(points, *_one(points.shape[0]))
    return finite, visits, table


@inlined
def _one(beads: int) -> tuple[np.ndarray, np.ndarray]:
    """Return `ends` and `closed` of a single closed curve."""
    ends, closed = np.empty(1, np.int64), np.empty(1, np.bool_)
    ends[0], closed[0] = beads, True
    return ends, closed


@kernel
def scan_curves(
    points: np.ndarray, ends: np.ndarray, closed: np.ndarray
) -> tuple[bool, np.ndarray, np.ndarray, np.ndarray]:
    """Find all crossings of several curves, of each with itself and with the others.

    Args:
        points: float64 (beads, 3), contiguous; the curves one after the other.
        ends: int64 (curves,), the row after the last of each curve.
        closed: bool (curves,), whether its last bead is joined to its first.

    Returns:
        As `scan`, with places counted in rows of all points; and
        owners: int64 (2 n,), the edge of each visit.
    """
    if not _all_finite(points):
        return False, np.empty(0, np.int64), np.empty((0, 7)), np.empty(0, np.int64)
    points, edges, after = _distinct(points, ends, closed)
    hits = _hits(points, after, ALL)
    fractions, heights, errors = _locate(points, after, hits)
    walk = _walk(points, after, hits, fractions, errors)
    owners = np.empty(len(walk), np.int64)
    visits = np.empty(len(walk), np.int64)
    table = np.empty((len(hits), 7))
    first_visits = np.empty(len(hits), np.int64)  # per hit the signed label; 0: not yet visited
    first_visits[:] = 0
    nx = 0
    for k in range(len(walk)):
        h = walk[k] // 2
        owners[k] = edges[hits[h, walk[k] % 2]]
        if first_visits[h] == 0:
            nx += 1
            # `strand ^ 1` is the other strand of the same hit. At equal heights the strand that is
            # visited first counts as the upper one, so the code is always well defined.
            one, other = walk[k], walk[k] ^ 1
            above = heights[one] - heights[other]
            if abs(above) <= errors[one, 1] + errors[other, 1]:
                above = height_order(points, after, hits[h, one % 2], hits[h, other % 2])
            over = one if above >= 0 else other
            row = table[nx - 1]
            row[CROSSING.over_place] = edges[hits[h, over % 2]] + fractions[over]
            row[CROSSING.under_place] = edges[hits[h, 1 - over % 2]] + fractions[over ^ 1]
            row[CROSSING.over_z], row[CROSSING.under_z] = heights[over], heights[over ^ 1]
            # hits[h, 2] is the sign of d_i x d_j; the crossing sign is that of d_over x d_under
            row[CROSSING.sign] = hits[h, 2] if over % 2 == 0 else -hits[h, 2]
            start, end = hits[h, 0], after[hits[h, 0]]
            for axis, column in enumerate((CROSSING.x, CROSSING.y)):
                step = points[end, axis] - points[start, axis]
                row[column] = points[start, axis] + fractions[2 * h] * step
            visits[k] = nx if over == walk[k] else -nx
            first_visits[h] = visits[k]
        else:
            visits[k] = -first_visits[h]
    return True, visits, table, owners


@kernel
def scan_rows(points: np.ndarray, visits: np.ndarray, signs: np.ndarray, counts: np.ndarray) -> int:
    """Find the crossings of many ropes, one row a rope.

    Args:
        points: float64 (ropes, beads, 3), contiguous.
        visits: int16 (ropes, 2 width); gets the visits, padded with 0. Left as it is where a rope
            has more than `width` crossings.
        signs: int8 (ropes, width); gets +1 or -1 per crossing, padded with 0; likewise.
        counts: int64 (ropes,); gets the number of crossings, -1 if a coordinate isn't finite.

    Returns:
        The largest number of crossings.
    """
    most, width, shape = 0, signs.shape[1], _one(points.shape[1])
    for rope in range(points.shape[0]):
        finite, walked, table, _ = scan_curves(points[rope], *shape)
        nx = len(table)
        counts[rope] = nx if finite else -1
        most = max(most, nx)
        if nx <= width:
            for k in range(2 * width):
                visits[rope, k] = walked[k] if k < 2 * nx else 0
            for k in range(width):
                signs[rope, k] = 0 if k >= nx else 1 if table[k, CROSSING.sign] > 0 else -1
    return most


@inlined
def _all_finite(points: np.ndarray) -> bool:
    for bead in range(points.shape[0]):
        for axis in range(3):
            if not np.isfinite(points[bead, axis]):
                return False
    return True


@inner
def _distinct(
    points: np.ndarray, ends: np.ndarray, closed: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Take out vertices on the spot of the last one that was kept, and of closed curves also those
    at the end that are on the spot of the first.

    Returns:
        kept: float64 (m, 3), `points` itself if all are kept.
        edges: int64 (m,), the edge of `points` that leads from each of them to the next.
        after: int64 (m,), the next, -1 at the end of an open curve.
    """
    beads = points.shape[0]
    extent = 0.0
    for axis in range(3):
        # scaled before the difference, which may overflow
        low = high = points[0, axis]
        for bead in range(1, beads):
            low, high = min(low, points[bead, axis]), max(high, points[bead, axis])
        extent = max(extent, SAME * high - SAME * low)
    edges, first = np.empty(beads, np.int64), np.empty(beads, np.int64)
    after = np.empty(beads, np.int64)
    kept = row = 0
    for curve in range(len(ends)):
        start = kept
        for bead in range(row, ends[curve]):
            if kept == start or not _same_spot(points, first[kept - 1], bead, extent):
                first[kept], after[kept] = bead, kept + 1
                kept += 1
            edges[kept - 1] = bead  # the last vertex on the spot is where the next edge begins
        while (
            closed[curve]
            and kept > start + 1
            and _same_spot(points, first[start], first[kept - 1], extent)
        ):
            kept -= 1
        after[kept - 1] = start if closed[curve] else -1
        row = ends[curve]
    if kept == beads:
        return points, edges, after
    distinct = np.empty((kept, 3))
    for k in range(kept):
        for axis in range(3):
            distinct[k, axis] = points[first[k], axis]
    return distinct, edges, after[:kept]


@inner
def _same_spot(points: np.ndarray, one: int, other: int, extent: float) -> bool:
    for axis in range(3):
        if abs(points[one, axis] - points[other, axis]) > extent:
            return False
    return True


@inlined
def _boxes(points: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute bounding boxes in the plane, rows (x min, x max, y min, y max).

    Returns:
        edges: float64 (4, beads), one box per edge; an empty one where there is no edge.
        blocks: float64 (4, blocks), one box per _BLOCK neighbouring edges.
    """
    beads = points.shape[0]
    edges = np.empty((4, beads))
    blocks = np.empty((4, (beads + _BLOCK - 1) // _BLOCK))
    # empty boxes: any edge extends them
    blocks[0], blocks[1], blocks[2], blocks[3] = np.inf, -np.inf, np.inf, -np.inf
    for i in range(beads):
        end = after[i]
        if end < 0:
            edges[0, i], edges[1, i], edges[2, i], edges[3, i] = np.inf, -np.inf, np.inf, -np.inf
            continue
        for axis in range(2):
            low = min(points[i, axis], points[end, axis])
            high = max(points[i, axis], points[end, axis])
            edges[2 * axis, i], edges[2 * axis + 1, i] = low, high
            blocks[2 * axis, i // _BLOCK] = min(blocks[2 * axis, i // _BLOCK], low)
            blocks[2 * axis + 1, i // _BLOCK] = max(blocks[2 * axis + 1, i // _BLOCK], high)
    return edges, blocks


@inner
def _disjoint(boxes: np.ndarray, one: int, other: int) -> bool:
    # No early exit: four comparisons cost less than a mispredicted branch.
    apart_in_x = (boxes[0, one] > boxes[1, other]) | (boxes[0, other] > boxes[1, one])
    apart_in_y = (boxes[2, one] > boxes[3, other]) | (boxes[2, other] > boxes[3, one])
    return bool(apart_in_x | apart_in_y)


@kernel
def count_hits(points: np.ndarray, ends: np.ndarray, closed: np.ndarray, most: int) -> int:
    """Count the pairs of edges that cross; the search ends once there are more than `most`."""
    points, _, after = _distinct(points, ends, closed)
    return len(_hits(points, after, most))


@inner
def _hits(points: np.ndarray, after: np.ndarray, most: int) -> np.ndarray:
    """Find the pairs of edges i < j that cross; the search ends once there are more than `most`.

    Returns:
        int64 (n, 3): i, j, and the sign of the z-component of d_i x d_j, d being edge directions.
    """
    beads = points.shape[0]
    edges, blocks = _boxes(points, after)
    hits = np.empty((16, 3), np.int64)
    count = 0
    for a in range(blocks.shape[1]):
        for b in range(a, blocks.shape[1]):
            if _disjoint(blocks, a, b):
                continue
            for i in range(_BLOCK * a, min(_BLOCK * (a + 1), beads)):
                # edges that share a bead never cross: the next, and the last of a closed curve
                first = i + 2 if after[i] == i + 1 else i + 1
                for j in range(max(first, _BLOCK * b), min(_BLOCK * (b + 1), beads)):
                    if _disjoint(edges, i, j) or after[j] == i:
                        continue
                    turn = _crosses(points, after, i, j)
                    if turn != 0:
                        if count == len(hits):  # double the buffer
                            larger = np.empty((2 * count, 3), np.int64)
                            for h in range(count):
                                for k in range(3):
                                    larger[h, k] = hits[h, k]
                            hits = larger
                        hits[count, 0], hits[count, 1], hits[count, 2] = i, j, turn
                        count += 1
                        if count > most:
                            return hits[:count]
    return hits[:count]


@inlined
def _crosses(points: np.ndarray, after: np.ndarray, i: int, j: int) -> int:
    """Return 0 if edges i and j don't cross, else the side of edge i on which edge j ends.

    Two segments cross if each separates the end points of the other. `side` is never 0, so there
    is no touching case.
    """
    i_end, j_end = after[i], after[j]
    # the side of edge i on which edge j ends, and on which it begins: equal if j lies on one side
    turn: int = side(points, i, i_end, j_end)
    if side(points, i, i_end, j) == turn:
        return 0
    if side(points, j, j_end, i) == side(points, j, j_end, i_end):
        return 0
    return turn


@inlined
def _locate(
    points: np.ndarray, after: np.ndarray, hits: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find where each strand passes its crossing.

    Returns:
        fractions: float64 (2 n,), in [0, 1] along the strand's edge.
        heights: float64 (2 n,), z there, metres.
        errors: float64 (2 n, 2), bounds on the rounding errors of both.
    """
    fractions, heights = np.empty(2 * len(hits)), np.empty(2 * len(hits))
    errors = np.empty((2 * len(hits), 2))
    for h in range(len(hits)):
        for late in range(2):  # 0: the strand on edge i of the hit, 1: the one on edge j
            i, j, strand = hits[h, late], hits[h, 1 - late], 2 * h + late
            fraction, error = _fraction(points, i, after[i], j, after[j])
            low, high = points[i, 2], points[after[i], 2]
            fractions[strand], heights[strand] = fraction, low + fraction * (high - low)
            errors[strand, 0] = error
            errors[strand, 1] = error * abs(high - low) + 4 * HALF_ULP * (abs(low) + abs(high))
    return fractions, heights, errors


@inlined
def _fraction(points: np.ndarray, i: int, i_end: int, j: int, j_end: int) -> tuple[float, float]:
    """Return how far along the edge from i to i_end it meets that from j to j_end, and its error.

    With d the direction of edge j, the signed distance from its line is proportional to
    d x (p - p_j). It is linear along edge i, so its zero follows from its two end values.
    """
    dx, dy = points[j_end, 0] - points[j, 0], points[j_end, 1] - points[j, 1]
    left, right = dx * (points[i, 1] - points[j, 1]), dy * (points[i, 0] - points[j, 0])
    before, size = left - right, abs(left) + abs(right)
    left, right = dx * (points[i_end, 1] - points[j, 1]), dy * (points[i_end, 0] - points[j, 0])
    after, size = left - right, size + abs(left) + abs(right)
    # clip: rounding may put the zero just outside the edge
    if before != after:
        # The end values are off by FILTER * size together, and have other signs. So the fraction is
        # off by at most twice that, relative to their difference, unless it is of no use.
        error = 4 * FILTER * size / abs(before - after) + 4 * HALF_ULP
        return float(min(max(before / (before - after), 0.0), 1.0)), error
    # The edges are collinear, or one has no length: take the middle of what they share, measured
    # on the axis along which edge i is longer.
    axis = 0 if abs(points[i_end, 0] - points[i, 0]) >= abs(points[i_end, 1] - points[i, 1]) else 1
    start, end = points[i, axis], points[i_end, axis]
    if start == end:
        return 0.5, 0.0
    low = max(min(start, end), min(points[j, axis], points[j_end, axis]))
    high = min(max(start, end), max(points[j, axis], points[j_end, axis]))
    return float((0.5 * (low + high) - start) / (end - start)), 0.0


@inlined
def _walk(
    points: np.ndarray,
    after: np.ndarray,
    hits: np.ndarray,
    fractions: np.ndarray,
    errors: np.ndarray,
) -> np.ndarray:
    """Sort the strands by position along the curves, int64 (2 n,).

    A counting sort by edge, with an insertion sort by fraction within each edge: few edges have
    more than one strand.
    """
    beads = points.shape[0]
    # starts[e] : starts[e + 1] is the range of the walk that belongs to edge e
    starts, filled = np.empty(beads + 1, np.int64), np.empty(beads, np.int64)
    starts[:] = 0
    for strand in range(len(fractions)):
        starts[hits[strand // 2, strand % 2] + 1] += 1  # counts, shifted by one for the sums below
    for edge in range(beads):
        starts[edge + 1] += starts[edge]
    walk = np.empty(len(fractions), np.int64)
    for edge in range(beads):
        filled[edge] = starts[edge]  # the next free slot of each edge
    for strand in range(len(fractions)):
        edge = hits[strand // 2, strand % 2]
        slot = filled[edge]
        filled[edge] += 1
        # insertion from behind: strands of one edge that are farther along move up
        while slot > starts[edge]:
            before = walk[slot - 1]
            ahead = fractions[before] - fractions[strand]
            if abs(ahead) <= errors[before, 0] + errors[strand, 0]:
                crossed = hits[before // 2, 1 - before % 2], hits[strand // 2, 1 - strand % 2]
                ahead = line_order(points, after, edge, crossed[0], crossed[1])
            if ahead <= 0:
                break
            walk[slot] = before
            slot -= 1
        walk[slot] = strand
    return walk
