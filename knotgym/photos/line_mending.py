"""Lines of ropes, mended: what was found twice, as one, or in pieces.

Flat crossings of two strands look like one strand, touching strands like two that bend away, and
gaps leave loose ends. Places are in cells, as in `strand_lines`.

After a change run `pytest tests/photos/test_rope_reader.py`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array

# Chosen as those of `strand_lines`, which needs the first five, too.
STEP, DARK = 3.0, 0.05  # a longer link, cells, has such a response in its middle, at least
CUT, CUT_APART = 3.5, 4.0  # of ends at the edge of the picture: from it, from each other, cells
BEND = 2.5  # cost of a turn of one radian, cells
# loose ends are joined over so many cells, if they turn by no more than so many radians together
_GAP, _TURN = 9.0, 1.2
_LIT = 0.25  # or if the response between them is so large everywhere, whatever the turn
# loose ends so near, cells, that face each other so well (cosine), while another line passes so
# near, cells, all the way between them: a flat crossing
_MERGED, _FACING, _BESIDE = 34.0, 0.5, 3.2
# Loose ends that so face each other over a gap of _MERGED, each so near, cells, to a line that
# passes between them, are a strand's under a wide rope.
_UNDER, _COVERED = 0.8, 9.0
# of lines that touch: distance, cells; points on either side; by how much less they bend, crossed
_TOUCH, _ARM, _BENT = 1.8, 6, 0.3
_TWIN, _PARALLEL = 2.5, 0.5  # a line so near to a longer one, and so parallel, cells and radians
_TWIN_SHARE = 0.6  # of its points, was found twice
_RIM = 5.0  # a line nowhere farther from an edge of the picture, cells, is no rope's
_FILLED = 0.7  # response between both sides of a closed line, of theirs, that is one rope's


class Line(NamedTuple):
    """The centre line of a strand: float64 (n, 2), cells; and whether it is closed."""

    points: Array
    closed: bool


def mended(lines: list[Line], response: NDArray[np.float32], frame: Array) -> list[Line]:
    """Drop, part, join, cross and drop lines, in this order, see `strand_lines.lines_in`.

    Args:
        response: float32 (h, w), the largest of each cell.
        frame: float64 (4,), edges of the picture.
    """
    lines = _exchanged(_joined(_parted(_alone(lines)), response, frame))
    return [line for line in lines if not _is_on_rim(line, frame)]


def _is_on_rim(line: Line, frame: Array) -> bool:
    """Tell whether a line never leaves one edge of the picture: that of a thing which it cuts."""
    return bool((np.abs(np.tile(line.points, 2) - frame).max(axis=0) < _RIM).any())


def one_way(line: Line, response: NDArray[np.float32]) -> Line:
    """Return half of a closed line that runs there and back on one wide rope."""
    if not line.closed:
        return line
    tip = int(np.hypot(*(line.points - line.points.mean(axis=0)).T).argmax())
    there, back = np.array_split(np.roll(line.points, -tip, 0), 2)
    back = back[np.hypot(*(there[:, None] - back[None]).transpose(2, 0, 1)).argmin(axis=1)]
    sides = np.minimum(response_at(response, there), response_at(response, back))
    filled = response_at(response, 0.5 * (there + back)) > _FILLED * sides
    return Line(there, False) if filled.mean() > _TWIN_SHARE else line


def smooth(line: Line) -> Line:
    """Smooth a line, and leave its ends where they are."""
    points = line.points.copy()
    for _ in range(2):
        mean = 0.25 * (np.roll(points, 1, 0) + 2 * points + np.roll(points, -1, 0))
        if not line.closed:
            mean[[0, -1]] = points[[0, -1]]
        points = mean
    return Line(points, line.closed)


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


def response_at(response: NDArray[np.float32], places: Array) -> NDArray[np.float32]:
    """Return the response, float32 (h, w), at places (n, 2), float32 (n,)."""
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
        splits = list[tuple[float, Array, Array, list[Line], Array, Array]]()
        ends = _loose_ends(lines)
        for i, (k, side, at, way) in enumerate(ends):
            for other, far, there, their in ends[:i]:
                gap = float(np.hypot(*(there - at)))
                ahead = (there - at) / max(gap, 1e-6)
                if 1.0 < gap < _MERGED and min(way @ ahead, -their @ ahead) > _FACING:
                    own = {(k, side), (other, far)}
                    if cut := _cut_between(lines, at, there, own):
                        splits.append((gap, at, there, *cut))
        if not splits:
            return lines
        _, a, b, lines, c, d = min(splits, key=lambda one: one[0])
        pairs = ((a, b), (c, d)) if _meet(a, b, c, d) or not _meet(a, d, c, b) else ((a, d), (c, b))
        for one, two in pairs:
            lines = _united(lines, _end_at(lines, one), _end_at(lines, two))


def _cut_between(
    lines: list[Line], at: Array, there: Array, mine: set[tuple[int, int]]
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
            if (k, side) in mine:
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
    cut = [Line(part, False) for part in parts]
    return [*lines[:k], *lines[k + 1 :], *cut], points[first - 1], points[last]


def _exchanged(lines: list[Line]) -> list[Line]:
    """Let lines cross where they touch and both bend away: so near, strands cross."""
    if not lines:
        return lines
    while True:
        points = np.concatenate([part.points for part in lines])
        owner = np.repeat(np.arange(len(lines)), [len(part.points) for part in lines])
        index = np.concatenate([np.arange(len(part.points)) for part in lines])
        size = np.array([len(part.points) for part in lines])[owner]
        room = np.array([part.closed for part in lines])[owner] & (size > 4 * _ARM)
        room |= (index >= _ARM) & (index < size - _ARM)
        away = np.abs(index[:, None] - index)
        alike = (owner[:, None] == owner) & (np.minimum(away, size - away) < 2 * _ARM)
        apart = np.hypot(*(points[:, None] - points).transpose(2, 0, 1))
        near = (apart < _TOUCH) & ~alike & room & room[:, None]
        meeting = np.argwhere(np.triu(near))
        for a, b in meeting[np.argsort(apart[tuple(meeting.T)])]:
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
            k = next(k for k, part in enumerate(lines) if (part.points == place).all(axis=1).any())
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


def _meet(a: Array, b: Array, c: Array, d: Array) -> NDArray[np.bool_]:
    """Tell whether segments from a to b cross those from c to d: places (..., 2), broadcast."""

    def side(p: Array, q: Array, r: Array) -> Array:
        (x, y), (u, v) = np.moveaxis(q - p, -1, 0), np.moveaxis(r - p, -1, 0)
        return np.asarray(x * v - y * u)

    parted = side(a, b, c) * side(a, b, d) < 0
    return np.asarray(parted & (side(c, d, a) * side(c, d, b) < 0))


def _end_at(lines: list[Line], place: Array) -> tuple[int, int]:
    """Return which line ends at a place, and at which side."""
    return next(
        (k, side) for k, line in enumerate(lines) for side in (0, 1)
        if not line.closed and np.array_equal(line.points[-side], place)
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
        joins = list[tuple[float, int, int]]()
        for i, (_, _, at, way) in enumerate(ends):
            for j, (_, _, there, their) in enumerate(ends[:i]):
                gap = np.hypot(*(there - at))
                turn = np.arccos(np.clip(way @ -their, -1, 1))
                cut = np.abs(np.concatenate([at, at]) - frame) < CUT
                cut &= np.abs(np.concatenate([there, there]) - frame) < CUT
                ahead = (there - at) / max(gap, 1e-6)
                faced = min(way @ ahead, -their @ ahead)
                if gap >= (CUT_APART if cut.any() else _GAP):
                    if gap < _MERGED and faced > _UNDER and _is_under(lines, at, there):
                        joins.append((gap + BEND * turn, i, j))
                    continue
                # each points at the other; or at a tight bend, where all directions are lit, the
                # response between them is that of a strand
                between = at + np.linspace(0, 1, 9)[:, None] * (there - at)
                # strands that leave the picture side by side are lit as well, but less
                least = response_at(response, between).min()
                dark = gap > STEP and least < DARK
                if (turn < _TURN and faced > 0.5 and not dark) or least > _LIT * (1 + cut.any()):
                    joins.append((gap + BEND * turn, i, j))
        if not joins:
            return lines
        one, other = (ends[index][:2] for index in min(joins)[1:])
        lines = _united(lines, one, other)


def _is_under(lines: list[Line], at: Array, there: Array) -> bool:
    """Tell whether a line passes between two places and near both."""
    for points, closed in lines:
        first, last = (points, np.roll(points, -1, 0)) if closed else (points[:-1], points[1:])
        near = [np.hypot(*(points - end).T).min() < _COVERED for end in (at, there)]
        if all(near) and _meet(at, there, first, last).any():
            return True
    return False


def _loose_ends(lines: list[Line]) -> list[tuple[int, int, Array, Array]]:
    """Return the loose ends: line, side, place and direction."""
    return [
        (k, side, *_loose_end(line, side))
        for k, line in enumerate(lines) if not line.closed for side in (0, 1)
    ]  # fmt: skip


def _loose_end(line: Line, side: int) -> tuple[Array, Array]:
    """Return where a line ends, at its start (0) or end (1), and the direction it leaves in."""
    points = line.points if side else line.points[::-1]
    step = points[-1] - points[max(len(points) - 5, 0)]
    return points[-1], step / max(np.hypot(*step), 1e-6)
