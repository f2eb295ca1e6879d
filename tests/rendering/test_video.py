"""Films are written whole or not at all, and show what they were given."""

import sys
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from knotgym.common import MissingExtra
from knotgym.rendering.diagram import FRAMES_PER_SECOND, Film
from knotgym.rope import Rope

from ..conftest import curled

FRAMES = [np.full((40, 60, 3), level, dtype=np.uint8) for level in (0, 60, 120, 180, 240)]


@pytest.mark.parametrize(
    ("name", "codec"), [("a.gif", ""), ("a.mp4", "h264"), ("a.webm", "vp9"), ("a.MP4", "h264")]
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


def test_a_frame_names_its_halves_and_their_codes(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr("cv2.putText", lambda frame, text, *_: said.append(text))
    Film.frame(Rope().loop(), Rope().from_curve(curled(1)), "step 0 of 1")
    assert said == ["step 0 of 1", "now   the plain loop", "goal  1+,1-", "now", "goal"]


def test_a_film_says_at_its_end_whether_the_goal_was_reached() -> None:
    loop, pull = Rope().loop(), (0, np.zeros(3))
    for reached, outcome in (([False, True], "reached"), ([False, False], "failed")):
        first, *rest = Film.frames([loop, loop], loop, ["0", "1"], [pull], reached)
        assert len(rest) == 1 + FRAMES_PER_SECOND
        assert (rest[-1][4, 4:-4] == Film.OUTCOMES[outcome]).all()
        assert (first[4, 4:-4] != Film.OUTCOMES[outcome]).any()


def test_a_film_keeps_its_scale_while_the_rope_shrinks() -> None:
    loop = Rope().loop()
    frames = Film.frames([loop, loop / 2], loop, ["0", "1"], [(0, np.zeros(3))], [False, False])
    wide = [
        np.ptp(np.flatnonzero((frame[40:340, :384].max(axis=2) > 60).any(axis=0)))
        for frame in (frames[0], Film.frame(loop / 2, loop, "1"))
    ]
    assert 1.8 < wide[0] / wide[1] < 2.2
