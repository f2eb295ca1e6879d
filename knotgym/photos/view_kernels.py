"""Compiled measures of a rope in a photo, before anything of it is painted.

The curve and what follows from it are float32, lengths along it and limits float64, as each was
when pictures of a seed were first made. Places are counted in pieces: piece k leads from point k to
the next.

After a change run `pytest tests/photos/test_photo.py`.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Ids, kernel
from knotgym.rendering import count_regions
from knotgym.topology import CROSSING, strand_spacing, visited

Array = NDArray[Any]

_F = np.float32
_HALF, _ONE = _F(0.5), _F(1)
_FOLD = _F(-0.85)  # cosine of 148 degrees


@kernel
def tilted(points: Array, lean: Any, heading: Any) -> Array:
    """Return points in the axes of a camera that leans.

    Args:
        points: float64 (n, 3).
        lean, heading: cosine and sine of both angles.
    """
    turned, (ct, st), (c, s) = np.empty((len(points), 3)), lean, heading
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        # the direction of leaning is foreshortened, the one across it stays
        along, across = c * x + s * y, c * y - s * x
        shown = ct * along - st * z
        turned[i, 0], turned[i, 1] = c * shown - s * across, s * shown + c * across
        turned[i, 2] = st * along + ct * z
    return turned


@kernel
def extent(space: Array, kept: Array, c: float, s: float) -> tuple[Any, ...]:
    """Return the least and the largest x, and y down, of the kept points of a curve in a picture.

    Args:
        space: float64 (n, 3), metres.
        kept: bool (n,).
        c, s: cosine and sine of the picture's turn, times the scale.
    """
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    for i in range(len(space)):
        if kept[i]:
            x, y = c * space[i, 0] + s * space[i, 1], s * space[i, 0] - c * space[i, 1]
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
    return (left, right), (top, bottom)


@kernel
def trace(
    space: Array, kept: Array, table: Array, placed: Any, size: int, free: bool
) -> tuple[Any, ...]:
    """Lay a curve into a picture.

    Args:
        space: float64 (n, 3), metres.
        kept: bool (n,), pieces that there are.
        table: its crossings, that of `Crossings`.
        placed: cosine and sine of the picture's turn, times the scale; the scale; x and y of the
            middle.
        size: side of the picture, px.
        free: whether pieces that the picture's edge cuts aren't seen.

    Returns:
        curve: float32 (n, 3), px.
        along: float32 (n, 2), unit; direction at each point.
        walked: float64 (n + 1,), length of the drawing up to each point, and in total.
        seen: bool (n,), pieces.
        met: int64 (nx,), crossings that are seen, both pieces of them.
        visits: float64 (2 nx,), sorted places of the visits of these.
        order: int64 (2 nx,), where the sorted visits are among all upper and then all lower ones.
        lengths: float64 (2 nx,), of the drawing up to each visit.
        sines: float32 (nx,), of the angle at each crossing.
        after: int64 (n,), the point that each piece leads to; itself where there is none.
        apart, base: the smallest lengths between visits, and from the base to a visit; infinity
            without crossings.
    """
    n = len(space)
    c, s, scale, right, down = placed
    curve, step = np.empty((n, 3), np.float32), np.empty((n, 2), np.float32)
    along, walked = np.empty((n, 2), np.float32), np.empty(n + 1)
    inside, seen = np.empty(n, np.bool_), np.empty(n, np.bool_)
    for i in range(n):
        x, y = space[i, 0], space[i, 1]
        curve[i, 0], curve[i, 1] = c * x + s * y + right, s * x - c * y + down
        curve[i, 2] = scale * space[i, 2]
        x, y = curve[i, 0], curve[i, 1]
        inside[i] = 0 <= x < size and 0 <= y < size
    length = _F(0)
    walked[0] = 0.0
    for i in range(n):
        j = i + 1 - n  # after i, as negative indices wrap
        dx, dy = curve[j, 0] - curve[i, 0], curve[j, 1] - curve[i, 1]
        step[i, 0], step[i, 1] = dx, dy
        length += np.sqrt(dx * dx + dy * dy)
        walked[i + 1] = length
        seen[i] = kept[i] and (not free or (inside[i] and inside[j]))
    for i in range(n):
        # about twice the direction at each point
        dx, dy = step[i, 0] + step[i - 1, 0], step[i, 1] + step[i - 1, 1]
        norm = np.sqrt(dx * dx + dy * dy)
        along[i, 0], along[i, 1] = dx / norm, dy / norm
    met = np.empty(len(table), np.int64)
    count = 0
    for k in range(len(table)):
        if seen[int(table[k, CROSSING.over_place]) % n]:
            if seen[int(table[k, CROSSING.under_place]) % n]:
                met[count] = k
                count += 1
    met = met[:count]
    visits, order, lengths = np.empty(2 * count), np.empty(2 * count, np.int64), np.empty(2 * count)
    sines = np.empty(count, np.float32)
    for v in range(2 * count):
        column = CROSSING.over_place if v < count else CROSSING.under_place
        place, at = table[met[v % count], column], v
        while at and visits[at - 1] > place:  # insertion from behind, so that equal ones stay
            visits[at], order[at] = visits[at - 1], order[at - 1]
            at -= 1
        visits[at], order[at] = place, v
    for v in range(2 * count):
        k = int(visits[v])
        lengths[v] = walked[k]
        if k < n:
            lengths[v] += (walked[k + 1] - walked[k]) * (visits[v] - k)
    for k in range(count):
        a = along[int(table[met[k], CROSSING.over_place]) % n]
        b = along[int(table[met[k], CROSSING.under_place]) % n]
        sines[k] = abs(a[0] * b[1] - a[1] * b[0])
    after, apart, base = np.empty(n, np.int64), np.inf, np.inf
    for i in range(n):
        after[i] = i if not kept[i] else i + 1 if i + 1 < n else 0
    for v in range(2 * count):
        further = lengths[v + 1] if v + 1 < 2 * count else lengths[0] + walked[n]
        apart = min(apart, further - lengths[v])
        base = min(base, lengths[v], walked[n] - lengths[v])
    return curve, along, walked, seen, met, visits, order, lengths, sines, after, apart, base


@kernel
def is_folded(along: Array, walked: Array, seen: Array, width: float) -> bool:
    """Return whether the rope turns by 148 degrees or more within two widths.

    The arms of such a fold touch, and it can't be told from a small kink.

    Args:
        along, walked, seen: as `trace` returns them.
        width: of the rope, px.
    """
    n = len(along)
    for i in range(n):
        if seen[i]:
            # the piece two widths further along
            j = np.searchsorted(walked, (walked[i] + 2.0 * width) % walked[n]) - 1
            if along[i, 0] * along[j, 0] + along[i, 1] * along[j, 1] < _FOLD:
                return True
    return False


@kernel
def nearest_strand(curve: Array, table: Array, walk: float, most: float) -> float:
    """Return the smallest distance of points on different strands, px; see `strand_spacing`.

    Args:
        curve: as `trace` returns it.
        table: its crossings, that of `Crossings`.
        walk, most: px.
    """
    flat = np.empty((len(curve), 2))
    for i in range(len(curve)):
        flat[i, 0], flat[i, 1] = curve[i, 0], curve[i, 1]
    along, _, at = visited(flat, table)
    return strand_spacing(flat, along, at, walk, most)


@kernel
def regions(curve: Array, after: Array, near: Any, margin: Any, size: int) -> tuple[Any, ...]:
    """Count the regions beside the rope, in the part of a picture that the rope fills.

    Args:
        curve: as `trace` returns it.
        after: int64 (n,), the point that each piece leads to; k itself for no piece.
        near: squared distance, px, up to which a pixel is the rope's.
        margin: px around the rope's axis, so that the outside stays in one piece.
        size: side of the picture, px.

    Returns:
        How many there are, the smallest area, px, and uint8 (rows, columns), 1 where the rope is.
    """
    low, high = np.empty(2, np.int64), np.empty(2, np.int64)
    for axis in range(2):
        least = most = curve[0, axis]
        for i in range(len(curve)):
            least, most = min(least, curve[i, axis]), max(most, curve[i, axis])
        low[axis] = int(max(least - _F(margin) - _F(4), _F(0)))
        high[axis] = max(min(int(most + _F(margin) + _F(5)), size), low[axis])
    left, top, right, bottom = int(low[0]), int(low[1]), int(high[0]), int(high[1])
    canvas = np.zeros((bottom - top, (right - left + 7) & ~7), np.uint8)
    limit, reach = _F(near), np.sqrt(_F(near)) + _ONE
    for k in range(len(curve)):
        if after[k] == k:
            continue
        # as in `photo_kernels.stamp`, of both layers
        x, y = curve[k, 0], curve[k, 1]
        dx, dy = curve[after[k], 0] - x, curve[after[k], 1] - y
        inverse = _ONE / max(dx * dx + dy * dy, _F(1e-9))
        first, last = max(int(min(x, x + dx) - reach), left), int(max(x, x + dx) + reach) + 1
        above, below = max(int(min(y, y + dy) - reach), top), int(max(y, y + dy) + reach) + 1
        for row in range(above, min(below, bottom)):
            py = _F(row) + _HALF - y
            for column in range(first, min(last, right)):
                px = _F(column) + _HALF - x
                t = min(max((px * dx + py * dy) * inverse, _F(0)), _F(0.9999))
                ex, ey = px - t * dx, py - t * dy
                if ex * ex + ey * ey <= limit:
                    canvas[row - top, column - left] = 1
    count, least = count_regions(canvas, right - left)
    return count, least, canvas[:, : right - left]


@kernel
def beside(
    curve: Array, along: Array, seen: Array, square: Array, radius: float
) -> tuple[Ids, Ids]:
    """Return pixels on the rope, and on the background beside each, on both sides.

    Args:
        curve, along, seen: as `trace` returns them.
        square: float32 (2, size, size), as `photo_kernels.stamp` finds it.
        radius: of the rope, px.

    Returns:
        inner, outer: int64 (m, 2), column and row; of every other piece, first of one side.
    """
    n, size = len(curve), square.shape[1]
    inner, outer = np.empty((2 * n, 2), np.int64), np.empty((2 * n, 2), np.int64)
    limit, off, count = _F((radius + 1) * (radius + 1)), _F(radius + 1.5), 0
    for side in range(2):
        shown = 0
        for i in range(n):
            if not seen[i]:
                continue
            shown += 1
            if shown % 2 == 0:
                continue
            right, down = -off * along[i, 1], off * along[i, 0]
            x = curve[i, 0] + right if side else curve[i, 0] - right
            y = curve[i, 1] + down if side else curve[i, 1] - down
            column, row = int(x), int(y)
            if 0 <= column < size and 0 <= row < size:
                if min(square[0, row, column], square[1, row, column]) > limit:
                    inner[count, 0], inner[count, 1] = int(curve[i, 0]), int(curve[i, 1])
                    outer[count, 0], outer[count, 1] = column, row
                    count += 1
    return inner[:count], outer[:count]


@kernel
def crossing_pixels(
    curve: Array, along: Array, sines: Array, places: Array, radius: float, size: int
) -> tuple[Array, Ids]:
    """Find crossings in a picture, and pixels that tell which strand is over.

    Args:
        curve, along, sines: as `trace` returns them.
        places: float64 (nx, 2), of the upper and the lower strand.
        radius: of the rope, px.
        size: side of the picture, px.

    Returns:
        middles: float64 (nx, 2), px.
        pixels: int64 (9, nx, 2), column and row; three along the upper strand, and three of the
            lower one where it disappears, on one side and on the other.
    """
    n, nx = len(curve), len(places)
    middles, pixels = np.empty((nx, 2)), np.empty((9, nx, 2), np.int64)
    for k in range(nx):
        index = int(np.floor(places[k, 0]))
        part, a, b = places[k, 0] - index, index % n, int(places[k, 1]) % n
        for axis in range(2):
            middle = (1 - part) * curve[a, axis] + part * curve[(index + 1) % n, axis]
            middles[k, axis] = middle
            for row in range(9):
                if row < 3:
                    spot = middle + _F((row - 1) * 0.5 * radius) * along[a, axis]
                else:
                    off = radius + (0.4, 1.0, 1.6)[row % 3]
                    spot = middle + _F(-off if row < 6 else off) / sines[k] * along[b, axis]
                pixels[row, k, axis] = int(min(max(spot, 0), size - 1))
    return middles, pixels


@kernel
def distinct(pixels: Ids, size: int) -> Ids:
    """Leave out pixels, int64 (n, 2), that came before."""
    known, reached, count = np.zeros((size, size), np.bool_), np.empty_like(pixels), 0
    for k in range(len(pixels)):
        column, row = pixels[k, 0], pixels[k, 1]
        if not known[row, column]:
            known[row, column] = True
            reached[count, 0], reached[count, 1] = column, row
            count += 1
    return reached[:count]


@kernel
def shape(curve: Array, after: Array) -> tuple[Array, Array]:
    """Return the direction in space at each point, float32 (n, 3), and float64 (n + 1,), the length
    up to each point.

    Args:
        curve: float32 (n, 3), px.
        after: int64 (n,), the point that each piece leads to; k itself for no piece.
    """
    n, length, step = len(curve), np.empty(len(curve) + 1), np.empty(3, np.float32)
    tangent, total = np.zeros((n, 3), np.float32), _F(0)
    length[0] = 0.0
    for k in range(n):
        j = after[k]
        for axis in range(3):
            step[axis] = curve[j, axis] - curve[k, axis]
            tangent[k, axis] += step[axis]
            tangent[j, axis] += step[axis]
        total += np.sqrt(step[0] * step[0] + step[1] * step[1] + step[2] * step[2])
        length[k + 1] = total
    for k in range(n):
        x, y, z = tangent[k]
        norm = max(np.sqrt(x * x + y * y + z * z), _F(1e-6))
        for axis in range(3):
            tangent[k, axis] /= norm
    return tangent, length
