"""Pictures of a rope, drawn by OpenCV; for the camera and the colours see `camera`.

Bead i is a capsule from points[i] to points[(i + 1) % beads]. Colours are flat, without light or
shadow.

Depth is the depth of the rope's axis, accurate to 3.4 mm: beads are drawn in pieces that span at
most 6.7 mm of depth, and each piece has the depth of its middle. A pixel takes the nearest of its
samples instead of their average. Under the perspective camera, depth is distance along the line of
sight.
"""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.rendering.camera import (
    DEFAULT,
    RGB,
    PictureConfig,
    PictureError,
    bead_colours,
    checked_points,
    pixels_per_metre_at,
    project,
    require,
    rope_colours,
    seen_from,
)
from knotgym.rendering.rasterizer import EDGE, SHIFT, average, nearest, polygons
from knotgym.topology.crossings import Crossings

__all__ = [
    "DEFAULT",
    "RGB",
    "PictureConfig",
    "PictureError",
    "bead_colours",
    "crossing_pixels",
    "draw",
    "draw_many",
    "project",
    "rope_colours",
]


def draw(
    points: ArrayLike, config: PictureConfig = DEFAULT, *, colours: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Draw a rope; the same points and config always give the same bytes.

    Args:
        points: float64, shape (beads, 3), metres, world frame, finite; at least 3 beads.
        config: camera, size and style of the picture.
        colours: uint8, shape (beads, 3), RGB; overrides config's.

    Returns:
        uint8, shape (views * size, size, 3), RGB, row 0 at the top (largest y), the first view on
        top; 4 channels with depth. Parts of the rope outside a view are cut off.

    Raises:
        PictureError: points or colours have the wrong shape, or points are not finite.
        GraphicsUnavailable: config.renderer is "mujoco" and OpenGL is not available.
    """
    points = checked_points(points, 2)
    images = _draw_all(points[None], config, colours)
    return images.reshape(images.shape[1:])


def draw_many(
    points: ArrayLike, config: PictureConfig = DEFAULT, *, colours: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Draw m ropes with the same number of beads; picture k equals draw(points[k], config).

    Args:
        points: float64, shape (m, beads, 3), metres; m may be 0.
        config: as in `draw`.
        colours: as in `draw`, the same for all ropes.

    Returns:
        uint8, shape (m, views * size, size, 3 or 4).

    Raises:
        PictureError, GraphicsUnavailable: as in `draw`.
    """
    return _draw_all(checked_points(points, 3), config, colours)


def crossing_pixels(
    crossings: Crossings, points: ArrayLike, config: PictureConfig = DEFAULT
) -> NDArray[np.float64]:
    """Project the over strand of each crossing into the top view.

    Returns:
        float64, shape (n, 2), pixel coordinates as in `project`.
    """
    over = np.column_stack([crossings.position, crossings.over_z])
    return project(over, config, center=np.asarray(points, dtype=np.float64).mean(axis=0))


@lru_cache(maxsize=16)
def _paint(beads: int, config: PictureConfig) -> list[RGB]:
    """Return the colours of config as tuples of ints, as OpenCV requires."""
    return _as_scalars(rope_colours(beads, config))


def _as_scalars(colours: NDArray[np.uint8]) -> list[RGB]:
    return [(red, green, blue) for red, green, blue in colours.tolist()]


def _draw_all(
    points: NDArray[np.float64], config: PictureConfig, colours: NDArray[np.uint8] | None
) -> NDArray[np.uint8]:
    frames, beads = points.shape[:2]
    if colours is not None:
        colours = np.asarray(colours)
        fits = colours.shape == (beads, 3) and colours.dtype == np.uint8
        require(
            fits, f"colours must be uint8 of shape {(beads, 3)}", (colours.dtype, colours.shape)
        )
    views, size = len(config.views), config.size
    images = np.empty((frames, views * size, size, config.channels), dtype=np.uint8)
    squares = images.reshape(frames, views, size, size, config.channels)
    if config.renderer == "mujoco":
        # imported only here, because the module searches for OpenGL
        from knotgym.rendering import mujoco_renderer

        shades = rope_colours(beads, config) if colours is None else colours
        for image, rope in zip(squares, points, strict=True):
            for square, view in zip(image, config.views, strict=True):
                square[:] = mujoco_renderer.draw(seen_from(view, rope), shades, config)
        return images
    paint = _paint(beads, config) if colours is None else _as_scalars(colours)
    side = config.supersampling * size
    canvas = np.empty((side, side, 3), dtype=np.uint8)
    relief = np.empty((side, side), dtype=np.uint8) if config.depth else None
    for image, rope in zip(squares, points, strict=True):
        for square, view in zip(image, config.views, strict=True):
            _draw_view(square, seen_from(view, rope), config, paint, canvas, relief)
    return images


def _draw_view(
    square: NDArray[np.uint8],
    points: NDArray[np.float64],
    config: PictureConfig,
    paint: list[RGB],
    canvas: NDArray[np.uint8],
    relief: NDArray[np.uint8] | None,
) -> None:
    """Draw the top view of points into square.

    Args:
        square: uint8 (size, size, channels); output.
        points: float64 (beads, 3), metres.
        config: settings of the picture.
        paint: RGB of each bead.
        canvas: uint8 (side, side, 3), scratch memory for the supersampled colours.
        relief: uint8 (side, side), scratch memory for the supersampled depths, or None.
    """
    factor = config.supersampling
    _fill(square, (*config.background, 0)[: config.channels])
    outlines, owners, heights = polygons(*_on_canvas(points, config), len(canvas))
    if not len(outlines):
        return
    # only the pixels that the rope touches are cleared, painted and averaged
    columns, rows = _touched(outlines, config)
    samples = (
        slice(factor * rows.start, factor * rows.stop),
        slice(factor * columns.start, factor * columns.stop),
    )
    _fill(canvas[samples], config.background)
    for outline, bead in zip(outlines, owners.tolist(), strict=True):
        cv2.fillConvexPoly(canvas, outline, paint[bead], cv2.LINE_8, SHIFT)
    square[rows, columns, :3] = average(canvas[samples], factor)
    if relief is not None:
        _fill(relief[samples], (0,))
        for outline, level in zip(outlines, _levels(heights, config), strict=True):
            cv2.fillConvexPoly(relief, outline, (level,), cv2.LINE_8, SHIFT)
        square[rows, columns, 3] = nearest(relief[samples], factor)


def _levels(heights: NDArray[np.float64], config: PictureConfig) -> list[int]:
    """Convert heights of pieces, as in `_on_canvas`, to depth levels from 1 to 255."""
    middle = 0.0 if config.camera == "orthographic" else -config.camera_height
    nearness = np.clip(0.5 + (heights - middle) / config.view, 0.0, 1.0)
    levels: list[int] = (1 + np.rint(254.0 * nearness)).astype(int).tolist()
    return levels


def _touched(outlines: NDArray[np.int32], config: PictureConfig) -> tuple[slice, slice]:
    """Return the columns and rows of pixels that polygons touch, and one more on each side."""
    x, y, width, height = cv2.boundingRect(outlines.reshape(-1, 2))
    spans = (
        [(low >> SHIFT) // config.supersampling for low in (x, y)],
        [(high >> SHIFT) // config.supersampling for high in (x + width, y + height)],
    )
    columns, rows = (
        slice(max(low - 1, 0), min(high + 2, config.size)) for low, high in zip(*spans, strict=True)
    )
    return columns, rows


def _fill(picture: NDArray[np.uint8], colour: tuple[int, ...]) -> None:
    # ten times faster than assigning with NumPy
    cv2.rectangle(picture, (0, 0), picture.shape[1::-1], colour, cv2.FILLED)


def _on_canvas(
    points: NDArray[np.float64], config: PictureConfig
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Project a rope onto the supersampled canvas.

    Returns:
        pixels (beads, 2); heights (beads,), metres, in perspective the negative distance to the
        camera; radii (beads,), pixels, less EDGE.
    """
    offset = points - points.mean(axis=0)
    # OpenCV has the centres of samples at whole numbers, `project` at halves
    pixels = config.supersampling * project(points, config) - 0.5
    if config.camera == "orthographic":
        height = np.ascontiguousarray(offset[:, 2])
    else:
        height = -np.linalg.norm(offset - np.array([0.0, 0.0, config.camera_height]), axis=1)
    radius = config.supersampling * config.drawn_radius * pixels_per_metre_at(offset, config)
    return pixels, height, np.maximum(radius - EDGE, EDGE)
