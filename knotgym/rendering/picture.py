"""Pictures of a rope, drawn by `capsules`; for the camera and the colours see `camera`.

Bead i is a capsule from points[i] to points[(i + 1) % beads]. Colours are flat, without light or
shadow. Depth is that of the rope's axis where it is seen; under the perspective camera it is
distance along the line of sight.

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
from knotgym.rendering.capsules import Depths, paint
from knotgym.topology import Crossings


def draw(
    points: ArrayLike, config: PictureConfig = DEFAULT, *, colours: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Draw a rope; the same points and config always give the same bytes.

    Args:
        points: float64, shape (beads, 3), metres, world frame, finite; at least 3 beads.
        config: camera, size and background of the picture.
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
    # whole rows: NumPy assigns three channels at a time forty times more slowly
    row = np.tile(np.array((*config.background, 0)[: config.channels], dtype=np.uint8), size)
    out.reshape(*out.shape[:2], out.shape[2] * config.channels)[:, :, : row.size] = row
    sides = [seen_from(view, points) for view in config.views]
    ropes = np.stack(sides, axis=1).reshape(-1, beads, 3) if views > 1 else sides[0]
    squares = out.reshape(-1, size, *out.shape[2:])
    paint(*in_picture(ropes, config), colours, depths_of(config), np.empty((0, 5)), squares, size)
    return out


def in_picture(
    points: NDArray[np.float64], config: PictureConfig, center: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Project ropes (m, beads, 3) for `paint`.

    Args:
        points: metres.
        config: settings of the picture.
        center: see `project`; by default the mean of each rope.

    Returns:
        pixels (m, beads, 2); heights (m, beads), in perspective the negative distance to the camera
        at the scale of the centre of mass; radii (m, beads). All in pixels.
    """
    offset = points - (points.mean(axis=1, keepdims=True) if center is None else center)
    pixels, height = project(points, config, center), np.ascontiguousarray(offset[..., 2])
    if config.camera == "perspective":
        # negative, so that nearer is higher under both cameras
        height = -np.linalg.norm(offset - np.array([0.0, 0.0, config.camera_height]), axis=-1)
    # each vertex has a radius of its own, as perspective widens what is near
    radius = config.drawn_radius * pixels_per_metre_at(offset, config)
    return pixels, config.pixels_per_metre * height, radius


def depths_of(config: PictureConfig) -> Depths:
    """Return the levels of depth: half of them in front of the centre of mass."""
    middle = 0.0 if config.camera == "orthographic" else -config.camera_height
    return Depths(config.pixels_per_metre * middle, config.pixels_per_metre * config.view)
