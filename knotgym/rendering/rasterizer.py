"""Convex polygons that make up a drawn rope, and the painting of many ropes.

Each bead is cut across into equal pieces, as many as its span of heights requires. Where two beads
meet, each ends at the bisector of the joint, as the capsules do. Neighbours then neither overlap
nor leave a gap, and the order of painting them doesn't matter.

After a change run `pytest tests/rendering` and `python benchmarks/truth.py`: pictures must be
OpenCV's byte for byte, and the strand on top the one labelled over.
"""

from typing import Any, NamedTuple

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from knotgym.common import inner
from knotgym.rendering.polygon_fill import SHIFT, fill, shrink

# Painter's algorithm: pieces of beads are painted from the lowest to the highest, each at the
# height of its midpoint. That is the true order at every crossing of a rope whose capsules sink
# into each other by 2 mm at most: two axes that cross in the picture are then at least
# 2 * 5 - 2 = 8 mm apart in height, while a piece that spans at most this height never leaves its
# midpoint's by more than 3.35 mm; 2 * 3.35 < 8. Under the perspective camera the same holds with
# "distance to the camera along the line of sight" for "height".
_PIECE_SPAN = 0.0067

# Coordinates are clipped to this many pixels, so that their differences fit OpenCV's int32 after
# the shift: 2 * 2**23 * 2**6 = 2**30.
_FAR = 2.0**23
# OpenCV fills a convex polygon including its outline, so that it comes out this many pixels wider;
# radii are reduced by as much.
EDGE = 0.48
# Pieces that are seen nearly end-on, and so appear shorter than this many radii, get round ends.
_STEEP = 1.0
# Every piece is a polygon of 14 vertices, 7 for each end, whatever the shape of the end:
#
#     mitred   between two beads: 5 vertices on an arc on the outer side of the turn, from the
#              perpendicular of one bead to the bisector of the joint, and the inner corner, twice
#     square   within a bead: the two corners, repeated
#     round    7 vertices on a half circle
#
# _ARC: positions on the arc of a mitred end, as fractions of half the turn. _SQUARE: cosine and
# sine of the right and of the left corner. _CAP: cosines and sines of the vertices of a round end.
_ARC = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
_SQUARE = np.array([[np.cos(angle), np.sin(angle)] for angle in (-0.5 * np.pi, 0.5 * np.pi)])
_CAP = np.stack(
    [
        wave(0.5 * np.pi * np.array([-1.0, -2 / 3, -1 / 3, 0.0, 1 / 3, 2 / 3, 1.0]))
        for wave in (np.cos, np.sin)
    ]
)


class _Ropes(NamedTuple):
    """m ropes of n beads on the canvas, and the joints where bead i begins.

    Attributes:
        pixels: (m, n, 2), start of bead i, in OpenCV's convention (pixel centres at whole numbers).
        height: (m, n), of the same points, metres.
        radius: (m, n), pixels, less EDGE.
        length: (m, n), of bead i, pixels.
        along: (m, n, 2), its direction, a unit vector.
        turn: (m, n), angle from bead i - 1 to bead i, to the left, radians.
        tan: (m, n), of half of it; the inner corner is cut back by radius * tan.
        cos, sin: (m, n, 5), of the angles of the arc of a mitred end, see _ARC, in the frame of the
            bead: from its right perpendicular to the bisector.
    """

    pixels: NDArray[np.float64]
    height: NDArray[np.float64]
    radius: NDArray[np.float64]
    length: NDArray[np.float64]
    along: NDArray[np.float64]
    turn: NDArray[np.float64]
    tan: NDArray[np.float64]
    cos: NDArray[np.float64]
    sin: NDArray[np.float64]


def polygons(
    pixels: NDArray[np.float64], height: NDArray[np.float64], radius: NDArray[np.float64], side: int
) -> tuple[NDArray[np.int32], NDArray[np.intp], NDArray[np.float64]]:
    """Cut the beads into convex polygons, in the order in which to paint them.

    Args:
        pixels: (n, 2), start of bead i on the canvas, in OpenCV's convention (pixel centres at
            whole numbers).
        height: (n,), height of the same points, metres.
        radius: (n,), pixels, less EDGE.
        side: side of the canvas, pixels; pieces outside it are left out.

    Returns:
        int32 (pieces, 14, 2), vertices in 1/2**SHIFT pixels; (pieces,), the bead that each piece
        belongs to; and (pieces,), the height of its middle, metres.
    """
    # a kernel is compiled again for arrays that aren't contiguous
    ropes = _ropes(pixels[None], np.ascontiguousarray(height)[None], radius[None])
    corners, bead, middle = _pieces(ropes, 0, side)
    order = np.argsort(middle, kind="stable")
    return corners[order], bead[order], middle[order]


