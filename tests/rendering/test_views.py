"""Side views and depth."""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.rendering import project
from knotgym.rendering.camera import PictureConfig
from knotgym.rendering.picture import draw
from knotgym.topology import find_crossings

from .test_picture import LOOP, curves, shown_strands

ALL = ("top", "left", "front")
# view -> the world's directions that go right and up in the picture, and towards the camera
SEEN = {
    "top": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "left": ((0, -1, 0), (0, 0, 1), (-1, 0, 0)),
    "front": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}


def spread(beads: int = 100) -> NDArray[np.float64]:
    """Return a rope that extends as far in z as in x and y."""
    at = 2 * np.pi * np.arange(beads) / beads
    return 0.12 * np.stack([np.cos(at), np.sin(2 * at), np.sin(at + 0.5)], axis=1)


@pytest.mark.parametrize("camera", ["orthographic", "perspective"])
@pytest.mark.parametrize("view", ["left", "front"])
def test_a_side_view_is_the_top_view_of_the_rope_turned(
    view: str, camera: Literal["orthographic", "perspective"]
) -> None:
    config = PictureConfig(camera=camera, depth=True)
    for points in (*curves()[:4], spread()):
        turned = points @ np.array(SEEN[view], dtype=np.float64).T
        assert np.array_equal(draw(points, replace(config, views=(view,))), draw(turned, config))


def test_views_stand_one_below_another_in_the_order_asked_for() -> None:
    single = {view: draw(spread(), PictureConfig(views=(view,))) for view in ALL}
    for views in (ALL, ("front", "top")):
        together = draw(spread()[None], PictureConfig(views=views))[0]
        assert np.array_equal(together, np.concatenate([single[view] for view in views]))


def test_depth_leaves_the_colours_alone_and_is_0_exactly_where_no_rope_is() -> None:
    config = PictureConfig(views=ALL, depth=True)
    for points in curves()[:4]:
        image = draw(points, config)
        assert image.shape == (384, 128, 4) and image.dtype == np.uint8
        assert np.array_equal(image[..., :3], draw(points, replace(config, depth=False)))
        assert np.array_equal(image[..., 3] > 0, image[..., :3].any(axis=2))


def level(nearer: Any) -> Any:
    """Return the depth level of a point `nearer` metres in front of the rope's centre."""
    return 1 + 254 * (0.5 + nearer / 0.66)


def test_a_rope_that_lies_flat_has_the_middle_level() -> None:
    assert np.unique(draw(LOOP, PictureConfig(depth=True))[..., 3]).tolist() == [0, 128]
    edge_on = draw(LOOP, PictureConfig(depth=True, views=("left",)))[64, :, 3]
    # the nearer half of the ring hides the other
    assert edge_on.max() == pytest.approx(level(LOOP[:, 0].max()), abs=1)
    assert edge_on[64] == edge_on.max()
    assert edge_on[edge_on > 0].min() >= 127


def test_at_a_crossing_depth_is_that_of_the_over_strand() -> None:
    config, off = PictureConfig(depth=True), []
    for points in curves()[:12]:
        image, crossings = draw(points, config), find_crossings(points)
        over = shown_strands(image, crossings, points, config) == "over"
        pixels = project(crossings.over_points[over], config, points.mean(axis=0))
        column, row = np.floor(pixels).astype(int).T
        off.append(image[row, column, 3] - level(crossings.over_z[over] - points[:, 2].mean()))
    levels = np.concatenate(off)
    # 3.4 mm are 1.3 levels, rounding is half a one; within a pixel steep strands rise by more
    assert len(levels) > 10 and levels.min() > -1.8 and np.median(np.abs(levels)) < 1.0


@pytest.mark.parametrize("camera", ["orthographic", "perspective"])
def test_beyond_the_levels_is_the_last(camera: Literal["orthographic", "perspective"]) -> None:
    config = PictureConfig(camera=camera, view=0.1, zoom=0.2, depth=True)
    depth = draw(spread(), config)[..., 3]
    assert depth.max() == 255 and depth[depth > 0].min() == 1
