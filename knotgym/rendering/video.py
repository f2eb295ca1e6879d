"""Videos of a rope beside its goal, with their codes below.

Videos are mp4, webm or gif, and all of them play in a browser: .mp4 files hold H.264 and .webm
files VP9, both encoded by PyAV (extra `video`).
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from knotgym.common import InvalidInput, MissingExtra, atomic_write
from knotgym.rendering.camera import seen_from
from knotgym.rendering.diagram import draw_diagram, side_of
from knotgym.topology import label

Array = NDArray[np.float64]

FRAMES_PER_SECOND = 5  # an action lasts 0.192 s
_TEXT = 18  # height of a line of the caption, pixels
_FONT, _LETTERS, _WHITE = cv2.FONT_HERSHEY_SIMPLEX, 0.45, (225, 225, 225)
_WIDTH = 384  # width of each half, pixels

# suffix -> encoder of FFmpeg and its options
_CODECS = {".mp4": ("libx264", {"crf": "18"}), ".webm": ("libvpx-vp9", {"crf": "18", "b": "0"})}


def _captioned(
    frame: NDArray[np.uint8], lines: Sequence[str], outcome: str = ""
) -> NDArray[np.uint8]:
    """Add lines of text below a picture and mark its outcome.

    Args:
        frame: uint8 (height, width, 3), RGB.
        lines: lines of text.
        outcome: "reached" or "failed", written large in green or red with a border; "" for none.

    Returns:
        uint8 (height, width, 3), RGB, with an even height.
    """
    high, wide = frame.shape[:2]
    # video encoders need an even height
    below = np.zeros((_TEXT * len(lines) + 8 + (high + _TEXT * len(lines)) % 2, wide, 3), np.uint8)
    for number, line in enumerate(lines):
        # a line that is too long is written smaller
        line_width = cv2.getTextSize(line, _FONT, _LETTERS, 1)[0][0]
        letters = min(_LETTERS, _LETTERS * (wide - 12) / max(1, line_width))
        _write(below, line, 6, _TEXT * (number + 1) - 2, letters)
    whole = np.concatenate([frame, below])
    if outcome:
        colour = Film.OUTCOMES[outcome]
        cv2.putText(whole, outcome, (12, high - 16), _FONT, 1.2, colour, 2, cv2.LINE_AA)
        cv2.rectangle(whole, (2, 2), (wide - 3, len(whole) - 3), colour, 4)
    return whole


def _write(picture: NDArray[np.uint8], text: str, x: int, y: int, size: float = _LETTERS) -> None:
    cv2.putText(picture, text, (x, y), _FONT, size, _WHITE, 1, cv2.LINE_AA)


class Film:
    """A video that is to be written as .gif, .mp4 or .webm.

    Attributes:
        OUTCOMES: RGB in which outcomes are marked, by name.

    Raises:
        InvalidInput: the suffix is unknown.
        MissingExtra: it needs PyAV, which isn't installed.
    """

    OUTCOMES: ClassVar = {"reached": (52, 211, 153), "failed": (251, 113, 133)}

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path, self._kind = path, Path(path).suffix.lower()
        if self._kind not in (".gif", *_CODECS):
            raise InvalidInput(f"a video must end in .gif, .mp4 or .webm, got {os.fspath(path)!r}")
        if self._kind in _CODECS:
            _pyav()

    def write(self, frames: Sequence[NDArray[np.uint8]]) -> None:
        """Write frames, RGB and of equal size; the write is atomic."""
        with atomic_write(self._path) as temporary:
            if self._kind in _CODECS:
                return _encode(temporary, frames, *_CODECS[self._kind])
            first, *others = map(Image.fromarray, frames)
            lasting = 1000 // FRAMES_PER_SECOND
            first.save(temporary, save_all=True, append_images=others, duration=lasting, loop=0)

    @staticmethod
    def frame(
        points: Array,
        goal: Array,
        heading: str,
        pull: tuple[int, Array] | None = None,
        outcome: str = "",
        views: Sequence[str] = ("top",),
        side: float | None = None,
    ) -> NDArray[np.uint8]:
        """Draw a rope beside its goal, the next pull as an arrow, and both codes below.

        Args:
            points, goal: float64 (beads, 3), metres.
            heading: first line of the caption.
            pull: a bead and the force on it, (3,), in units of the largest force.
            outcome: "reached" or "failed", written large with a border; "" for none.
            views: views stacked vertically, see `draw_diagram`.
            side: side of each half, metres; by default both ropes fit.

        Returns:
            uint8 (height, width, 3), RGB, 768 pixels wide.
        """
        drawing: dict[str, Any] = {"size": _WIDTH, "side": side or Film.side([points, goal], views)}
        halves = [
            np.concatenate([draw_diagram(rope, view=view, pull=arrow, **drawing) for view in views])
            for rope, arrow in ((points, pull), (goal, None))
        ]
        codes = [str(label(rope)) or "the plain loop" for rope in (points, goal)]
        lines = [heading, f"now   {codes[0]}", f"goal  {codes[1]}"]
        frame = _captioned(np.concatenate(halves, axis=1), lines, outcome)
        for column, name in ((0, "now"), (_WIDTH, "goal")):
            _write(frame, name, column + 12, _TEXT + 6)
        return frame

    @staticmethod
    def side(ropes: Sequence[Array], views: Sequence[str] = ("top",)) -> float:
        """Return the side, metres, in which every rope with its arrow fits in every view."""
        return 1.2 * max(side_of(seen_from(view, rope)) for rope in ropes for view in views)

    @staticmethod
    def frames(
        ropes: Sequence[Array],
        goal: Array,
        headings: Sequence[str],
        pulls: Sequence[tuple[int, Array]],
        reached: Sequence[bool] | NDArray[np.bool_],
        views: Sequence[str] = ("top",),
    ) -> list[NDArray[np.uint8]]:
        """Draw an episode at one scale; the last frame shows the outcome, one second longer.

        Args:
            ropes: T + 1 states, float64 (beads, 3) each, metres.
            goal: float64 (beads, 3), metres.
            headings: first line of the caption of each state.
            pulls: the T pulls between the states, as in `frame`.
            reached: for each state, whether it reaches the goal.
            views: as in `frame`.
        """
        side = Film.side([*ropes, goal], views)
        outcomes = ["reached" if done else "" for done in reached]
        outcomes[-1] = outcomes[-1] or "failed"
        shown = [
            Film.frame(rope, goal, heading, pull, outcome, views, side)
            for rope, heading, pull, outcome in zip(
                ropes, headings, [*pulls, None], outcomes, strict=True
            )
        ]
        return shown + shown[-1:] * FRAMES_PER_SECOND


def _encode(
    path: Path, frames: Sequence[NDArray[np.uint8]], encoder: str, options: dict[str, str]
) -> None:
    av = _pyav()
    with av.open(str(path), "w") as film:
        stream = film.add_stream(encoder, rate=FRAMES_PER_SECOND, options=options)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"  # the only pixel format that all browsers play
        for frame in frames:
            film.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        film.mux(stream.encode(None))  # what the encoder still holds


def _pyav() -> Any:
    """Import PyAV.

    Raises:
        MissingExtra: it isn't installed.
    """
    return MissingExtra.imported("av", "video", "a video that is no .gif")