def paint(
    pixels: NDArray[np.float64],
    height: NDArray[np.float64],
    radius: NDArray[np.float64],
    factor: int,
    colours: NDArray[np.uint8],
    depths: tuple[float, float],
    out: NDArray[np.uint8],
    top: int,
    size: int,
) -> None:
    """Paint m ropes; compiled, and without the interpreter's lock.

    Args:
        pixels: (m, n, 2), as in `polygons`.
        height, radius: (m, n), as in `polygons`.
        factor: samples along each side of a pixel.
        colours: uint8 (1 + n, 3), the background's and the beads'.
        depths: height of the middle of the range of depths, and its length, metres.
        out: uint8 (m, rows, columns, 3 or 4), contiguous, or the kernel is compiled again; output.
        top, size: the square of `size` pixels from row `top` and column 0 on is painted; it is
            already the background.
    """
    canvas = np.zeros((factor * size, factor * size), dtype=np.uint16)
    _paint(_ropes(pixels, height, radius), factor, colours, depths, canvas, out, top, size)


def _ropes(
    pixels: NDArray[np.float64], height: NDArray[np.float64], radius: NDArray[np.float64]
) -> _Ropes:
    """Compute the joints of ropes.

    Angles and their functions are computed by NumPy, because compiled code may round them
    differently; the bytes are then the same with and without compilation.
    """
    step = np.roll(pixels, -1, axis=1) - pixels
    length = np.hypot(step[..., 0], step[..., 1])
    # a bead seen exactly end-on has no direction; any will do
    along = np.where(
        length[..., None] > 1e-9, step / np.maximum(length, 1e-9)[..., None], np.array([1.0, 0.0])
    )
    before = np.roll(along, 1, axis=1)
    turn = np.arctan2(
        before[..., 0] * along[..., 1] - before[..., 1] * along[..., 0],
        before[..., 0] * along[..., 0] + before[..., 1] * along[..., 1],
    )
    half = 0.5 * np.abs(turn)
    arc = -0.5 * np.pi + half[..., None] * _ARC
    tan = np.tan(np.minimum(half, 1.5))  # 1.5 keeps it finite
    return _Ropes(pixels, height, radius, length, along, turn, tan, np.cos(arc), np.sin(arc))


