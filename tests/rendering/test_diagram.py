"""Diagrams for people: large, and with a gap exactly where a strand goes under."""

import numpy as np
import pytest

from knotgym.rendering.camera import PictureConfig, project
from knotgym.rendering.diagram import BACKGROUND, draw_diagram, side_of, smooth_curve
from knotgym.states import read_states, shipped
from knotgym.topology import find_crossings, label

STATES = [
    (name, row) for name, count in (("readable", 12), ("hard-unknots", 2)) for row in range(count)
]


def rope(name: str, row: int) -> np.ndarray:
    states = read_states(shipped(name), images=False)
    return states.points[np.argsort(-states.nx if name == "readable" else states.nx)[row]]


@pytest.mark.parametrize(("name", "row"), STATES)
def test_the_over_strand_is_whole_and_the_under_strand_has_a_gap(name: str, row: int) -> None:
    points, size = rope(name, row), 384
    picture = draw_diagram(points, size).astype(int)
    curve, crossings = smooth_curve(points, label(points), 4)
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    config = PictureConfig(size=size, view=side_of(points))
    step = np.roll(curve, -1, axis=0) - curve
    assert crossings.nx == find_crossings(points).nx > 0
    for over, under, position in zip(
        crossings.over_place, crossings.under_place, crossings.position, strict=True
    ):
        along, across = (step[int(place) % len(curve), :2] for place in (over, under))
        normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        slope = across / np.linalg.norm(across)
        # just outside the over strand, along the under strand: background on both sides
        out = 1.35 * 0.5 * config.view * 2 * max(0.005 / config.view, 1 / 80)
        steps = [position + sign * out / abs(slope @ normal) * slope for sign in (-1, 0, 1)]
        at = project(np.column_stack([steps, np.zeros(3)]), config, centre).astype(int)
        before, middle, after = (picture[y, x] for x, y in at)
        assert np.abs(middle - BACKGROUND).max() > 100
        assert np.abs(before - BACKGROUND).max() < 40 and np.abs(after - BACKGROUND).max() < 40


def test_the_rope_fills_the_picture() -> None:
    for row in range(6):
        drawn = (draw_diagram(rope("readable", row)).max(axis=2) > 40).nonzero()
        assert 0.85 * 192 < max(np.ptp(places) for places in drawn) < 192


def test_smoothing_never_changes_the_code() -> None:
    for name in ("readable", "hard-unknots"):
        for points in read_states(shipped(name), images=False).points:
            assert label(smooth_curve(points, label(points), 4)[0]) == label(points)


def test_a_polygon_whose_spline_has_another_code_is_drawn_straight() -> None:
    straight = 0
    for points in np.random.default_rng(0).normal(size=(60, 8, 3)):
        curve, crossings = smooth_curve(points, label(points), 4)
        assert crossings.code == label(points)
        straight += np.allclose(curve[2::4], 0.5 * (points + np.roll(points, -1, axis=0)))
    assert 0 < straight < 60


def test_a_pull_is_an_arrow_as_long_as_the_force() -> None:
    points = rope("readable", 0)
    plain = draw_diagram(points)
    long, short = (
        int((draw_diagram(points, pull=(9, np.array([push, 0.0, 0.0]))) != plain).any(2).sum())
        for push in (1.0, 0.4)
    )
    assert long > short > 0
