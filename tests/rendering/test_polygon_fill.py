"""Compiled painting gives OpenCV's pixels, byte for byte."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.rendering.camera import PictureConfig, bead_colours, seen_from
from knotgym.rendering.picture import _on_canvas, draw
from knotgym.rendering.polygon_fill import SHIFT, fill, shrink
from knotgym.rendering.rasterizer import average, polygons

from ..conftest import trefoil

SIDE = 64


def convex(rng: np.random.Generator) -> NDArray[np.int32]:
    """A convex polygon in or about the canvas, with some vertices twice, in either direction."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 15)))
    flat = np.stack([rng.uniform(0.02, 1) * np.cos(angles), np.sin(angles)], axis=1)
    turn = rng.uniform(0, 2 * np.pi)
    turned = flat @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    corners = rng.uniform(-20, SIDE + 20, 2) + rng.choice([1, 8, 30, 80]) * turned
    corners = np.repeat(corners, rng.integers(1, 3, len(corners)), axis=0)
    return np.rint(corners[:: rng.choice([-1, 1])] * 2**SHIFT).astype(np.int32)


def test_a_polygon_covers_the_samples_that_opencv_fills() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(3000):
        corners = convex(rng)
        ours, theirs = np.zeros((SIDE, SIDE), np.uint16), np.zeros((SIDE, SIDE), np.uint8)
        fill(ours, corners, 1)
        cv2.fillConvexPoly(theirs, corners, 1, cv2.LINE_8, SHIFT)
        assert np.array_equal(ours, theirs), corners.tolist()
        covered += bool(theirs.any())
    assert covered > 1000


@pytest.mark.parametrize("factor", range(1, 9))
def test_a_pixel_is_the_mean_that_opencv_takes(factor: int) -> None:
    rng = np.random.default_rng(factor)
    # coarse patches, so that some pixels are uniform, with single samples changed
    canvas = np.kron(rng.integers(0, 5, (12, 12)), np.ones((factor, factor))).astype(np.uint16)
    canvas = np.where(rng.random(canvas.shape) < 0.1, 3, canvas).astype(np.uint16)
    colours = rng.integers(0, 256, (5, 3)).astype(np.uint8)
    levels = np.array([0, 9, 250, 7, 30], dtype=np.uint8)
    ours = np.empty((12, 12, 4), np.uint8)
    ours[:] = *colours[0], levels[0]
    shrink(canvas, factor, colours, levels, ours)
    assert np.array_equal(ours[..., :3], average(colours[canvas], factor))
    blocks = levels[canvas].reshape(12, factor, 12, factor)
    assert np.array_equal(ours[..., 3], blocks.max(axis=(1, 3)))


@pytest.mark.parametrize(
    "config",
    [
        PictureConfig(),
        PictureConfig(zoom=2.0, turn=0.4, background=(9, 0, 90)),  # partly out of the picture
        PictureConfig(camera="perspective", size=48, supersampling=3),
        PictureConfig(views=("left",), size=32, width=2.5, supersampling=1),
    ],
)
def test_a_picture_is_the_one_that_opencv_draws(config: PictureConfig) -> None:
    rope = 0.08 * trefoil()
    side = config.size * config.supersampling
    canvas = np.full((side, side, 3), config.background, dtype=np.uint8)
    seen = _on_canvas(seen_from(config.views[0], rope[None]), config)
    pixels, heights, radii = (array[0] for array in seen)
    colours = bead_colours(len(rope)).tolist()
    outlines, owners, _ = polygons(pixels, heights, radii, side)
    for outline, owner in zip(outlines, owners, strict=True):
        cv2.fillConvexPoly(canvas, outline, colours[owner], cv2.LINE_8, SHIFT)
    assert np.array_equal(draw(rope, config), average(canvas, config.supersampling))
