"""Lines of ropes in the fields that the network returns: open or closed, one or several.

Points are taken from the ridges of the lifted fields, each with the direction of its strand. A
point has two ends, one on either side, and an end is linked to at most one end of another point:
the cheapest links first, where short, straight and evenly bent ones are cheap. Two strands that
cross share places, but not directions, so links between them are dear. Following the links gives
chains; short ones are points found twice and are dropped, and the others are mended
(`line_mending`). Places are in cells, x right and y down; the centre of cell (row, column) is
(column, row).

After a change run `pytest tests/photos/test_rope_reader.py`: drawn lines must be walked through
their crossings.
"""

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Ids, inner, kernel
from knotgym.photos.line_mending import (
    BEND,
    CUT,
    CUT_APART,
    DARK,
    STEP,
    Line,
    mended,
    one_way,
    response_at,
    smooth,
)

# Chosen on training pictures and drawn photos, one by one. No file depends on them: after a change,
# ropes must be read as docs/photos.md says.
_LEAST = 0.3  # response of a point
_MOST = 20000  # candidates, at most; a picture with more shows no rope
# Of two points nearer than this, the weaker is dropped: cells, and radians.
_NEAR, _ALIKE = 1.3, 0.35
_REACH = 9.0  # length of a link at most, cells
_DEAREST = 9.0  # cost of a link at most, cells
_SWEEPS = 8  # over all pairs of links, at most
_ROUNDS = 20  # times that short chains are dropped, at most
_SWERVE = 3.0  # cost of a link that doesn't point in the direction of both ends: share per radian^2
_WHOLE = 0.92  # share of the points at which closed lines are taken for all that there is
_LOOSE = 4  # points; a shorter chain is dropped while points are linked
# points of the shortest rope, at the edge of the picture, where little of one may be seen, and
# elsewhere; a line of fewer than _BRIEF is a rope only if its mean response is no weaker
_STUB, _SHORT, _BRIEF, _WEAK = 4, 8, 24, 0.6
_CROWDED = 3200  # points; more aren't a rope's


def lines_in(fields: NDArray[np.float32], frame: Array) -> list[Line]:
    """Find the lines of ropes.

    Args:
        fields: float32 (orientations, h, w), responses in [0, 1].
        frame: float64 (4,), left, top, right and lower edge of the picture in them, cells; strands
            that leave there aren't joined.

    Returns:
        The lines, the longest first.
    """
    points, response = _ridge_points(fields), fields.max(axis=0)
    if not _STUB <= len(points) <= _CROWDED:
        return []
    for loose in (False, True):
        partner, paid = _link(points, response, frame, loose)
        _exchange(points, partner, paid)
        chains = [chain for chain in _chains(points, partner) if len(chain.points) >= _STUB]
        if sum(len(chain.points) for chain in chains if chain.closed) >= _WHOLE * len(points):
            break
    lines = [chain for chain in chains if _is_rope(chain, response, frame)]
    lines = mended(lines, response, frame)
    lines = [smooth(one_way(line, response)) for line in lines]
    return sorted(lines, key=lambda line: -len(line.points))


def _is_rope(line: Line, response: NDArray[np.float32], frame: Array) -> bool:
    count = len(line.points)
    near = np.abs(np.tile(line.points[[0, -1]], 2) - frame).min() < CUT
    strong = response_at(response, line.points).mean() >= _WEAK
    return bool(count >= _BRIEF or (count >= (_STUB if near else _SHORT) and strong))


@kernel
def _ridge_points(lines: NDArray[np.float32]) -> Array:
    """Return points on the ridges of fields.

    Args:
        lines: float32 (orientations, h, w), in [0, 1].

    Returns:
        float64 (n, 4): x, y, direction in radians, and response.
    """
    count, h, w = lines.shape
    pixels = np.empty((_MOST, 4))
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
                pixels[n, 0] = column + min(max(aside, -0.5), 0.5) * across_x
                pixels[n, 1] = row + min(max(aside, -0.5), 0.5) * across_y
                pixels[n, 2] = angle + min(max(turn, -0.5), 0.5) * np.pi / count
                pixels[n, 3] = here
                n += 1
    pixels = pixels[:n]
    pixels = pixels[np.argsort(-pixels[:, 3])]
    kept = np.empty(n, np.int64)
    m = 0
    for i in range(n):
        new = True
        for j in range(m):
            k = kept[j]
            dx, dy = pixels[i, 0] - pixels[k, 0], pixels[i, 1] - pixels[k, 1]
            if dx * dx + dy * dy < _NEAR * _NEAR:
                off = abs(pixels[i, 2] - pixels[k, 2]) % np.pi
                if min(off, np.pi - off) < _ALIKE:
                    new = False
                    break
        if new:
            kept[m] = i
            m += 1
    return pixels[kept[:m]]


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
    return length * (1 + _SWERVE * swerve * swerve) + BEND * turn


