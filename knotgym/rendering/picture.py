"""The picture of a rope, as OpenCV draws it; the camera and the colours are `camera`'s.

Bead i is a capsule from points[i] to points[(i + 1) % beads]. Colours are flat: no light, no
shadow.
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
)
from knotgym.rendering.rasterizer import EDGE, SHIFT, average, polygons
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
        colours: uint8, shape (beads, 3), RGB, instead of config's.

    Returns:
        uint8, shape (size, size, 3), RGB, row 0 at the top (largest y). What lies outside the
        picture is cut off.

    Raises:
        PictureError: points or colours have another shape, or points are not finite.
        GraphicsUnavailable: config.renderer is "mujoco" and there is no OpenGL here.
    """
    points = checked_points(points, 2)
    images = _draw_all(points[None], config, colours)
    return images.reshape(images.shape[1:])


def draw_many(
    points: ArrayLike, config: PictureConfig = DEFAULT, *, colours: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Draw m ropes of equally many beads; picture k is draw(points[k], config).

    Args:
        points: float64, shape (m, beads, 3), metres; m may be 0.
        colours: as for draw, the same for all.

    Returns:
        uint8, shape (m, size, size, 3), RGB.

    Raises:
        PictureError, GraphicsUnavailable: as draw.
    """
    return _draw_all(checked_points(points, 3), config, colours)


def crossing_pixels(
    crossings: Crossings, points: ArrayLike, config: PictureConfig = DEFAULT
) -> NDArray[np.float64]:
    """Where the over strand of each crossing appears in the picture of points.

    Returns:
        float64, shape (n, 2), pixel coordinates as of `project`.
    """
    where = np.column_stack([crossings.position, crossings.over_z])
    return project(where, config, center=np.asarray(points, dtype=np.float64).mean(axis=0))


@lru_cache(maxsize=16)
def _paint(beads: int, config: PictureConfig) -> list[RGB]:
    """The colours of config as OpenCV wants them."""
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
    images = np.empty((frames, config.size, config.size, 3), dtype=np.uint8)
    if config.renderer == "mujoco":
        # here, for it looks for OpenGL
        from knotgym.rendering import mujoco_renderer

        shades = rope_colours(beads, config) if colours is None else colours
        for image, rope in zip(images, points, strict=True):
            image[:] = mujoco_renderer.draw(rope, shades, config)
        return images
    paint = _paint(beads, config) if colours is None else _as_scalars(colours)
    finer = config.supersampling
    canvas = np.empty((finer * config.size, finer * config.size, 3), dtype=np.uint8)
    for image, rope in zip(images, points, strict=True):
        _fill(image, config.background)
        outlines, owners = polygons(*_placed(rope, config), len(canvas))
        if not len(outlines):
            continue
        columns, rows = _touched(outlines, config)
        touched = canvas[
            finer * rows.start : finer * rows.stop, finer * columns.start : finer * columns.stop
        ]
        _fill(touched, config.background)
        for outline, bead in zip(outlines, owners.tolist(), strict=True):
            cv2.fillConvexPoly(canvas, outline, paint[bead], cv2.LINE_8, SHIFT)
        image[rows, columns] = average(touched, finer)
    return images


def _touched(outlines: NDArray[np.int32], config: PictureConfig) -> tuple[slice, slice]:
    """The columns and rows of pixels that polygons on the canvas touch, one more on each side."""
    x, y, width, height = cv2.boundingRect(outlines.reshape(-1, 2))
    spans = (
        [(low >> SHIFT) // config.supersampling for low in (x, y)],
        [(high >> SHIFT) // config.supersampling for high in (x + width, y + height)],
    )
    columns, rows = (
        slice(max(low - 1, 0), min(high + 2, config.size)) for low, high in zip(*spans, strict=True)
    )
    return columns, rows


def _fill(picture: NDArray[np.uint8], colour: RGB) -> None:
    # a tenth of the time that NumPy takes
    cv2.rectangle(picture, (0, 0), picture.shape[1::-1], colour, cv2.FILLED)


def _placed(
    points: NDArray[np.float64], config: PictureConfig
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """A rope on the supersampled canvas.

    Returns:
        pixels (beads, 2), heights (beads,), metres, and radii (beads,), pixels.
    """
    offset = points - points.mean(axis=0)
    pixels = config.supersampling * project(points, config) - 0.5
    if config.camera == "orthographic":
        height = np.ascontiguousarray(offset[:, 2])
    else:
        height = -np.linalg.norm(offset - np.array([0.0, 0.0, config.camera_height]), axis=1)
    radius = config.supersampling * config.drawn_radius * pixels_per_metre_at(offset, config)
    return pixels, height, np.maximum(radius - EDGE, EDGE)