def average(canvas: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Average the samples of each pixel.

    Args:
        canvas: uint8, shape (rows, columns, 3).
        factor: samples along each side of a pixel.

    Returns:
        uint8, shape (rows / factor, columns / factor, 3).
    """
    while factor % 2 == 0:  # halving twice is three times as fast as one reduction by four
        canvas = _resized(canvas, 2)
        factor //= 2
    return canvas if factor == 1 else _resized(canvas, factor)


def _resized(canvas: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    rows, columns = canvas.shape[0] // factor, canvas.shape[1] // factor
    return np.asarray(
        cv2.resize(canvas, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8
    )


@numba.njit(cache=True, nogil=True)
def _paint(
    ropes: _Ropes,
    factor: int,
    colours: NDArray[np.uint8],
    depths: tuple[float, float],
    canvas: NDArray[np.uint16],
    out: NDArray[np.uint8],
    top: int,
    size: int,
) -> None:
    """Paint ropes one after the other; see `paint`. The canvas is zero before and after."""
    depth_middle, depth_span = depths
    for k in range(len(out)):
        corners, bead, middle = _pieces(ropes, k, len(canvas))
        pieces = len(bead)
        if pieces == 0:
            continue
        order = _rising(middle)
        # number p + 1 on the canvas is the piece p, 0 the background
        shades, levels = np.empty((pieces + 1, 3), np.uint8), np.zeros(pieces + 1, np.uint8)
        low, high = np.empty(2, np.int64), np.empty(2, np.int64)
        for axis in range(2):
            low[axis] = high[axis] = corners[0, 0, axis]
        for c in range(3):
            shades[0, c] = colours[0, c]
        for p in range(pieces):
            for c in range(3):
                shades[p + 1, c] = colours[bead[p] + 1, c]
            near = min(max(0.5 + (middle[p] - depth_middle) / depth_span, 0.0), 1.0)
            levels[p + 1] = np.uint8(1 + np.rint(254.0 * near))
            for corner in range(14):
                for axis in range(2):
                    low[axis] = min(low[axis], corners[p, corner, axis])
                    high[axis] = max(high[axis], corners[p, corner, axis])
        for p in order:
            fill(canvas, corners[p], p + 1)
        # only the pixels that the polygons touch, and one more on each side
        for axis in range(2):
            low[axis] = max((low[axis] >> SHIFT) // factor - 1, 0)
            high[axis] = min(((high[axis] + 1) >> SHIFT) // factor + 2, size)
        samples = canvas[factor * low[1] : factor * high[1], factor * low[0] : factor * high[0]]
        square = out[k, top : top + size]
        shrink(samples, factor, shades, levels, square[low[1] : high[1], low[0] : high[0]])
        for row in range(samples.shape[0]):
            for column in range(samples.shape[1]):
                samples[row, column] = 0


@inner
def _rising(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Sort by insertion, stably; return the order. `np.argsort` takes 2 s to compile."""
    order = np.empty(len(values), np.int64)
    for i in range(len(values)):
        at = i
        while at > 0 and values[order[at - 1]] > values[i]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = i
    return order


@numba.njit(cache=True, nogil=True)
def _pieces(ropes: _Ropes, k: int, side: int) -> Any:
    """Compute the pieces of rope k that are in the picture, bead after bead.

    Returns:
        corners int32 (m, 14, 2); bead (m,); height of the middle (m,), metres.
    """
    pixels, height, length, along = (
        ropes.pixels[k],
        ropes.height[k],
        ropes.length[k],
        ropes.along[k],
    )
    turn = ropes.turn[k]
    n = len(pixels)
    # an upper bound on the number of pieces, to allocate once
    most = 0
    for i in range(n):
        most += int(max(np.ceil(abs(height[(i + 1) % n] - height[i]) / _PIECE_SPAN), 1.0))
    corners = np.empty((most, 14, 2), np.int32)
    bead, middle = np.empty(most, np.intp), np.empty(most)
    own = np.empty((14, 2))
    m = 0
    for i in range(n):
        after = (i + 1) % n
        climb = height[after] - height[i]
        count = int(max(np.ceil(abs(climb) / _PIECE_SPAN), 1.0))
        x, y, each = along[i, 0], along[i, 1], length[i] / count
        for nth in range(count):
            start, stop = nth / count, (nth + 1) / count
            # The start of a piece is the end of the same piece traversed backwards, where the
            # direction and the turn change sign. Only the first and the last piece of a bead touch
            # a joint. own[:7] goes from right to left at the end and own[7:] from right to left
            # seen backwards, so that together they go round the polygon once.
            last, begin = nth + 1 == count, nth == 0
            _end(ropes, k, after, x, y, turn[after] if last else 0.0, each, last, own[:7])
            _end(ropes, k, i, -x, -y, -turn[i] if begin else 0.0, each, begin, own[7:])
            # Shift to the canvas; keep the piece if its bounding box meets the canvas and no
            # coordinate is NaN (which means behind the perspective camera).
            seen = True
            for axis in range(2):
                step = along[i, axis] * length[i]
                low, high = np.inf, -np.inf
                for c in range(14):
                    own[c, axis] += pixels[i, axis] + (stop if c < 7 else start) * step
                    low, high = min(low, own[c, axis]), max(high, own[c, axis])
                    seen &= not np.isnan(own[c, axis])
                seen &= high >= -1.0 and low <= side
            if seen:
                for c in range(14):
                    for axis in range(2):
                        corners[m, c, axis] = np.int32(
                            np.rint(min(max(own[c, axis], -_FAR), _FAR) * 2**SHIFT)
                        )
                bead[m], middle[m] = i, height[i] + 0.5 * (start + stop) * climb
                m += 1
    return corners[:m], bead[:m], middle[:m]


@inner
def _end(
    ropes: _Ropes,
    rope: int,
    joint: int,
    x: float,
    y: float,
    turn: float,
    length: float,
    is_joint: bool,
    out: NDArray[np.float64],
) -> None:
    """Write the 7 vertices of one end of a piece, from right to left.

    Args:
        ropes, rope, joint: the bead's end at which the piece lies, or which it approaches.
        x, y: unit vector along the piece, out of this end.
        turn: angle by which the next bead turns to the left, radians; 0 at a square end.
        length: length of the piece, pixels.
        is_joint: whether another bead follows; else the end is within the bead.
        out: shape (7, 2), pixels relative to the end of the axis; output.
    """
    radius = ropes.radius[rope, joint]
    # Polar coordinates (c, s) about the end of the axis, angle 0 along (x, y). A right turn is a
    # left turn mirrored: the vertices in reverse order (`at`) and the sine negated.
    rounded, right = length < _STEEP * radius, turn < 0.0
    for k in range(7):
        at = 6 - k if right else k
        back = 0.0
        if rounded:
            c, s = _CAP[0, k], _CAP[1, k]
        elif at > 4:
            # the inner corner, on the bisector: it lies back from the end by radius * tan, but by
            # no more than half the piece, where the other end's corner may be
            c, s = _SQUARE[1]
            back = np.minimum(radius * (ropes.tan[rope, joint] if is_joint else 0.0), 0.5 * length)
        elif is_joint:
            c, s = ropes.cos[rope, joint, at], ropes.sin[rope, joint, at]
        else:
            c, s = _SQUARE[0]
        if right and not rounded:
            s = -s
        forward, sideways = radius * c - back, radius * s
        out[k, 0] = forward * x - sideways * y
        out[k, 1] = forward * y + sideways * x
