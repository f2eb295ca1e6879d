"""Videos of a rope beside its goal, with their codes below, as mp4, webm or gif.

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
from knotgym.rendering.camera import seen_from
from knotgym.rendering.diagram import draw_diagram, side_of
from knotgym.topology.crossings import label

Array = NDArray[np.float64]

FRAMES_PER_SECOND = 5  # an action lasts 0.192 s
_TEXT = 18  # pixels a line of caption
_FONT, _LETTERS, _WHITE = cv2.FONT_HERSHEY_SIMPLEX, 0.45, (225, 225, 225)
_WIDTH = 384  # pixels of each half
OUTCOMES = {"reached": (52, 211, 153), "failed": (251, 113, 133)}  # RGB
# ending -> encoder and its options
_CODECS: dict[str, tuple[str, dict[str, str]]] = {
    ".mp4": ("libx264", {"crf": "18"}),
    ".webm": ("libvpx-vp9", {"crf": "18", "b": "0"}),
}


class UnknownFilm(KnotgymError, ValueError):
    """A kind of video that can't be written."""


def captioned(
    frame: NDArray[np.uint8], lines: Sequence[str], outcome: str = ""
) -> NDArray[np.uint8]:
    """Write lines of text below a picture, uint8 (height, width, 3), and frame it by its outcome.

    Args:
        outcome: "reached" or "failed", written large in green or red; "" for neither.
    """
    high, wide = frame.shape[:2]
    # encoders of films need an even height
    below = np.zeros((_TEXT * len(lines) + 8 + (high + _TEXT * len(lines)) % 2, wide, 3), np.uint8)
    for number, line in enumerate(lines):
        wide_at_full = cv2.getTextSize(line, _FONT, _LETTERS, 1)[0][0]
        letters = min(_LETTERS, _LETTERS * (wide - 12) / max(1, wide_at_full))
        at = (6, _TEXT * (number + 1) - 2)
        cv2.putText(below, line, at, _FONT, letters, _WHITE, 1, cv2.LINE_AA)
    whole = np.concatenate([frame, below])
    if outcome:
        colour = OUTCOMES[outcome]
        cv2.putText(whole, outcome, (12, high - 16), _FONT, 1.2, colour, 2, cv2.LINE_AA)
        cv2.rectangle(whole, (2, 2), (wide - 3, len(whole) - 3), colour, 4)
    return whole


def film_frame(
    points: Array,
    goal: Array,
    heading: str,
    pull: tuple[int, Array] | None = None,
    outcome: str = "",
    views: Sequence[str] = ("top",),
    side: float | None = None,
) -> NDArray[np.uint8]:
    """Draw a rope beside its goal, with the pull about to be made as an arrow and both codes below.

    Args:
        points, goal: float64 (beads, 3), metres.
        heading: the first line below.
        pull: a bead, and the force on it in units of the largest there is, (3,).
        outcome: as of `captioned`.
        views: one below another, see `draw_diagram`.
        side: metres that a side of each half shows; by default both ropes fit.

    Returns:
        uint8 (height, width, 3), RGB, 768 pixels wide.
    """
    shown = side or film_side([points, goal], views)
    halves = [
        np.concatenate([draw_diagram(rope, _WIDTH, side=shown, view=view, pull=arrow)
                        for view in views])
        for rope, arrow in ((points, pull), (goal, None))
    ]  # fmt: skip
    codes = [str(label(rope)) or "the plain loop" for rope in (points, goal)]
    lines = [heading, f"now   {codes[0]}", f"goal  {codes[1]}"]
    frame = captioned(np.concatenate(halves, axis=1), lines, outcome)
    for column, name in ((0, "now"), (_WIDTH, "goal")):
        cv2.putText(frame, name, (column + 12, _TEXT + 6), _FONT, _LETTERS, _WHITE, 1, cv2.LINE_AA)
    return frame


def film_side(ropes: Sequence[Array], views: Sequence[str] = ("top",)) -> float:
    """Metres that a side must show so that every rope and arrow fits in every view."""
    return 1.2 * max(side_of(seen_from(view, rope)) for rope in ropes for view in views)


def film_frames(
    ropes: Sequence[Array],
    goal: Array,
    headings: Sequence[str],
    pulls: Sequence[tuple[int, Array]],
    reached: Sequence[bool] | NDArray[np.bool_],
    views: Sequence[str] = ("top",),
) -> list[NDArray[np.uint8]]:
    """Draw a whole episode at one scale; the last frame says how it ended and stays for a second.

    Args:
        ropes: T + 1 states, float64 (beads, 3) each, metres.
        headings, reached: of each state; whether the goal is reached there.
        pulls: the T pulls between them, as of `film_frame`.
    """
    side, last = film_side([*ropes, goal], views), len(ropes) - 1
    frames = [
        film_frame(
            rope,
            goal,
            headings[k],
            pulls[k] if k < last else None,
            "reached" if reached[k] else "failed" if k == last else "",
            views,
            side,
        )
        for k, rope in enumerate(ropes)
    ]
    return frames + frames[-1:] * FRAMES_PER_SECOND


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
