"""Compiled painting of many convex polygons, and averaging of the samples of a pixel.

`fill` paints the samples that OpenCV's `fillConvexPoly` paints (LINE_8, coordinates with SHIFT
fractional bits), and `shrink` averages as `cv2.resize` does with INTER_AREA, so that pictures keep
their bytes (`tests/rendering/test_polygon_fill.py`). They take a fifth of the time, because the
canvas holds one number per sample instead of a colour, and because neither a call per polygon nor
the interpreter's lock is needed.

OpenCV's rules, in fixed-point numbers with 16 fractional bits:

    outline    each edge is a line of one sample per column or row, whichever it crosses more of;
               the other coordinate advances by dy / dx in steps that are rounded towards zero
    inside     in each row, the samples between the left and the right edge, at the x that each has
               at the row's centre; an edge begins at its upper vertex, not at the row's centre

After a change run `pytest tests/rendering/test_polygon_fill.py`: fills must be OpenCV's, byte for
byte.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from knotgym.common import inner

# Fractions of a pixel as OpenCV takes them in its argument `shift`; all products below stay within
# int64.
SHIFT = 6  # coordinates are in units of 1 / 2**SHIFT pixels
_ONE = 1 << 16
_HALF = _ONE >> 1
_UP = 16 - SHIFT  # from given coordinates to 16 fractional bits


@numba.njit(cache=True, nogil=True)
def fill(canvas: NDArray[np.uint16], corners: NDArray[np.int32], value: int) -> None:
    """Paint a convex polygon.

    Args:
        canvas: uint16 (rows, columns); changed.
        corners: int32 (n, 2), x and y of the vertices in units of 1 / 2**SHIFT pixels.
        value: what its samples become.
    """
    n, (rows, columns) = len(corners), canvas.shape
    top = 0
    bottom = corners[0, 1]
    for i in range(n):
        before = i - 1 if i else n - 1
        # a repeated corner would be a line without a direction
        if corners[i, 0] != corners[before, 0] or corners[i, 1] != corners[before, 1]:
            _line(
                canvas,
                int(corners[before, 0]) << _UP,
                int(corners[before, 1]) << _UP,
                int(corners[i, 0]) << _UP,
                int(corners[i, 1]) << _UP,
                value,
            )
        if corners[i, 1] < corners[top, 1]:
            top = i
        bottom = max(bottom, corners[i, 1])
    y, last = _row(corners[top, 1]), min(_row(bottom), rows - 1)
    # Both chains of edges run down from the top vertex, chain 0 forwards and chain 1 backwards
    # through the corners. `at` is the corner at which a chain's current edge begins, `ends` the row
    # in which it ends, `x` where it is in the current row.
    at_0, at_1, ends_0, ends_1 = top, top, y, y
    # nowhere yet: the first row sets both
    x_0 = x_1 = -_ONE
    slope_0 = slope_1 = 0
    left = n  # edges that neither chain has come to
    while y <= last:
        if y >= ends_0:
            at_0, ends_0, x_0, slope_0, left = _next_edge(
                corners, at_0, 1, y, ends_0, x_0, slope_0, left
            )
        if y >= ends_1:
            at_1, ends_1, x_1, slope_1, left = _next_edge(
                corners, at_1, n - 1, y, ends_1, x_1, slope_1, left
            )
        # both chains have met: the polygon is below this row no more
        if left < 0:
            break
        if y >= 0:
            # rounded to the nearest sample, both ends included; a convex polygon has one stretch a
            # row
            first = max((min(x_0, x_1) + _HALF) >> 16, 0)
            final = min((max(x_0, x_1) + _HALF) >> 16, columns - 1)
            for x in range(first, final + 1):
                canvas[y, x] = value
        x_0 += slope_0
        x_1 += slope_1
        y += 1


@inner
def _row(y: int) -> int:
    """Return the row that a coordinate rounds to."""
    return (y + (1 << SHIFT >> 1)) >> SHIFT


@inner
def _next_edge(
    corners: NDArray[np.int32],
    at: int,
    step: int,
    y: int,
    ends: int,
    x: int,
    slope: int,
    left: int,
) -> tuple[int, int, int, int, int]:
    """Find the next edge of a chain that ends below row y.

    Returns:
        at, ends, x, slope and left of `fill`; left is -1 if no such edge is left.
    """
    n = len(corners)
    start, end = at, (at + step) % n
    while left > 0:
        left -= 1
        # edges that end in the row where they begin are passed over: the outline has painted them
        row = _row(corners[end, 1])
        if row > y:
            x = int(corners[start, 0]) << _UP
            # dx for each row; the row count is that of the rounded rows, as in OpenCV
            across = (int(corners[end, 0]) << _UP) - x
            # half a unit is added, for rounding
            return end, row, x, _quotient(2 * across + (row - y), 2 * (row - y)), left
        start, end = end, (end + step) % n
    return at, ends, x, slope, -1


@inner
def _quotient(a: int, b: int) -> int:
    """Divide, rounding towards zero as C does."""
    quotient = abs(a) // abs(b)
    return quotient if (a < 0) == (b < 0) else -quotient


@inner
def _line(canvas: NDArray[np.uint16], x: int, y: int, x_end: int, y_end: int, value: int) -> None:
    """Paint a line; coordinates have 16 fractional bits."""
    rows, columns = canvas.shape
    right, bottom = (columns << 16) - 1, (rows << 16) - 1
    if min(x, x_end) < 0 or max(x, x_end) > right or min(y, y_end) < 0 or max(y, y_end) > bottom:
        inside, x, y, x_end, y_end = _clipped(x, y, x_end, y_end, right, bottom)
        if not inside:
            return
    # `along` is the axis that the line crosses more of; the line runs in its positive direction
    flat = abs(x_end - x) > abs(y_end - y)
    if (flat and x_end < x) or (not flat and y_end < y):
        x, y, x_end, y_end = x_end, y_end, x, y
    # the last sample by itself: rounded slopes may end one beside it
    _put(canvas, (x_end + _HALF) >> 16, (y_end + _HALF) >> 16, value)
    if flat:
        # `| 1` is OpenCV's way round a division by zero
        slope, count = _quotient((y_end - y) << 16, (x_end - x) | 1), (x_end - x) >> 16
        column, y = (x + _HALF) >> 16, y + _HALF
        for k in range(count + 1):
            _put(canvas, column + k, y >> 16, value)
            y += slope
    else:
        slope, count = _quotient((x_end - x) << 16, (y_end - y) | 1), (y_end - y) >> 16
        row, x = (y + _HALF) >> 16, x + _HALF
        for k in range(count + 1):
            _put(canvas, x >> 16, row + k, value)
            x += slope


@inner
def _put(canvas: NDArray[np.uint16], x: int, y: int, value: int) -> None:
    # rounding may lead one sample out of the canvas
    if 0 <= x < canvas.shape[1] and 0 <= y < canvas.shape[0]:
        canvas[y, x] = value


@inner
def _outside(x: int, right: int) -> int:
    """Return -1, 0 or 1: before, within or beyond [0, right]."""
    return (x > right) - (x < 0)


@inner
def _clipped(
    x: int, y: int, x_end: int, y_end: int, right: int, bottom: int
) -> tuple[bool, int, int, int, int]:
    """Clip a line to [0, right] x [0, bottom], first in y and then in x (Cohen and Sutherland).

    Returns:
        Whether anything of it is inside, and its ends.
    """
    none = False, x, y, x_end, y_end
    # both ends on one side: nothing is inside
    for one, other in (
        (_outside(x, right), _outside(x_end, right)),
        (_outside(y, bottom), _outside(y_end, bottom)),
    ):
        if one != 0 and one == other:
            return none
    if _outside(y, bottom) != 0:
        edge = 0 if y < 0 else bottom
        # where the line meets the edge, rounded towards zero as C divides
        x += _quotient((edge - y) * (x_end - x), y_end - y)
        y = edge
    if _outside(y_end, bottom) != 0:
        edge = 0 if y_end < 0 else bottom
        x_end += _quotient((edge - y_end) * (x_end - x), y_end - y)
        y_end = edge
    if _outside(x, right) != 0 and _outside(x, right) == _outside(x_end, right):
        return none
    if _outside(x, right) != 0:
        edge = 0 if x < 0 else right
        y += _quotient((edge - x) * (y_end - y), x_end - x)
        x = edge
    if _outside(x_end, right) != 0:
        edge = 0 if x_end < 0 else right
        y_end += _quotient((edge - x_end) * (y_end - y), x_end - x)
        x_end = edge
    return True, x, y, x_end, y_end


@numba.njit(cache=True, nogil=True)
def shrink(
    canvas: NDArray[np.uint16],
    factor: int,
    colours: NDArray[np.uint8],
    levels: NDArray[np.uint8],
    out: NDArray[np.uint8],
) -> None:
    """Average the samples of each pixel.

    Args:
        canvas: uint16 (factor rows, factor columns), numbers of colours.
        factor: samples along each side of a pixel, at most 8.
        colours: uint8 (n, 3).
        levels: uint8 (n,), the depth of each number; a pixel gets the largest of its samples.
        out: uint8 (rows, columns, 3 or 4), the fourth for depth; already the colour and level of
            number 0; output.
    """
    # wide enough for sums of 64 bytes; reused for every pixel
    block = np.empty((8, 8, 3), np.int64)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            top, left = factor * row, factor * column
            first = canvas[top, left]
            # most pixels are uniform; those of the background are right already
            if _uniform(canvas[top : top + factor, left : left + factor]):
                if first > 0:
                    for c in range(3):
                        out[row, column, c] = colours[first, c]
                    if out.shape[2] == 4:
                        out[row, column, 3] = levels[first]
                continue
            deepest = 0
            for i in range(factor):
                for j in range(factor):
                    sample = canvas[top + i, left + j]
                    deepest = max(deepest, levels[sample])
                    for c in range(3):
                        block[i, j, c] = colours[sample, c]
            _average(block, factor)
            for c in range(3):
                out[row, column, c] = block[0, 0, c]
            if out.shape[2] == 4:
                out[row, column, 3] = deepest


@inner
def _uniform(block: NDArray[np.uint16]) -> bool:
    """Return whether the samples of a pixel are equal."""
    rows, columns = block.shape
    first = block[0, 0]
    for i in range(rows):
        for j in range(columns):
            if block[i, j] != first:
                return False
    return True


@inner
def _average(block: NDArray[np.int64], width: int) -> None:
    """Average block[:width, :width] into block[0, 0]: halve it while possible, rounding each time.

    Halving rounds half up, and a block of odd width half to even, as OpenCV does.
    """
    while width % 2 == 0:
        width //= 2
        for i in range(width):
            for j in range(width):
                for c in range(3):
                    # (a + b + c + d + 2) / 4: the nearest whole number, halves up
                    upper = block[2 * i, 2 * j, c] + block[2 * i, 2 * j + 1, c]
                    lower = block[2 * i + 1, 2 * j, c] + block[2 * i + 1, 2 * j + 1, c]
                    block[i, j, c] = (upper + lower + 2) >> 2
    if width > 1:
        for c in range(3):
            total = 0
            for i in range(width):
                for j in range(width):
                    total += block[i, j, c]
            # in float32 and by the reciprocal, as OpenCV computes an odd block
            mean = np.float32(total) * np.float32(1.0 / (width * width))
            block[0, 0, c] = np.int64(np.rint(mean))
