"""Diagrams for people: large, and with a gap exactly where a strand goes under."""

import sys
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from knotgym.common import MissingExtra
from knotgym.rendering.camera import PictureConfig, project
from knotgym.rendering.diagram import (
    BACKGROUND,
    FRAMES_PER_SECOND,
    Film,
    _side_of,
    draw_diagram,
    smooth_curve,
)
from knotgym.rope import Rope
from knotgym.states import read_states, shipped
from knotgym.topology import find_crossings, label

STATES = [
    (name, row) for name, count in (("readable", 12), ("hard-unknots", 2)) for row in range(count)
]


def knotted(name: str, row: int) -> np.ndarray:
    states = read_states(shipped(name), images=False)
    return states.points[np.argsort(-states.nx if name == "readable" else states.nx)[row]]


@pytest.mark.parametrize(("name", "row"), STATES)
def test_the_over_strand_is_whole_and_the_under_strand_has_a_gap(name: str, row: int) -> None:
    points, size = knotted(name, row), 384
    picture = draw_diagram(points, size).astype(int)
    curve, crossings = smooth_curve(points, label(points), 4)
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    config = PictureConfig(size=size, view=_side_of(points))
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
        drawn = (draw_diagram(knotted("readable", row)).max(axis=2) > 40).nonzero()
        assert 0.85 * 192 < max(np.ptp(places) for places in drawn) < 192


def test_smoothing_never_changes_the_code() -> None:
    for name in ("readable", "hard-unknots"):
        for points in read_states(shipped(name), images=False).points:
            assert label(smooth_curve(points, label(points), 4)[0]) == label(points)
    straight = 0  # polygons whose spline has another code
    for points in np.random.default_rng(0).normal(size=(60, 8, 3)):
        curve, crossings = smooth_curve(points, label(points), 4)
        assert crossings.code == label(points)
        straight += np.allclose(curve[2::4], 0.5 * (points + np.roll(points, -1, axis=0)))
    assert 0 < straight < 60


# films: written whole or not at all, and show what they were given

FRAMES = [np.full((40, 60, 3), level, dtype=np.uint8) for level in (0, 60, 120, 180, 240)]


@pytest.mark.parametrize(
    ("name", "codec"), [("a.gif", ""), ("a.mp4", "h264"), ("a.webm", "vp9"), ("a:b.MP4", "h264")]
)
def test_a_film_shows_its_frames_at_the_rope_s_speed(tmp_path: Path, name: str, codec: str) -> None:
    Film(tmp_path / name).write(FRAMES)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    film = cv2.VideoCapture(str(tmp_path / name))
    assert film.get(cv2.CAP_PROP_FPS) == FRAMES_PER_SECOND
    levels = []
    while (frame := film.read())[0]:
        levels.append(float(frame[1].mean()))
    assert np.allclose(levels, [0, 60, 120, 180, 240], atol=6)
    if codec:  # browsers play it
        with av.open(str(tmp_path / name)) as read:
            stream = read.streams.video[0]
            assert (stream.codec_context.name, stream.codec_context.pix_fmt) == (codec, "yuv420p")
            assert stream.average_rate == FRAMES_PER_SECOND


def test_films_without_pyav_name_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtra, match=r"pip install '\.\[video\]'"):
        Film(tmp_path / "a.mp4").write(FRAMES)
    Film(tmp_path / "a.gif").write(FRAMES)
    assert [path.name for path in tmp_path.iterdir()] == ["a.gif"]


def test_a_frame_shows_the_pull_and_says_the_plain_loop() -> None:
    loop = Rope().loop()
    plain = Film.frame(loop, loop, "step 0 of 1")
    pulled = Film.frame(loop, loop, "step 0 of 1", (0, np.array([0.0, 1.0, 0.0])))
    moved = np.argwhere((pulled != plain).any(axis=2))
    assert moved[:, 1].max() < 384  # on the rope's half
    # upwards, +y: the bead's place is the arrow's lowest point
    assert 60 < np.ptp(moved[:, 0]) < 100 and np.ptp(moved[:, 1]) < 40
    weak = Film.frame(loop, loop, "step 0 of 1", (0, np.array([0.0, 0.4, 0.0])))
    assert 0 < (weak != plain).any(axis=2).sum() < len(moved)


def test_a_film_says_at_its_end_whether_the_goal_was_reached() -> None:
    loop, pull = Rope().loop(), (0, np.zeros(3))
    for reached, outcome in (([False, True], "reached"), ([False, False], "failed")):
        first, *rest = Film.frames([loop, loop], loop, ["0", "1"], [pull], reached)
        assert len(rest) == 1 + FRAMES_PER_SECOND
        assert (rest[-1][4, 4:-4] == Film.OUTCOMES[outcome]).all()
        assert (first[4, 4:-4] != Film.OUTCOMES[outcome]).any()
