"""Outlines of a drawn rope, its beads cut into convex polygons; and samples gathered to pixels.

Each bead is cut across into as many equal pieces as its span of heights asks for. Where two beads
meet, each ends at the bisector of the joint, as the capsules themselves do, so that neighbours
neither overlap nor gape and the order of painting them does not matter.
"""

from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

# Painter's algorithm: pieces of beads are painted from the lowest to the highest, each at the
# height of its midpoint. That is the true order at every crossing of a rope whose capsules sink
# into each other by 2 mm at most: two axes that cross in the picture are then at least
# 2 * 5 - 2 = 8 mm apart in height, while a piece that spans at most this height never leaves its
# midpoint's by more than 3.35 mm; 2 * 3.35 < 8. Under the perspective camera the same holds with
# "distance to the camera along the line of sight" for "height".
_PIECE_SPAN = 0.0067

SHIFT = 6  # OpenCV takes coordinates in 1/2**SHIFT pixels
# pixels; coordinates are held inside this, so that their differences fit OpenCV's int32 after SHIFT
_FAR = 2.0**23
# pixels by which OpenCV's convex polygons, which own their outline, come out wider than the polygon
EDGE = 0.48
# pieces seen so nearly end-on that they appear shorter than this many radii get round ends
_STEEP = 1.0
# The vertices of one end of a piece: a mitred end, where the rope turns left, is cut along the
# bisector of the joint, with a short arc on the outer side and one corner, given twice, on the
# inner side; _ARC is where on the arc, of half the turn. Cosines and sines of the two corners of a
# square end, and of the vertices of a round one, from right to left:
_ARC = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
_SQUARE = np.array([[np.cos(angle), np.sin(angle)] for angle in (-0.5 * np.pi, 0.5 * np.pi)])
_CAP = np.stack(
    [
        wave(0.5 * np.pi * np.array([-1.0, -2 / 3, -1 / 3, 0.0, 1 / 3, 2 / 3, 1.0]))
        for wave in (np.cos, np.sin)
    ]
)


def polygons(
    pixels: NDArray[np.float64], height: NDArray[np.float64], radius: NDArray[np.float64], side: int
) -> tuple[NDArray[np.int32], NDArray[np.intp], NDArray[np.float64]]:
    """The pieces of the beads as convex polygons, in the order in which to paint them.

    Args:
        pixels: (n, 2), where bead i starts on the canvas, OpenCV's convention (centres at whole
            numbers).
        height: (n,), metres, of the same points.
        radius: (n,), pixels, less EDGE.
        side: of the canvas, pixels; what lies outside isn't returned.

    Returns:
        int32 (pieces, 14, 2), vertices in 1/2**SHIFT pixels; and for each the bead it belongs to
        and the height of its middle, metres, (pieces,) both.
    """
    # What compiled code might round differently (angles and their functions) is NumPy's, so that
    # the bytes are the same with or without it.
    step = np.roll(pixels, -1, axis=0) - pixels
    length = np.hypot(step[:, 0], step[:, 1])
    along, sine, cosine = _directions(step, length)
    turn = np.arctan2(sine, cosine)  # at points[i], from bead i - 1 to i
    half = 0.5 * np.abs(turn)
    arc = -0.5 * np.pi + half[:, None] * _ARC
    corners, bead, middle = _pieces(
        pixels,
        height,
        radius,
        length,
        along,
        turn,
        np.tan(np.minimum(half, 1.5)),
        np.cos(arc),
        np.sin(arc),
        _SQUARE,
        _CAP,
        side,
    )
    order = np.argsort(middle, kind="stable")
    return corners[order], bead[order], middle[order]


