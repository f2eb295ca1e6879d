"""Walk along a rope in the lifted fields of a picture (`strand_network`); compiled.

Points are taken from the ridges of the fields, each with the direction of its strand. A point has
two ends, one on either side, and every end is linked to one end of another point: the cheapest
links first, where short, straight and evenly bent ones are cheap. So each point has two neighbours,
and following them gives closed lines. Two strands that cross share places, but not directions, so
links between them are dear.

Places are in cells, x right and y down; the centre of cell (row, column) is (column, row).

After a change run `pytest tests/learn/test_rope_reader.py`: drawn lines must be walked through
their crossings.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from knotgym.common import inner

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Values below were set by hand on training pictures.
_LEAST = 0.3  # response of a point
_MOST = 6000  # candidates, at most; a picture with more shows no rope
# Of two points nearer than this, the weaker is dropped: cells, and radians.
_NEAR, _ALIKE = 1.3, 0.35
_REACH = 9.0  # length of a link at most, cells
_SWEEPS = 8  # over all pairs of links, at most
_ROUNDS = 20  # times that loose points are dropped, at most
_BEND = 2.5  # cost of a turn of one radian, cells
_SWERVE = 3.0  # cost of a link that doesn't point in the direction of both ends: share per radian^2


@njit(cache=True, nogil=True)
def ridge_points(lines: NDArray[np.float32]) -> Array:
    """Return points on the ridges of fields.

    Args:
        lines: float32 (orientations, h, w), in [0, 1].

    Returns:
        float64 (n, 4): x, y, direction in radians, and response.
    """
    count, h, w = lines.shape
    found = np.empty((_MOST, 4))
    n = 0
    for k in range(count):
        angle = k * np.pi / count
        across_x, across_y = -np.sin(angle), np.cos(angle)
        for row in range(h):
            for column in range(w):
                here = lines[k, row, column]
                if here < _LEAST or n == _MOST:
                    continue
                left = _at(lines, k, column - across_x, row - across_y)
                right = _at(lines, k, column + across_x, row + across_y)
                if here < left or here <= right:
                    continue
                # the top of the parabola through the three responses
                aside = 0.5 * (right - left) / max(2 * here - left - right, 1e-6)
                less, more = lines[k - 1, row, column], lines[(k + 1) % count, row, column]
                turn = 0.5 * (more - less) / max(2 * here - less - more, 1e-6)
                found[n, 0] = column + min(max(aside, -0.5), 0.5) * across_x
                found[n, 1] = row + min(max(aside, -0.5), 0.5) * across_y
                found[n, 2] = angle + min(max(turn, -0.5), 0.5) * np.pi / count
                found[n, 3] = here
                n += 1
    found = found[:n]
    found = found[np.argsort(-found[:, 3])]
    kept = np.empty(n, np.int64)
    m = 0
    for i in range(n):
        new = True
        for j in range(m):
            k = kept[j]
            dx, dy = found[i, 0] - found[k, 0], found[i, 1] - found[k, 1]
            if dx * dx + dy * dy < _NEAR * _NEAR:
                off = abs(found[i, 2] - found[k, 2]) % np.pi
                if min(off, np.pi - off) < _ALIKE:
                    new = False
                    break
        if new:
            kept[m] = i
            m += 1
    return found[kept[:m]]


@inner
def _link_cost(points: Array, i: int, j: int) -> float:
    """Return the cost of linking end i to end j, cells; end 2 k + 1 of point k is that ahead."""
    a, b = i // 2, j // 2
    one, other = (1.0 if i % 2 else -1.0), (-1.0 if j % 2 else 1.0)
    # directions in which the rope leaves the first point and arrives at the second
    ax, ay = one * np.cos(points[a, 2]), one * np.sin(points[a, 2])
    bx, by = other * np.cos(points[b, 2]), other * np.sin(points[b, 2])
    dx, dy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
    length = np.sqrt(dx * dx + dy * dy)
    turn = np.arccos(min(max(ax * bx + ay * by, -1.0), 1.0))
    # an even bend leads along the middle of both directions
    mx, my = ax + bx, ay + by
    swerve = 0.0
    if length > 1e-6:
        swerve = abs(np.arctan2(mx * dy - my * dx, mx * dx + my * dy))
    return length * (1 + _SWERVE * swerve * swerve) + _BEND * turn


@njit(cache=True, nogil=True)
def link(points: Array) -> tuple[Integers, Array]:
    """Link the ends of points, the cheapest first.

    Returns:
        int64 (2 n,), the end that each end is linked to, -1 for none; float64 (2 n,), the costs.
    """
    n = len(points)
    first, second, costs = (
        np.empty(120 * n + 1, np.int64),
        np.empty(120 * n + 1, np.int64),
        np.empty(120 * n + 1),
    )
    m = 0
    for a in range(n):
        for b in range(a + 1, n):
            dx, dy = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]
            if dx * dx + dy * dy > _REACH * _REACH:
                continue
            for i in range(2 * a, 2 * a + 2):
                for j in range(2 * b, 2 * b + 2):
                    cost = _link_cost(points, i, j)
                    if cost < 2 * _REACH and m < len(costs):
                        first[m], second[m], costs[m] = i, j, cost
                        m += 1
    dear = np.argsort(costs[:m])
    alive = np.ones(n, np.bool_)
    partner, paid = np.full(2 * n, -1, np.int64), np.zeros(2 * n)
    for _ in range(_ROUNDS):
        partner[:] = -1
        for k in dear:
            i, j = first[k], second[k]
            if partner[i] < 0 and partner[j] < 0 and alive[i // 2] and alive[j // 2]:
                partner[i], partner[j] = j, i
                paid[i] = paid[j] = costs[k]
        # a point with a loose end was found twice: of those near each other, drop the weakest
        loose = alive & ((partner[::2] < 0) | (partner[1::2] < 0))
        if not loose.any():
            break
        for a in np.flatnonzero(loose)[::-1]:  # the weakest first
            if loose[a]:
                alive[a] = False
                for b in range(n):
                    dx, dy = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]
                    if dx * dx + dy * dy < _REACH * _REACH:
                        loose[b] = False
    return partner, paid


@njit(cache=True, nogil=True)
def exchange(points: Array, partner: Integers, paid: Array) -> None:
    """Exchange the ends of two links, in place, as long as that makes them cheaper together."""
    for _ in range(_SWEEPS):
        better = False
        for i in range(len(partner)):
            for j in range(i + 1, len(partner)):
                one, other = partner[i], partner[j]
                if one < 0 or other < 0 or one == j or i // 2 == j // 2 or one // 2 == other // 2:
                    continue
                dx = points[i // 2, 0] - points[j // 2, 0]
                dy = points[i // 2, 1] - points[j // 2, 1]
                if dx * dx + dy * dy > _REACH * _REACH:
                    continue
                left, right = _link_cost(points, i, j), _link_cost(points, one, other)
                if left + right < paid[i] + paid[j] - 1e-6:
                    partner[i], partner[j], partner[one], partner[other] = j, i, other, one
                    paid[i] = paid[j] = left
                    paid[one] = paid[other] = right
                    better = True
        if not better:
            return


@njit(cache=True, nogil=True)
def follow(partner: Integers) -> tuple[Integers, Integers]:
    """Follow links from end to end.

    Returns:
        int64 (n,), the ends by which points are left, one line after the other; int64 (n,), the
        number of the line that each belongs to, -1 for a line that doesn't close.
    """
    n = len(partner) // 2
    order, line = np.empty(n, np.int64), np.empty(n, np.int64)
    seen = np.zeros(n, np.bool_)
    m = lines = 0
    for start in range(n):
        if seen[start]:
            continue
        begin, end, closed = m, 2 * start + 1, False
        while True:
            seen[end // 2] = True
            order[m], line[m] = end, lines
            m += 1
            after = partner[end]
            if after < 0:
                break
            if after // 2 == start:
                closed = True
                break
            if seen[after // 2]:
                break
            end = after ^ 1
        if not closed:
            line[begin:m] = -1
            end = partner[2 * start]  # the other way
            while end >= 0 and not seen[end // 2]:
                seen[end // 2] = True
                order[m], line[m] = end, -1
                m += 1
                end = partner[end ^ 1]
        lines += 1
    return order[:m], line[:m]


@inner
def _at(lines: NDArray[np.float32], k: int, x: float, y: float) -> float:
    """Interpolate one field between cells."""
    _, h, w = lines.shape
    column, row = int(np.floor(x)), int(np.floor(y))
    dx, dy = x - column, y - row
    out = 0.0
    for r in range(2):
        for c in range(2):
            if 0 <= row + r < h and 0 <= column + c < w:
                weight = (dy if r else 1 - dy) * (dx if c else 1 - dx)
                out += weight * lines[k, row + r, column + c]
    return out