@kernel
def _link(
    points: Array, response: NDArray[np.float32], frame: Array, loose: bool
) -> tuple[Ids, Array]:
    """Link the ends of points, the cheapest first, and drop points that were found twice.

    Args:
        points: as `_ridge_points` returns them.
        response: float32 (h, w), the largest of each cell.
        frame: as of `lines_in`.
        loose: whether lines may have ends: short chains are dropped; otherwise points with a loose
            end are, of those near each other the weakest.

    Returns:
        int64 (2 n,), the end that each end is linked to, -1 for none, -2 of points that were
        dropped; float64 (2 n,), the costs.
    """
    n = len(points)
    most = 200 * n + 1
    first, second, costs = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    m = 0
    for a in range(n):
        for b in range(a + 1, n):
            dx, dy = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]
            if dx * dx + dy * dy > _REACH * _REACH or _are_cut(points, frame, a, b):
                continue
            column, row = int(points[a, 0] - 0.5 * dx + 0.5), int(points[a, 1] - 0.5 * dy + 0.5)
            if dx * dx + dy * dy > STEP * STEP and response[row, column] < DARK:
                continue
            for i in range(2 * a, 2 * a + 2):
                for j in range(2 * b, 2 * b + 2):
                    cost = _link_cost(points, i, j)
                    if cost < _DEAREST and m < len(costs):
                        first[m], second[m], costs[m] = i, j, cost
                        m += 1
    dear = np.argsort(costs[:m])
    partner, paid = np.full(2 * n, -1, np.int64), np.zeros(2 * n)
    for _ in range(_ROUNDS):
        for end in range(2 * n):
            if partner[end] != -2:
                partner[end] = -1
        for k in dear:
            i, j = first[k], second[k]
            if partner[i] == -1 and partner[j] == -1:
                partner[i], partner[j] = j, i
                paid[i] = paid[j] = costs[k]
        if not (_drop_short(partner) if loose else _drop_loose(points, partner)):
            break
    return partner, paid


@inner
def _are_cut(points: Array, frame: Array, a: int, b: int) -> bool:
    """Tell whether two points seem to lie on strands that leave the picture beside each other."""
    for side in range(4):  # left, top, right, bottom
        axis = side % 2
        if max(abs(points[a, axis] - frame[side]), abs(points[b, axis] - frame[side])) > CUT:
            continue
        apart = abs(points[a, 1 - axis] - points[b, 1 - axis])
        # how much a strand points across this side: a bend that only comes near runs along it
        steep = 1.0
        for k in (a, b):
            angle = points[k, 2]
            steep = min(steep, abs(np.sin(angle) if axis else np.cos(angle)))
        if apart > CUT_APART and steep > 0.85:
            return True
    return False


@inner
def _drop_loose(points: Array, partner: Ids) -> bool:
    """Drop points with a loose end, of those near each other the weakest; were there any?"""
    near, dropped = np.ones(len(points), np.bool_), False
    for a in range(len(points) - 1, -1, -1):  # the weakest first
        if near[a] and (partner[2 * a] == -1 or partner[2 * a + 1] == -1):
            dropped = True
            for end in (2 * a, 2 * a + 1):
                if partner[end] >= 0:
                    # it is no longer linked, but is loose only in the next round
                    partner[partner[end]] = -3
                partner[end] = -2
            for b in range(len(points)):
                dx, dy = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]
                if dx * dx + dy * dy < _REACH * _REACH:
                    near[b] = False
    return dropped


@inner
def _drop_short(partner: Ids) -> bool:
    """Drop the points of open chains that are too short; return whether there were any."""
    dropped = False
    for end in range(len(partner)):  # each chain, from its loose end
        if partner[end] != -1:
            continue
        length, leaves = 1, end ^ 1
        while partner[leaves] >= 0:
            leaves = partner[leaves] ^ 1
            length += 1
        if length >= _LOOSE:
            continue
        dropped, leaves = True, end ^ 1
        while True:
            onwards = partner[leaves]
            partner[leaves] = partner[leaves ^ 1] = -2
            if onwards < 0:
                break
            leaves = onwards ^ 1
    return dropped


@kernel
def _exchange(points: Array, partner: Ids, paid: Array) -> None:
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


@kernel
def _follow(partner: Ids) -> tuple[Ids, Ids]:
    """Follow links from end to end: int64 (m,), points, chain after chain; and where each ends, -k
    for a closed one.
    """
    n = len(partner) // 2
    order, stops, m = np.empty(n, np.int64), np.empty(n, np.int64), 0
    seen, chains = np.zeros(n, np.bool_), 0
    for closed in range(2):  # open chains first, from their loose ends
        for end in range(2 * n):
            if seen[end // 2] or partner[end] == -2 or (not closed and partner[end] >= 0):
                continue
            leaves = end ^ 1
            while True:
                seen[leaves // 2] = True
                order[m] = leaves // 2
                m += 1
                onwards = partner[leaves]
                if onwards < 0 or seen[onwards // 2]:
                    break
                leaves = onwards ^ 1
            stops[chains] = -m if closed else m
            chains += 1
    return order[:m], stops[:chains]


def _chains(points: Array, partner: Ids) -> list[Line]:
    """Return the chains of linked points."""
    order, stops = _follow(partner)
    parts = np.split(points[order, :2], np.abs(stops)[:-1])
    return [Line(part, stop < 0) for part, stop in zip(parts, stops.tolist(), strict=False)]


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
