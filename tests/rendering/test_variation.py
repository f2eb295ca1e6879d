"""Varied appearance: what varies in a picture, and that the Gauss code stays true."""

import numpy as np
import pytest

from knotgym.common import Array
from knotgym.rendering import project
from knotgym.rendering.appearances import APPEARANCES, PUBLISHED, AppearanceConfig
from knotgym.rendering.picture import draw
from knotgym.rendering.variation import Appearance, Drawer
from knotgym.rope import Rope
from knotgym.topology import find_crossings

from ..conftest import curled
from .test_picture import shown_strands

VARIED = APPEARANCES[PUBLISHED].vary
ALL = AppearanceConfig(vary=VARIED, sizes=(64, 128, 256))
appearance, render = Drawer(PUBLISHED)._drawn_look, Drawer(PUBLISHED).image


@pytest.fixture(scope="module")
def points(rope: Rope) -> Array:
    return rope.from_curve(curled(3, 0.4))


def looks(points: Array, config: AppearanceConfig, count: int = 40) -> list[Appearance]:
    return [appearance(points, config, np.random.default_rng([5, k])) for k in range(count)]


def test_without_variation_a_picture_is_the_published_one(points: Array) -> None:
    look = appearance(points, AppearanceConfig(), np.random.default_rng(0))
    assert look == Appearance()
    assert np.array_equal(render(points, look), draw(points))


def test_everything_varies_and_nothing_else(points: Array) -> None:
    plain = Appearance()
    for name in VARIED:
        drawn = looks(points, AppearanceConfig(vary=(name,)))
        also = {"colours": {"first", "last"}, "noise": {"seed"}}.get(name, set())
        changed = {
            field
            for look in drawn
            for field in vars(plain)
            if getattr(look, field) != getattr(plain, field)
        }
        assert name in changed and changed <= {name} | also, name


def test_an_appearance_of_a_size_that_was_given_determines_every_byte(points: Array) -> None:
    assert {look.size for look in looks(points, ALL)} == {64, 128, 256}
    for look, again in zip(looks(points, ALL, 8), looks(points, ALL, 8), strict=True):
        image = render(points, look)
        assert image.shape == (look.size, look.size, 3)
        assert np.array_equal(image, render(points, again))


def test_a_zoomed_rope_stays_in_the_picture(points: Array) -> None:
    config = AppearanceConfig(vary=("zoom", "turn", "width"), zoom=(3.0, 9.0))
    for look in looks(points, config, 10):
        image = render(points, look)
        assert not image[[0, -1]].any() and not image[:, [0, -1]].any()


def test_a_turned_or_zoomed_picture_shows_its_crossings_where_it_says(points: Array) -> None:
    crossings = find_crossings(points)
    assert crossings.nx == 3
    for look in looks(points, AppearanceConfig(vary=("turn", "zoom"), sizes=(256,)), 10):
        config = look.picture()
        assert set(shown_strands(render(points, look), crossings, points, config)) <= {
            "over",
            "ambiguous",
        }
        for x, y in project(crossings.over_points, config, points.mean(axis=0)):
            assert render(points, look)[int(y), int(x)].any()


def test_the_base_bead_is_white_whatever_the_colours() -> None:
    for kind, colours in (("published", 99), ("single", 1), ("gradient", 99)):
        look = Appearance(colours=kind, first=(200, 150, 160), last=(30, 40, 180))
        base, *others = look._bead_colours(100).tolist()
        assert base == [255, 255, 255] and len({*map(tuple, others)}) == colours
