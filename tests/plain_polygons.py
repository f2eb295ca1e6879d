"""The polygons of a picture by whole-array arithmetic: what the compiled
`knotgym.rendering.rasterizer.polygons` must equal bit for bit.
"""

import numpy as np
from numpy.typing import NDArray

from knotgym.rendering.polygon_fill import SHIFT
from knotgym.rendering.rasterizer import _FAR, _PIECE_SPAN, _STEEP

_ROUND = np.array([-1.0, -2 / 3, -1 / 3, 0.0, 1 / 3, 2 / 3, 1.0])
_ARC = np.array([0.0, 0.25, 0.5, 0.75, 1.0, np.nan, np.nan])
_INNER = np.isnan(_ARC)


def polygons(
    pixels: NDArray[np.float64], height: NDArray[np.float64], radius: NDArray[np.float64], side: int
) -> tuple[NDArray[np.int32], NDArray[np.intp], NDArray[np.float64]]:
    """As `knotgym.rendering.rasterizer.polygons`."""
    along = np.roll(pixels, -1, axis=0) - pixels
    length = np.hypot(along[:, 0], along[:, 1])
    along = np.where(
        length[:, None] > 1e-9, along / np.maximum(length, 1e-9)[:, None], np.array([1.0, 0.0])
    )
    before = np.roll(along, 1, axis=0)
    # at points[i], from bead i - 1 to i
    turn = np.arctan2(
        before[:, 0] * along[:, 1] - before[:, 1] * along[:, 0], np.sum(before * along, axis=1)
    )

    climb = np.roll(height, -1) - height
    pieces = np.maximum(np.ceil(np.abs(climb) / _PIECE_SPAN), 1.0).astype(np.intp)
    bead = np.repeat(np.arange(len(pixels)), pieces)
    nth = np.arange(len(bead)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    start, stop = nth / pieces[bead], (nth + 1) / pieces[bead]
    after = (bead + 1) % len(pixels)

    # A piece's start is the end of the same piece walked backwards: the direction and the turn
    # change sign.
    head = _end(
        along[bead],
        radius[after],
        np.where(nth + 1 == pieces[bead], turn[after], 0.0),
        length[bead] / pieces[bead],
    )
    tail = _end(
        -along[bead],
        radius[bead],
        np.where(nth == 0, -turn[bead], 0.0),
        length[bead] / pieces[bead],
    )
    step = (along * length[:, None])[bead]
    head += (pixels[bead] + stop[:, None] * step)[:, None]
    tail += (pixels[bead] + start[:, None] * step)[:, None]
    corners = np.concatenate([head, tail], axis=1)

    # false for NaN
    seen = np.all((corners.max(axis=1) >= -1.0) & (corners.min(axis=1) <= side), axis=1)
    middle = height[bead] + 0.5 * (start + stop) * climb[bead]
    order = np.flatnonzero(seen)[np.argsort(middle[seen], kind="stable")]
    vertices = np.rint(np.clip(corners[order], -_FAR, _FAR) * 2**SHIFT).astype(np.int32)
    return vertices, bead[order], middle[order]


def _end(
    along: NDArray[np.float64],
    radius: NDArray[np.float64],
    turn: NDArray[np.float64],
    length: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The vertices of pieces' ends, from right to left, relative to the joint's pixel: shape
    (pieces, 7, 2).

    Args:
        along: unit vector out of the piece, shape (pieces, 2).
        turn: radians by which the next bead turns away, shape (pieces,); 0 ends the piece square.
        length: pixels of the piece, shape (pieces,).
    """
    half = 0.5 * np.abs(turn)
    angle = np.where(
        _INNER, 0.5 * np.pi, -0.5 * np.pi + half[:, None] * np.where(_INNER, 0.0, _ARC)
    )
    back = np.where(
        _INNER, np.minimum(radius * np.tan(np.minimum(half, 1.5)), 0.5 * length)[:, None], 0.0
    )
    right = (turn < 0.0)[:, None]
    angle, back = np.where(right, -angle[:, ::-1], angle), np.where(right, back[:, ::-1], back)
    rounded = (length < _STEEP * radius)[:, None]
    angle, back = np.where(rounded, 0.5 * np.pi * _ROUND, angle), np.where(rounded, 0.0, back)
    forward, sideways = radius[:, None] * np.cos(angle) - back, radius[:, None] * np.sin(angle)
    x, y = along[:, :1], along[:, 1:]
    return np.stack([forward * x - sideways * y, forward * y + sideways * x], axis=-1)
