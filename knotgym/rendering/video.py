"""Videos of a rope with its code under the picture, as mp4, webm or gif.

All play in a browser: an .mp4 holds H.264 and a .webm VP9, both encoded by PyAV (extra `video`).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from knotgym.atomic_files import atomic_write
from knotgym.errors import KnotgymError, install_command
from knotgym.rendering.picture import DEFAULT, PictureConfig, draw, project
from knotgym.topology.crossings import label

Array = NDArray[np.float64]

FRAMES_PER_SECOND = 5  # an action lasts 0.192 s
_TEXT = 18  # pixels a line of caption
_FONT, _LETTERS, _WHITE = cv2.FONT_HERSHEY_SIMPLEX, 0.45, (225, 225, 225)
_WIDTH = 384  # pixels of each half
_PULL, _ARROW = (255, 255, 255), 70.0  # RGB, and pixels that stand for the largest force
# ending -> encoder and its options
_CODECS: dict[str, tuple[str, dict[str, str]]] = {
    ".mp4": ("libx264", {"crf": "18"}),
    ".webm": ("libvpx-vp9", {"crf": "18", "b": "0"}),
}


class UnknownFilm(KnotgymError, ValueError):
    """A kind of video that can't be written."""


def captioned(frame: NDArray[np.uint8], lines: Sequence[str], scale: int = 3) -> NDArray[np.uint8]:
    """Enlarge a picture, uint8 (height, width, 3), and write lines of text below it."""
    large = np.repeat(np.repeat(frame, scale, axis=0), scale, axis=1)
    high, wide = large.shape[:2]
    # an even height in all, as films want it
    below = np.zeros((_TEXT * len(lines) + 8 + (high + _TEXT * len(lines)) % 2, wide, 3), np.uint8)
    for number, line in enumerate(lines):
        wide_at_full = cv2.getTextSize(line, _FONT, _LETTERS, 1)[0][0]
        letters = min(_LETTERS, _LETTERS * (wide - 12) / max(1, wide_at_full))
        at = (6, _TEXT * (number + 1) - 2)
        cv2.putText(below, line, at, _FONT, letters, _WHITE, 1, cv2.LINE_AA)
    return np.concatenate([large, below])


def film_frame(
    points: Array,
    goal: Array,
    heading: str,
    pull: tuple[int, Array] | None = None,
    picture: PictureConfig = DEFAULT,
) -> NDArray[np.uint8]:
    """A frame of a film: the rope and its goal, named; the pull about to be made as an arrow; both
    codes below, in one notation.

    Args:
        points, goal: float64 (beads, 3), metres.
        heading: the first line below.
        pull: a bead, and the force on it in units of the largest there is, (3,); drawn where the
            first view is from the top.
        picture: how both are drawn.

    Returns:
        uint8 (height, width, 3), RGB, about 768 pixels wide.
    """
    scale = max(1, _WIDTH // picture.size)
    halves = np.concatenate([draw(points, picture), draw(goal, picture)], axis=1)
    codes = [str(label(rope)) or "the plain loop" for rope in (points, goal)]
    frame = captioned(halves, [heading, f"now   {codes[0]}", f"goal  {codes[1]}"], scale)
    for column, name in ((0, "now"), (picture.size * scale, "goal")):
        cv2.putText(frame, name, (column + 6, _TEXT), _FONT, _LETTERS, _WHITE, 1, cv2.LINE_AA)
    if pull is not None and picture.views[0] == "top":
        bead, force = pull
        start = scale * project(points[bead : bead + 1], picture, center=points.mean(axis=0))[0]
        end = start + _ARROW * np.array([force[0], -force[1]])  # image up is world +y
        near, far = ((int(pixel[0]), int(pixel[1])) for pixel in (start, end))
        cv2.circle(frame, near, 4, _PULL, cv2.FILLED, cv2.LINE_AA)
        cv2.arrowedLine(frame, near, far, _PULL, 2, cv2.LINE_AA, tipLength=0.3)
    return frame


def require_film(path: str | os.PathLike[str]) -> None:
    """Refuse a video that can't be written here.

    Raises:
        UnknownFilm: another ending, or one that needs PyAV, which isn't there.
    """
    kind = Path(path).suffix.lower()
    if kind not in (".gif", *_CODECS):
        raise UnknownFilm(f"a video ends in .gif, .mp4 or .webm, got {os.fspath(path)!r}")
    if kind in _CODECS:
        _pyav(kind)


def write_film(path: str | os.PathLike[str], frames: Sequence[NDArray[np.uint8]]) -> None:
    """Write frames of one size, RGB, as .gif, .mp4 or .webm; the file appears whole or not at all.

    Raises:
        UnknownFilm: as of `require_film`.
    """
    require_film(path)
    kind = Path(path).suffix.lower()
    with atomic_write(path) as temporary:
        (_encoded if kind in _CODECS else _gif)(temporary, frames)


def _gif(path: Path, frames: Sequence[NDArray[np.uint8]]) -> None:
    images = [Image.fromarray(frame) for frame in frames]
    images[0].save(
        path,
        save_all=True,
        append_images=images[1:],
        duration=1000 // FRAMES_PER_SECOND,
        loop=0,
    )


def _encoded(path: Path, frames: Sequence[NDArray[np.uint8]]) -> None:
    av = _pyav(path.suffix)
    codec, options = _CODECS[path.suffix.lower()]
    with av.open(str(path), "w") as film:
        stream = film.add_stream(codec, rate=FRAMES_PER_SECOND, options=options)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"  # the only one that all browsers play
        for frame in frames:
            film.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        film.mux(stream.encode())


def _pyav(kind: str) -> Any:
    try:
        import av
    except ModuleNotFoundError as error:
        raise UnknownFilm(
            f"a {kind} film needs PyAV, which isn't installed; install it:"
            f" {install_command('video')}, or write a .gif"
        ) from error
    return av
