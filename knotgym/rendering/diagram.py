"""Knot diagrams of the rope for people: large, smooth, with a gap where a strand goes under.

Used by galleries, videos, the window of `render_mode="human"` and the line drawings of perception
tables. Observations are drawn by `picture` and don't depend on this module. The same points always
give the same bytes.

The rope is painted as in `picture`. At each crossing a band, wider than the rope, runs along the
over strand and cuts what is no higher than the under strand is near the crossing; the over strand
itself is spared.

After a change run `pytest tests/rendering/test_diagram.py`: gaps must be where strands go under,
and smoothing must leave the code alone.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.rendering.camera import (
    RGB,
    PictureConfig,
    bead_colours,
    checked_points,
    in_picture,
    project,
    seen_from,
)
from knotgym.rendering.picture import paint
from knotgym.topology import Crossings, GaussCode, find_crossings

Array = NDArray[Any]

BACKGROUND = (7, 8, 12)  # RGB
_PARTS = 4  # pieces of the smooth curve per bead
_GAP = 1.8  # width of the band, in widths of the rope
_LINE_GAP = 5.0  # the same where the rope is drawn as a line
_WHITE = (255, 255, 255)
_REACH = 4  # largest length of the band on each side of a crossing, beads
_MARGIN = 1.12  # side of the picture, in extents of the rope
_SMALLEST = 0.12  # smallest side of the picture, metres
_RADIUS, _THINNEST = 0.005, 1 / 80  # drawn radius, metres, and its smallest fraction of a side
_PULL, _ARROW = _WHITE, 0.15  # RGB, and the largest force's length as a fraction of a side


def draw_diagram(
    points: ArrayLike,
    size: int = 192,
    *,
    side: float | None = None,
    view: str = "top",
    pull: tuple[int, Array] | None = None,
) -> NDArray[np.uint8]:
    """Draw a rope as a knot diagram, orthographic, in the middle of the picture.

    Args:
        points: float64 (beads, 3), metres, finite; at least 3 beads.
        size: side of the picture, pixels.
        side: side of the picture, metres; by default the rope fills it.
        view: "top" (in which Gauss codes are read), "left" or "front".
        pull: a bead and the force on it, (3,), in units of the largest force; drawn as an arrow.

    Returns:
        uint8 (size, size, 3), RGB.

    Raises:
        InvalidInput: points have the wrong shape or are not finite, or the size is out of range.
    """
    rope = seen_from(view, checked_points(points, 2))
    shown = side or side_of(rope)
    config = PictureConfig(size=size, view=shown, rope_radius=max(_RADIUS, _THINNEST * shown))
    centre = 0.5 * (rope.min(axis=0) + rope.max(axis=0))
    picture = _paint(rope, centre, config, bead_colours(len(rope)), BACKGROUND, _GAP)
    if pull is not None:
        bead, force = pull
        start = project(rope[bead][None], config, centre)[0]
        push = seen_from(view, np.asarray(force)[None])[0]
        _arrow(picture, start, start + _ARROW * size * np.array([push[0], -push[1]]))
    return picture


def draw_lines(points: ArrayLike, config: PictureConfig) -> NDArray[np.uint8]:
    """Draw a rope as knot diagrams are printed: a black line on white, with gaps.

    Nothing marks the base bead or the direction.

    Args:
        points: float64 (beads, 3), metres.
        config: size, scale and turn of the picture, and width of the line; its colours are ignored.

    Returns:
        uint8 (size, size, 3), RGB.
    """
    rope = checked_points(points, 2)
    black = np.zeros((len(rope), 3), dtype=np.uint8)
    return _paint(rope, rope.mean(axis=0), config, black, _WHITE, _LINE_GAP)


def side_of(points: ArrayLike) -> float:
    """Return the side, metres, of a square that shows each of (..., beads, 3) whole, from above.

    >>> side_of(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.5, 0.0]]))
    1.12
    """
    extent = np.ptp(np.asarray(points)[..., :2], axis=-2).max()
    return max(_SMALLEST, _MARGIN * float(extent))


def smooth_curve(
    rope: Array, code: GaussCode, parts: int, eases: Sequence[float] = ()
) -> tuple[Array, Crossings]:
    """Lay a smooth closed curve along a rope, with the same Gauss code.

    Args:
        rope: float64 (beads, 3).
        code: of the rope.
        parts: pieces of the curve for each bead.
        eases: shares by which vertices move towards their neighbours, twice, as no rope bends at a
            point. The first that keeps the code is taken. If none does, the curve is the
            Catmull-Rom spline, or the polygon.

    Returns:
        float64 (beads parts, 3), and its crossings.
    """
    n, t = len(rope), (np.arange(parts) / parts)[:, None]
    before, after = np.arange(-1, n - 1), np.append(np.arange(1, n), 0)
    for ease, bent in (*((ease, 1.0) for ease in eases), (0.0, 1.0), (0.0, 0.0)):
        here = rope
        for _ in range(2 if ease else 0):
            here = here + ease * (here[before] + here[after] - 2 * here)
        step = here[after] - here
        slope = step - 0.5 * bent * (step - step[before])
        end = step + bent * (slope[after] - step)
        # the cubic through here and the next vertex, with these slopes at its ends
        square, cube = 3 * step - 2 * slope - end, slope + end - 2 * step
        terms = [one[:, None] for one in (here, slope, square, cube)]
        curve = (terms[0] + t * (terms[1] + t * (terms[2] + t * terms[3]))).reshape(-1, 3)
        crossings = find_crossings(curve)
        if crossings.code == code:
            break
    return curve, crossings


def _paint(
    rope: Array, centre: Array, config: PictureConfig, colours: Array, background: RGB, gap: float
) -> NDArray[np.uint8]:
    """Paint a rope, whose beads have `colours`, with `centre` in the middle of the picture.

    `gap` is the width of the bands at crossings, in widths of the rope.
    """
    curve, crossings = smooth_curve(rope, find_crossings(rope).code, _PARTS)
    size, count = config.size, len(curve)
    # row by row: 60 times as fast as filling every pixel with three numbers
    picture = np.full((1, size, 3), background, dtype=np.uint8).repeat(size, axis=0)
    (line,), depths = in_picture(curve[None], config, centre)
    reaches = _reaches(curve, crossings, config.drawn_radius, gap)
    bands = np.ones((crossings.nx, 5))
    bands[:, 0], bands[:, 1], bands[:, 2] = crossings.over_place, reaches, gap * line[0, 3]
    for band, under, reach in zip(bands, crossings.under_place, reaches, strict=True):
        off = np.abs(np.arange(count) - under)
        band[3] = line[np.minimum(off, count - off) <= reach + 3.0, 2].max()
    paint(line[None], depths, np.repeat(colours, _PARTS, axis=0), bands, picture[None])
    return picture


def _reaches(curve: Array, crossings: Crossings, radius: float, gap: float) -> Array:
    """Return the length of each crossing's band on either side, in pieces of the curve."""
    step = (np.roll(curve, -1, axis=0) - curve)[:, :2]
    length = np.linalg.norm(step, axis=1)
    over, under = (
        place.astype(np.intp) % len(curve)
        for place in (crossings.over_place, crossings.under_place)
    )
    # two strips of half-widths w (under) and W (band) at angle a meet on a parallelogram that
    # reaches (w + W |cos a|) / |sin a| along the band
    product = np.maximum(length[over] * length[under], 1e-12)
    sine = (step[over, 0] * step[under, 1] - step[over, 1] * step[under, 0]) / product
    cosine = (step[over] * step[under]).sum(axis=1) / product
    along = radius * (1 + gap * np.abs(cosine)) / np.maximum(np.abs(sine), 1e-3)
    return np.minimum(along / length.mean() + 0.5, _REACH * _PARTS)


def _arrow(picture: NDArray[np.uint8], start: Array, end: Array) -> None:
    """Draw an arrow with an outline, so that it is visible on the rope."""
    near, far = ((round(float(x)), round(float(y))) for x, y in (start, end))
    for colour, thick in ((BACKGROUND, 5), (_PULL, 2)):
        cv2.circle(picture, near, thick + 2, colour, cv2.FILLED, cv2.LINE_AA)
        cv2.arrowedLine(picture, near, far, colour, thick, cv2.LINE_AA, tipLength=0.3)
