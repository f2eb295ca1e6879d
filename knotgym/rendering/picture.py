"""Pictures of a rope, drawn as OpenCV would; for the camera and the colours see `camera`.

Bead i is a capsule from points[i] to points[(i + 1) % beads]. Colours are flat, without light or
shadow.

Depth is the depth of the rope's axis, accurate to 3.4 mm: beads are drawn in pieces that span at
most 6.7 mm of depth, and each piece has the depth of its middle. A pixel takes the nearest of its
samples instead of their average. Under the perspective camera, depth is distance along the line of
sight.

After a change run `pytest tests/rendering/test_picture.py` and `python benchmarks/truth.py`:
pictures must be a ray tracer's but for edges, and the strand on top the one labelled over.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.rendering.camera import (
    DEFAULT,
    PictureConfig,
    bead_colours,
    checked_points,
    pixels_per_metre_at,
    project,
    require,
    seen_from,
)
from knotgym.rendering.rasterizer import EDGE, paint
from knotgym.topology import Crossings


def draw(
    points: ArrayLike, config: PictureConfig = DEFAULT, *, colours: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Draw a rope; the same points and config always give the same bytes.

    Args:
        points: float64, shape (beads, 3), metres, world frame, finite; at least 3 beads.
        config: camera, size and style of the picture.
        colours: uint8, shape (beads, 3), RGB; by default the published ones, see `bead_colours`.

    Returns:
        uint8, shape (views * size, size, 3), RGB, row 0 at the top (largest y), the first view on
        top; 4 channels with depth. Parts of the rope outside a view are cut off.

    Raises:
        InvalidInput: points or colours have the wrong shape, or points are not finite.
        Failed: config.renderer is "mujoco" and OpenGL is not available.
    """
    points = checked_points(points, 2)
    images = _draw_all(points[None], config, colours)
    return images.reshape(images.shape[1:])


def draw_many(
    points: ArrayLike,
    config: PictureConfig = DEFAULT,
    *,
    colours: NDArray[np.uint8] | None = None,
    out: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """Draw m ropes with the same number of beads; picture k equals draw(points[k], config).

    Args:
        points: float64, shape (m, beads, 3), metres; m may be 0.
        config: as in `draw`.
        colours: as in `draw`, the same for all ropes.
        out: uint8, contiguous, of the shape below or wider, to whose left the ropes are drawn; what
            is right of them stays. None for a new array.

    Returns:
        uint8, shape (m, views * size, size, 3 or 4), or `out`.

    Raises:
        InvalidInput, Failed: as in `draw`.
    """
    return _draw_all(checked_points(points, 3), config, colours, out)


def crossing_pixels(
    crossings: Crossings, points: ArrayLike, config: PictureConfig = DEFAULT
) -> NDArray[np.float64]:
    """Project the over strand of each crossing into the top view.

    Returns:
        float64, shape (n, 2), pixel coordinates as in `project`.
    """
    over = np.column_stack([crossings.position, crossings.over_z])
    return project(over, config, center=np.asarray(points, dtype=np.float64).mean(axis=0))


def _draw_all(
    points: NDArray[np.float64],
    config: PictureConfig,
    colours: NDArray[np.uint8] | None,
    out: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    frames, beads = points.shape[:2]
    colours = bead_colours(beads) if colours is None else np.asarray(colours)
    fits = colours.shape == (beads, 3) and colours.dtype == np.uint8
    require(fits, f"colours must be uint8 of shape {(beads, 3)}", (colours.dtype, colours.shape))
    views, size = len(config.views), config.size
    if out is None:
        out = np.empty((frames, views * size, size, config.channels), dtype=np.uint8)
    # `reshape` below would copy a strided array, and the background be written to the copy
    require(out.flags.c_contiguous, "out must be contiguous", out.strides)
    if config.renderer == "mujoco":
        # imported only here, because the module searches for OpenGL
        from knotgym.rendering import mujoco_renderer

        # one rope after another, as OpenGL draws no batch
        for image, rope in zip(out[:, :, :size], points, strict=True):
            for square, view in zip(np.split(image, views), config.views, strict=True):
                square[:] = mujoco_renderer.draw(seen_from(view, rope), colours, config)
        return out
    shades = np.vstack([np.array(config.background, dtype=np.uint8), colours])
    # whole rows: NumPy assigns three channels at a time forty times more slowly
    row = np.tile(np.array((*config.background, 0)[: config.channels], dtype=np.uint8), size)
    out.reshape(*out.shape[:2], out.shape[2] * config.channels)[:, :, : row.size] = row
    # height of the centre of mass, or its distance from the camera: the depth that becomes level
    # 128
    middle = 0.0 if config.camera == "orthographic" else -config.camera_height
    for number, view in enumerate(config.views):
        placed = _on_canvas(seen_from(view, points), config)
        depths, top = (middle, config.view), number * size
        paint(*placed, config.supersampling, shades, depths, out, top, size)
    return out


def _on_canvas(
    points: NDArray[np.float64], config: PictureConfig
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Project ropes (m, beads, 3) onto the supersampled canvas.

    Returns:
        pixels (m, beads, 2); heights (m, beads), metres, in perspective the negative distance to
        the camera; radii (m, beads), pixels, less EDGE.
    """
    offset = points - points.mean(axis=1, keepdims=True)
    # OpenCV has the centres of samples at whole numbers, `project` at halves
    pixels = config.supersampling * project(points, config) - 0.5
    if config.camera == "orthographic":
        height = np.ascontiguousarray(offset[..., 2])
    else:
        # negative, so that nearer is higher under both cameras
        height = -np.linalg.norm(offset - np.array([0.0, 0.0, config.camera_height]), axis=-1)
    # Each vertex has a radius of its own, as perspective widens what is near. OpenCV fills EDGE too
    # wide, see `rasterizer`.
    radius = config.supersampling * config.drawn_radius * pixels_per_metre_at(offset, config)
    return pixels, height, np.maximum(radius - EDGE, EDGE)
