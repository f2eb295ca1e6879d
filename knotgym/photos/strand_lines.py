"""Lines of ropes in the fields that the network returns: open or closed, one or several.

Points are taken from the ridges of the lifted fields, each with the direction of its strand. A
point has two ends, one on either side, and an end is linked to at most one end of another point:
the cheapest links first, where short, straight and evenly bent ones are cheap. Two strands that
cross share places, but not directions, so links between them are dear. Following the links gives
chains; short ones are points found twice and are dropped, and loose ends that face each other are
joined. Places are in cells, x right and y down; the centre of cell (row, column) is (column, row).

After a change run `pytest tests/photos/test_rope_reader.py`: drawn lines must be walked through
their crossings.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Ids, inner, kernel

# Chosen on training pictures and drawn photos, one by one. No file depends on them: after a change,
# ropes must be read as docs/photos.md says.
_LEAST = 0.3  # response of a point
_MOST = 20000  # candidates, at most; a picture with more shows no rope
# Of two points nearer than this, the weaker is dropped: cells, and radians.
_NEAR, _ALIKE = 1.3, 0.35
_REACH = 9.0  # length of a link at most, cells
_DEAREST = 9.0  # cost of a link at most, cells
_STEP, _DARK = 3.0, 0.05  # a longer link, cells, has such a response in its middle, at least
_SWEEPS = 8  # over all pairs of links, at most
_ROUNDS = 20  # times that short chains are dropped, at most
_BEND = 2.5  # cost of a turn of one radian, cells
_SWERVE = 3.0  # cost of a link that doesn't point in the direction of both ends: share per radian^2
_CUT, _CUT_APART = 3.5, 4.0  # of ends at the edge of the picture: from it, from each other, cells
_WHOLE = 0.92  # share of the points at which closed lines are taken for all that there is
_LOOSE = 4  # points; a shorter chain is dropped while points are linked
_SHORT = 8  # points; a shorter line is no rope
_BRIEF, _WEAK = 24, 0.6  # points; a line so short of a weaker response is no rope
_CROWDED = 3200  # points; more aren't a rope's
_LOOP = 6.0  # length of the smallest loop, cells
# loose ends are joined over so many cells, if they turn by no more than so many radians together
_GAP, _TURN = 9.0, 1.2
_LIT = 0.25  # or if the response between them is so large everywhere, whatever the turn
# loose ends so near, cells, that face each other so well (cosine), while another line passes so
# near, cells, all the way between them: a flat crossing
_MERGED, _FACING, _BESIDE = 34.0, 0.7, 2.2
# of lines that touch: distance, cells; points on either side; by how much less they bend, crossed
_TOUCH, _ARM, _BENT = 1.8, 6, 0.3
_TWIN, _PARALLEL = 2.5, 0.5  # a line so near to a longer one, and so parallel, cells and radians
_TWIN_SHARE = 0.6  # of its points, was found twice
_FILLED = 0.7  # response between both sides of a closed line, of theirs, that is one rope's


class Line(NamedTuple):
    """The centre line of a strand: float64 (n, 2), cells; and whether it is closed."""

    points: Array
    closed: bool


def lines_in(fields: NDArray[np.float32], frame: Array) -> tuple[list[Line], float]:
    """Find the lines of ropes.

    Args:
        fields: float32 (orientations, h, w), responses in [0, 1].
        frame: float64 (4,), left, top, right and lower edge of the picture in them, cells; strands
            that leave there aren't joined.

    Returns:
        The lines, the longest first; and the share of the points found that they pass.
    """
    points, response = _ridge_points(fields), fields.max(axis=0)
    if not _SHORT <= len(points) <= _CROWDED:
        return [], 0.0
    for loose in (False, True):
        partner, paid = _link(points, response, frame, loose)
        _exchange(points, partner, paid)
        chains = [chain for chain in _chains(partner) if len(chain[0]) >= _SHORT]
        if sum(len(own) for own, closed in chains if closed) >= _WHOLE * len(points):
            break
    lines = [
        Line(points[own, :2], closed) for own, closed in chains
        if len(own) >= _BRIEF or points[own, 3].mean() >= _WEAK
    ]  # fmt: skip
    lines = _exchanged(_joined(_parted(_alone(lines)), response, frame))
    passed = sum(len(one.points) for one in lines) / len(points)
    lines = [_smooth(_one_way(one, response)) for one in lines]
    lines = [one for one in lines if len(one.points) >= _SHORT]
    return sorted(lines, key=lambda one: -len(one.points)), min(passed, 1.0)


@kernel
def _ridge_points(lines: NDArray[np.float32]) -> Array:
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
            if dx * dx + dy * dy > _STEP * _STEP and response[row, column] < _DARK:
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
        if max(abs(points[a, axis] - frame[side]), abs(points[b, axis] - frame[side])) > _CUT:
            continue
        apart = abs(points[a, 1 - axis] - points[b, 1 - axis])
        # how much a strand points across this side: a bend that only comes near runs along it
        steep = 1.0
        for k in (a, b):
            angle = points[k, 2]
            steep = min(steep, abs(np.sin(angle) if axis else np.cos(angle)))
        if apart > _CUT_APART and steep > 0.85:
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


def _chains(partner: Ids) -> list[tuple[Ids, bool]]:
    """Return the points of each chain, and whether it is closed."""
    order, stops = _follow(partner)
    parts = np.split(order, np.abs(stops)[:-1])
    return [(own, stop < 0) for own, stop in zip(parts, stops.tolist(), strict=False)]


def _alone(lines: list[Line]) -> list[Line]:
    """Drop lines that run beside a longer one: their points were found twice."""
    kept = list[Line]()
    for line in sorted(lines, key=lambda one: -len(one.points)):
        angle, twins = _angles(line), np.zeros(len(line.points), bool)
        for other in kept:
            apart = np.hypot(*(line.points[:, None] - other.points[None]).transpose(2, 0, 1))
            nearest = apart.argmin(axis=1)
            off = np.abs(_angles(other)[nearest] - angle) % np.pi
            twins |= (apart.min(axis=1) < _TWIN) & (np.minimum(off, np.pi - off) < _PARALLEL)
        if twins.mean() <= _TWIN_SHARE:
            kept.append(line)
    return kept


def _one_way(line: Line, response: NDArray[np.float32]) -> Line:
    """Return half of a closed line that runs there and back on one wide rope."""
    if not line.closed:
        return line
    tip = int(np.hypot(*(line.points - line.points.mean(axis=0)).T).argmax())
    there, back = np.array_split(np.roll(line.points, -tip, 0), 2)
    back = back[np.hypot(*(there[:, None] - back[None]).transpose(2, 0, 1)).argmin(axis=1)]
    sides = np.minimum(_response_at(response, there), _response_at(response, back))
    filled = _response_at(response, 0.5 * (there + back)) > _FILLED * sides
    return Line(there, False) if filled.mean() > _TWIN_SHARE else line


def _response_at(response: NDArray[np.float32], places: Array) -> NDArray[np.float32]:
    column, row = np.rint(places).astype(int).T.clip(0, response.shape[0] - 1)
    return response[row, column]


def _angles(line: Line) -> Array:
    step = np.gradient(line.points, axis=0)
    return np.arctan2(step[:, 1], step[:, 0])


def _parted(lines: list[Line]) -> list[Line]:
    """Part strands that were found as one where they cross at a flat angle.

    One of them then has two loose ends that face each other beside the other. Both are cut there,
    and the four ends are joined so that they cross: strands that only touch are further apart.
    """
    while True:
        found = list[tuple[float, Array, Array, list[Line], Array, Array]]()
        ends = _loose_ends(lines)
        for i, (k, side, at, way) in enumerate(ends):
            for other, far, there, their in ends[:i]:
                gap = float(np.hypot(*(there - at)))
                ahead = (there - at) / max(gap, 1e-6)
                if 1.0 < gap < _MERGED and min(way @ ahead, -their @ ahead) > _FACING:
                    own = {(k, side), (other, far)}
                    if cut := _cut_between(lines, at, there, own):
                        found.append((gap, at, there, *cut))
        if not found:
            return lines
        _, a, b, lines, c, d = min(found, key=lambda one: one[0])
        pairs = ((a, b), (c, d)) if _meet(a, b, c, d) or not _meet(a, d, c, b) else ((a, d), (c, b))
        for one, two in pairs:
            lines = _united(lines, _end_at(lines, one), _end_at(lines, two))


def _cut_between(
    lines: list[Line], at: Array, there: Array, own: set[tuple[int, int]]
) -> tuple[list[Line], Array, Array] | None:
    """Cut the line that passes between two ends beside the way from one to the other.

    Args:
        own: line and side of both ends.

    Returns:
        The lines, and the ends of the cut beside `at` and `there`; None if there is no such line.
    """
    between = at + np.linspace(0.2, 0.8, 7)[:, None] * (there - at)
    for k, line in enumerate(lines):
        points = line.points
        apart = np.hypot(*(points[:, None] - between[None]).transpose(2, 0, 1))
        if line.closed:
            shift = len(points) // 2 - int(apart[:, 3].argmin())
            points, apart = np.roll(points, shift, 0), np.roll(apart, shift, 0)
        for side in (0, 1):  # not the ends themselves
            if (k, side) in own:
                apart[slice(-4, None) if side else slice(0, 4)] = np.inf
        nearest = apart.argmin(axis=0)
        first, last = sorted((int(nearest[0]), int(nearest[-1])))
        step = np.diff(nearest) * np.sign(nearest[-1] - nearest[0])
        if apart.min(axis=0).max() > _BESIDE or last - first < 2 or step.min() < 0:
            continue
        if min(first - 1, len(points) - last - 2) < 4:
            continue
        whole = [*lines[:k], Line(points, line.closed), *lines[k + 1 :]]
        cut, before, after = _cut(whole, k, first - 1, last + 2)
        return cut, *((before, after) if nearest[0] < nearest[-1] else (after, before))
    return None


def _cut(lines: list[Line], k: int, first: int, last: int) -> tuple[list[Line], Array, Array]:
    """Take points [first, last) out of line k; return the lines, and the ends before and behind."""
    points = lines[k].points
    parts = [points[:first], points[last:]]
    if lines[k].closed:
        parts = [np.concatenate(parts[::-1])]
    cut = [Line(one, False) for one in parts]
    return [*lines[:k], *lines[k + 1 :], *cut], points[first - 1], points[last]


def _exchanged(lines: list[Line]) -> list[Line]:
    """Let lines cross where they touch and both bend away: so near, strands cross."""
    if not lines:
        return lines
    while True:
        points = np.concatenate([one.points for one in lines])
        owner = np.repeat(np.arange(len(lines)), [len(one.points) for one in lines])
        index = np.concatenate([np.arange(len(one.points)) for one in lines])
        size = np.array([len(one.points) for one in lines])[owner]
        room = np.array([one.closed for one in lines])[owner] & (size > 4 * _ARM)
        room |= (index >= _ARM) & (index < size - _ARM)
        away = np.abs(index[:, None] - index)
        alike = (owner[:, None] == owner) & (np.minimum(away, size - away) < 2 * _ARM)
        apart = np.hypot(*(points[:, None] - points).transpose(2, 0, 1))
        near = (apart < _TOUCH) & ~alike & room & room[:, None]
        found = np.argwhere(np.triu(near))
        for a, b in found[np.argsort(apart[tuple(found.T)])]:
            middle = 0.5 * (points[a] + points[b])
            ahead = [index[one] + np.array([-_ARM, _ARM]) for one in (a, b)]
            (p, q), (r, t) = (
                points[one - index[one] + there % size[one]]
                for one, there in zip((a, b), ahead, strict=True)
            )
            pairs = ((p, t), (r, q)) if _meet(p, t, r, q) else ((p, r), (q, t))
            if (
                not _meet(p, q, r, t)
                and _meet(*pairs[0], *pairs[1])
                and sum(_bend(*pair, middle) for pair in pairs) + _BENT
                < _bend(p, q, points[a]) + _bend(r, t, points[b])
            ):
                break
        else:
            return lines
        straight = _meet(p, t, r, q)
        ends = []
        for place in (points[a], points[b]):
            k = next(k for k, one in enumerate(lines) if (one.points == place).all(axis=1).any())
            line = lines[k]
            at = int((line.points == place).all(axis=1).argmax())
            if line.closed:
                shift = len(line.points) // 2 - at
                rolled = Line(np.roll(line.points, shift, 0), True)
                lines, at = [*lines[:k], rolled, *lines[k + 1 :]], at + shift
            lines, before, after = _cut(lines, k, at - 1, at + 2)
            ends += [before, after]
        p, q, r, t = ends
        for one, two in ((p, t), (r, q)) if straight else ((p, r), (q, t)):
            lines = _united(lines, _end_at(lines, one), _end_at(lines, two))


def _bend(first: Array, last: Array, middle: Array) -> float:
    """Return by how much the way from first to last turns in the middle, radians."""
    one, other = middle - first, last - middle
    cosine = one @ other / max(np.hypot(*one) * np.hypot(*other), 1e-6)
    return float(np.arccos(np.clip(cosine, -1, 1)))


def _meet(a: Array, b: Array, c: Array, d: Array) -> bool:
    """Tell whether the segment from a to b crosses that from c to d."""

    def side(p: Array, q: Array, r: Array) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    return side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0


def _end_at(lines: list[Line], place: Array) -> tuple[int, int]:
    """Return which line ends at a place, and at which side."""
    return next(
        (k, side) for k, one in enumerate(lines) for side in (0, 1)
        if not one.closed and np.array_equal(one.points[-side], place)
    )  # fmt: skip


def _united(lines: list[Line], one: tuple[int, int], two: tuple[int, int]) -> list[Line]:
    """Join two ends, each a line and its side; a line's own two ends close it."""
    (k, side), (other, far) = one, two
    rest = [line for index, line in enumerate(lines) if index not in (k, other)]
    before = lines[k].points if side else lines[k].points[::-1]
    behind = lines[other].points[::-1] if far else lines[other].points
    over = 0  # points by which each passes the other's end
    while 2 * over + 8 < min(len(before), len(behind)):
        last, first = before[-1 - over], behind[over]
        ways = last - before[-4 - over], behind[over + 3] - first
        if max(way @ (first - last) for way in ways) >= 0:
            break
        over += 1
    before = before[: len(before) - over]
    if k == other:
        return [*rest, Line(before[over:], True)]
    return [*rest, Line(np.concatenate([before, behind[over:]]), False)]