def average(canvas: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Average the samples of each pixel.

    Args:
        canvas: uint8, shape (rows, columns, 3).
        factor: samples along each side of a pixel.

    Returns:
        uint8, shape (rows / factor, columns / factor, 3).
    """
    while factor % 2 == 0:  # halving twice is three times as fast as quartering
        canvas = _shrink(canvas, 2)
        factor //= 2
    return canvas if factor == 1 else _shrink(canvas, factor)


def nearest(canvas: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """The greatest of the samples of each pixel.

    Args:
        canvas: uint8, shape (rows, columns).
        factor: samples along each side of a pixel.

    Returns:
        uint8, shape (rows / factor, columns / factor).
    """
    for axis in (0, 1):
        lines = np.moveaxis(canvas, axis, 0)
        most = np.maximum.reduce([lines[k::factor] for k in range(factor)])
        canvas = np.moveaxis(most, 0, axis)
    return canvas


def _shrink(canvas: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    rows, columns = canvas.shape[0] // factor, canvas.shape[1] // factor
    return np.asarray(
        cv2.resize(canvas, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8
    )


@numba.njit(cache=True, nogil=True)
def _directions(step: NDArray[np.float64], length: NDArray[np.float64]) -> Any:
    """Unit vectors of the beads (n, 2), sine and cosine (n,) of the turns at their starts."""
    n = len(step)
    along, sine, cosine = np.empty((n, 2)), np.empty(n), np.empty(n)
    for i in range(n):
        for axis in range(2):
            along[i, axis] = (
                step[i, axis] / max(length[i], 1e-9) if length[i] > 1e-9 else 1.0 - axis
            )
    for i in range(n):
        x, y = along[i - 1]
        sine[i] = x * along[i, 1] - y * along[i, 0]
        cosine[i] = x * along[i, 0] + y * along[i, 1]
    return along, sine, cosine


@numba.njit(cache=True, nogil=True)
def _pieces(
    pixels: NDArray[np.float64],
    height: NDArray[np.float64],
    radius: NDArray[np.float64],
    length: NDArray[np.float64],
    along: NDArray[np.float64],
    turn: NDArray[np.float64],
    tan: NDArray[np.float64],
    cos: NDArray[np.float64],
    sin: NDArray[np.float64],
    square: NDArray[np.float64],
    cap: NDArray[np.float64],
    side: int,
) -> Any:
    """The pieces in the picture, bead after bead.

    Returns:
        corners int32 (m, 14, 2), bead (m,), height of the middle (m,).
    """
    n = len(pixels)
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
            # A piece's start is the end of the same piece walked backwards: the direction and the
            # turn change sign.
            last, begin = nth + 1 == count, nth == 0
            _end(
                x,
                y,
                radius[after],
                turn[after] if last else 0.0,
                each,
                tan[after],
                cos[after],
                sin[after],
                last,
                square,
                cap,
                own[:7],
            )
            _end(
                -x,
                -y,
                radius[i],
                -turn[i] if begin else 0.0,
                each,
                tan[i],
                cos[i],
                sin[i],
                begin,
                square,
                cap,
                own[7:],
            )
            seen = True
            for axis in range(2):
                step = along[i, axis] * length[i]
                low, high = np.inf, -np.inf
                for k in range(14):
                    own[k, axis] += pixels[i, axis] + (stop if k < 7 else start) * step
                    low, high = min(low, own[k, axis]), max(high, own[k, axis])
                    seen &= not np.isnan(own[k, axis])
                seen &= high >= -1.0 and low <= side
            if seen:
                for k in range(14):
                    for axis in range(2):
                        corners[m, k, axis] = np.int32(
                            np.rint(min(max(own[k, axis], -_FAR), _FAR) * 2**SHIFT)
                        )
                bead[m], middle[m] = i, height[i] + 0.5 * (start + stop) * climb
                m += 1
    return corners[:m], bead[:m], middle[:m]


@numba.njit(cache=True, nogil=True)
def _end(
    x: float,
    y: float,
    radius: float,
    turn: float,
    length: float,
    tan: float,
    cos: NDArray[np.float64],
    sin: NDArray[np.float64],
    joint: bool,
    square: NDArray[np.float64],
    cap: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Write the vertices of a piece's end, from right to left, from the joint's pixel: out (7, 2).

    Args:
        x, y: unit vector out of the piece.
        turn: radians by which the next bead turns away; 0 ends the piece square.
        length: pixels of the piece.
        tan: of half the turn.
        cos, sin: shape (5,), of the angles of the arc.
        joint: another bead follows, so that tan, cos and sin count.
        square: cosine and sine of the right and of the left corner of a square end, shape (2, 2).
        cap: those of the vertices of a round end, shape (2, 7).
    """
    rounded, right = length < _STEEP * radius, turn < 0.0
    for k in range(7):
        at = 6 - k if right else k
        back = 0.0
        if rounded:
            c, s = cap[0, k], cap[1, k]
        elif at > 4:
            c, s = square[1]
            back = np.minimum(radius * (tan if joint else 0.0), 0.5 * length)
        elif joint:
            c, s = cos[at], sin[at]
        else:
            c, s = square[0]
        if right and not rounded:
            s = -s
        forward, sideways = radius * c - back, radius * s
        out[k, 0] = forward * x - sideways * y
        out[k, 1] = forward * y + sideways * x