def _joined(lines: list[Line], response: NDArray[np.float32], frame: Array) -> list[Line]:
    """Join loose ends that are near and face each other, the nearest first.

    Args:
        response: float32 (h, w), the largest of each cell.
        frame: as of `lines_in`.
    """
    while True:
        ends = _loose_ends(lines)
        found = list[tuple[float, int, int]]()
        for i, (_, _, at, way) in enumerate(ends):
            for j, (_, _, there, their) in enumerate(ends[:i]):
                gap = np.hypot(*(there - at))
                turn = np.arccos(np.clip(way @ -their, -1, 1))
                cut = np.abs(np.concatenate([at, at]) - frame) < _CUT
                cut &= np.abs(np.concatenate([there, there]) - frame) < _CUT
                if gap >= (_CUT_APART if cut.any() else _GAP):
                    continue
                # each points at the other; or at a tight bend, where all directions are lit, the
                # response between them is that of a strand
                faces = min(way @ (there - at), their @ (at - there)) > 0.5 * gap
                between = at + np.linspace(0, 1, 9)[:, None] * (there - at)
                # strands that leave the picture side by side are lit as well, but less
                least = _response_at(response, between).min()
                dark = gap > _STEP and least < _DARK
                if (turn < _TURN and faces and not dark) or least > _LIT * (1 + cut.any()):
                    found.append((gap + _BEND * turn, i, j))
        if not found:
            return lines
        one, other = (ends[index][:2] for index in min(found)[1:])
        lines = _united(lines, one, other)


def _loose_ends(lines: list[Line]) -> list[tuple[int, int, Array, Array]]:
    """Return the loose ends: line, side, place and direction."""
    return [
        (k, side, *_loose_end(one, side))
        for k, one in enumerate(lines) if not one.closed for side in (0, 1)
    ]  # fmt: skip


def _loose_end(line: Line, side: int) -> tuple[Array, Array]:
    """Return where a line ends, at its start (0) or end (1), and the direction it leaves in."""
    points = line.points if side else line.points[::-1]
    step = points[-1] - points[max(len(points) - 5, 0)]
    return points[-1], step / max(np.hypot(*step), 1e-6)


def _smooth(line: Line) -> Line:
    """Smooth a line, and leave its ends where they are."""
    points = line.points.copy()
    for _ in range(2):
        mean = 0.25 * (np.roll(points, 1, 0) + 2 * points + np.roll(points, -1, 0))
        if not line.closed:
            mean[[0, -1]] = points[[0, -1]]
        points = mean
    return Line(points, line.closed)


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
