"""Knot diagrams of the rope for people: large, smooth, with a gap where a strand goes under; films.

Used by galleries, videos, the window of `render_mode="human"` and the line drawings of perception
tables. Observations are drawn by `picture` and don't depend on this module. The same points always
give the same bytes.

The rope is painted as in `picture`. At each crossing a band, wider than the rope, runs along the
over strand and cuts what is no higher than the under strand is near the crossing; the over strand
itself is spared.

A film shows a rope beside its goal, with their codes below. It is mp4, webm or gif, and all of them
play in a browser: .mp4 files hold H.264 and .webm files VP9, both encoded by PyAV (extra `video`).

After a change run `pytest tests/rendering/test_diagram.py`: gaps must be where strands go under,
and smoothing must leave the code alone.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Counts, InvalidInput, MissingExtra, atomic_write, kernel
from knotgym.rendering.camera import (
    RGB,
    PictureConfig,
    bead_colours,
    checked_points,
    in_picture,
    project,
    seen_from,
)
from knotgym.rendering.picture import Array, paint
from knotgym.topology import Crossings, GaussCode, find_crossings, label

BACKGROUND = (7, 8, 12)  # RGB
_PARTS = 4  # pieces of the smooth curve per bead
_GAP = 1.8  # width of the band, in widths of the rope
_LINE_GAP = 5.0  # the same where the rope is drawn as a line
_WHITE = (255, 255, 255)
_REACH = 4  # largest length of the band on each side of a crossing, beads
_MARGIN = 1.12  # side of the picture, in extents of the rope
_SMALLEST = 0.12  # smallest side of the picture, metres
_RADIUS, _THINNEST = 0.005, 1 / 80  # drawn radius, metres, and its smallest fraction of a side
_PULL, _ARROW = _WHITE, 0.15  # RGB, and the largest force's length as a fraction of a side
_WRITING = "writing the film"
FRAMES_PER_SECOND = 5  # an action lasts 0.192 s
_TEXT = 18  # height of a line of the caption, pixels
_FONT, _LETTERS, _PALE = cv2.FONT_HERSHEY_SIMPLEX, 0.45, (225, 225, 225)
_HALF = 384  # width of each half, pixels

# suffix -> encoder of FFmpeg and its options
_CODECS = {".mp4": ("libx264", {"crf": "18"}), ".webm": ("libvpx-vp9", {"crf": "18", "b": "0"})}


def draw_diagram(
    points: ArrayLike,
    size: int = 192,
    *,
    side: float | None = None,
    view: str = "top",
    pull: tuple[int, Array] | None = None,
) -> NDArray[np.uint8]:
    """Draw a rope as a knot diagram, orthographic, in the middle of the picture.

    Args:
        points: float64 (beads, 3), metres, finite; at least 3 beads.
        size: side of the picture, pixels.
        side: side of the picture, metres; by default the rope fills it.
        view: "top" (in which Gauss codes are read), "left" or "front".
        pull: a bead and the force on it, (3,), in units of the largest force; drawn as an arrow.

    Returns:
        uint8 (size, size, 3), RGB.

    Raises:
        InvalidInput: points have the wrong shape or are not finite, or the size is out of range.
    """
    rope = seen_from(view, checked_points(points, 2))
    shown = side or _side_of(rope)
    config = PictureConfig(size=size, view=shown, rope_radius=max(_RADIUS, _THINNEST * shown))
    centre = 0.5 * (rope.min(axis=0) + rope.max(axis=0))
    picture = _paint(rope, centre, config, bead_colours(len(rope)), BACKGROUND, _GAP)
    if pull is not None:
        bead, force = pull
        start = project(rope[bead][None], config, centre)[0]
        push = seen_from(view, np.asarray(force)[None])[0]
        _arrow(picture, start, start + _ARROW * size * np.array([push[0], -push[1]]))
    return picture


def draw_lines(points: ArrayLike, config: PictureConfig) -> NDArray[np.uint8]:
    """Draw a rope as knot diagrams are printed: a black line on white, with gaps.

    Nothing marks the base bead or the direction.

    Args:
        points: float64 (beads, 3), metres.
        config: size, scale and turn of the picture, and width of the line; its colours are ignored.

    Returns:
        uint8 (size, size, 3), RGB.
    """
    rope = checked_points(points, 2)
    black = np.zeros((len(rope), 3), dtype=np.uint8)
    return _paint(rope, rope.mean(axis=0), config, black, _WHITE, _LINE_GAP)


def _side_of(points: ArrayLike) -> float:
    """Return the side, metres, of a square that shows each of (..., beads, 3) whole, from above.

    >>> _side_of(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.5, 0.0]]))
    1.12
    """
    extent = np.ptp(np.asarray(points)[..., :2], axis=-2).max()
    return max(_SMALLEST, _MARGIN * float(extent))


def smooth_curve(
    rope: Array, code: GaussCode, parts: int, eases: Sequence[float] = ()
) -> tuple[Array, Crossings]:
    """Lay a smooth closed curve along a rope, with the same Gauss code.

    Args:
        rope: float64 (beads, 3).
        code: of the rope.
        parts: pieces of the curve for each bead.
        eases: shares by which vertices move towards their neighbours, twice, as no rope bends at a
            point. The first that keeps the code is taken. If none does, the curve is the
            Catmull-Rom spline, or the polygon.

    Returns:
        float64 (beads parts, 3), and its crossings.
    """
    for ease, bent in (*((ease, 1.0) for ease in eases), (0.0, 1.0), (0.0, 0.0)):
        curve = _spline(np.array(rope, np.float64, order="C"), parts, ease, bent)
        crossings = find_crossings(curve)
        if crossings.code == code:
            break
    return curve, crossings


@kernel
def _spline(here: Array, parts: int, ease: float, bent: float) -> Array:
    """Return the curve of one of `smooth_curve`'s tries; it is straight between beads if not bent.

    Args:
        here: float64 (n, 3); changed.
    """
    n, curve = len(here), np.empty((len(here) * parts, 3))
    eased, slope = np.empty(n), np.empty(n)
    for axis in range(3):
        p = here[:, axis]  # i - 1 is before i, and i + 1 - n after it, as negative indices wrap
        for _ in range(2 if ease else 0):
            for i in range(n):
                eased[i] = p[i] + ease * (p[i - 1] + p[i + 1 - n] - 2 * p[i])
            for i in range(n):
                p[i] = eased[i]
        for i in range(n):
            step = p[i + 1 - n] - p[i]
            slope[i] = step - 0.5 * bent * (step - (p[i] - p[i - 1]))
        for i in range(n):
            step = p[i + 1 - n] - p[i]
            end = step + bent * (slope[i + 1 - n] - step)
            # the cubic through here and the next vertex, with these slopes at its ends
            square, cube = 3 * step - 2 * slope[i] - end, slope[i] + end - 2 * step
            for k in range(parts):
                t = k / parts
                curve[i * parts + k, axis] = p[i] + t * (slope[i] + t * (square + t * cube))
    return curve


def _paint(
    rope: Array, centre: Array, config: PictureConfig, colours: Array, background: RGB, gap: float
) -> NDArray[np.uint8]:
    """Paint a rope, whose beads have `colours`, with `centre` in the middle of the picture.

    `gap` is the width of the bands at crossings, in widths of the rope.
    """
    curve, crossings = smooth_curve(rope, find_crossings(rope).code, _PARTS)
    size, count = config.size, len(curve)
    # row by row: 60 times as fast as filling every pixel with three numbers
    picture = np.full((1, size, 3), background, dtype=np.uint8).repeat(size, axis=0)
    (line,), depths = in_picture(curve[None], config, centre)
    reaches = _reaches(curve, crossings, config.drawn_radius, gap)
    bands = np.ones((crossings.nx, 5))
    bands[:, 0], bands[:, 1], bands[:, 2] = crossings.over_place, reaches, gap * line[0, 3]
    for band, under, reach in zip(bands, crossings.under_place, reaches, strict=True):
        off = np.abs(np.arange(count) - under)
        band[3] = line[np.minimum(off, count - off) <= reach + 3.0, 2].max()
    paint(line[None], depths, np.repeat(colours, _PARTS, axis=0), bands, picture[None])
    return picture


def _reaches(curve: Array, crossings: Crossings, radius: float, gap: float) -> Array:
    """Return the length of each crossing's band on either side, in pieces of the curve."""
    step = (np.roll(curve, -1, axis=0) - curve)[:, :2]
    length = np.linalg.norm(step, axis=1)
    over, under = (
        place.astype(np.intp) % len(curve)
        for place in (crossings.over_place, crossings.under_place)
    )
    # two strips of half-widths w (under) and W (band) at angle a meet on a parallelogram that
    # reaches (w + W |cos a|) / |sin a| along the band
    product = np.maximum(length[over] * length[under], 1e-12)
    sine = (step[over, 0] * step[under, 1] - step[over, 1] * step[under, 0]) / product
    cosine = (step[over] * step[under]).sum(axis=1) / product
    along = radius * (1 + gap * np.abs(cosine)) / np.maximum(np.abs(sine), 1e-3)
    return np.minimum(along / length.mean() + 0.5, _REACH * _PARTS)


def _arrow(picture: NDArray[np.uint8], start: Array, end: Array) -> None:
    """Draw an arrow with an outline, so that it is visible on the rope."""
    near, far = ((round(float(x)), round(float(y))) for x, y in (start, end))
    for colour, thick in ((BACKGROUND, 5), (_PULL, 2)):
        cv2.circle(picture, near, thick + 2, colour, cv2.FILLED, cv2.LINE_AA)
        cv2.arrowedLine(picture, near, far, colour, thick, cv2.LINE_AA, tipLength=0.3)


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
        _letter(below, line, 6, _TEXT * (number + 1) - 2, letters)
    whole = np.concatenate([frame, below])
    if outcome:
        colour = Film.OUTCOMES[outcome]
        cv2.putText(whole, outcome, (12, high - 16), _FONT, 1.2, colour, 2, cv2.LINE_AA)
        cv2.rectangle(whole, (2, 2), (wide - 3, len(whole) - 3), colour, 4)
    return whole


def _letter(picture: NDArray[np.uint8], text: str, x: int, y: int, size: float = _LETTERS) -> None:
    cv2.putText(picture, text, (x, y), _FONT, size, _PALE, 1, cv2.LINE_AA)


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
            self._av = MissingExtra.imported("av", "video", "a video that is no .gif")

    def write(self, frames: Sequence[NDArray[np.uint8]]) -> None:
        """Write frames, RGB and of equal size; the write is atomic."""
        with atomic_write(self._path) as temporary:
            if self._kind in _CODECS:
                return _encode(self._av, temporary, frames, *_CODECS[self._kind])
            from PIL import Image  # here, since diagrams alone need none

            first, *others = map(Image.fromarray, frames)
            told, lasting = Counts.over(others, _WRITING), 1000 // FRAMES_PER_SECOND
            first.save(temporary, save_all=True, append_images=told, duration=lasting, loop=0)

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
        drawing: dict[str, Any] = {"size": _HALF, "side": side or Film.side([points, goal], views)}
        halves = [
            np.concatenate([draw_diagram(rope, view=view, pull=arrow, **drawing) for view in views])
            for rope, arrow in ((points, pull), (goal, None))
        ]
        codes = [str(label(rope)) or "the plain loop" for rope in (points, goal)]
        lines = [heading, f"now   {codes[0]}", f"goal  {codes[1]}"]
        frame = _captioned(np.concatenate(halves, axis=1), lines, outcome)
        for column, name in ((0, "now"), (_HALF, "goal")):
            _letter(frame, name, column + 12, _TEXT + 6)
        return frame

    @staticmethod
    def side(ropes: Sequence[Array], views: Sequence[str] = ("top",)) -> float:
        """Return the side, metres, in which every rope with its arrow fits in every view."""
        return 1.2 * max(_side_of(seen_from(view, rope)) for rope in ropes for view in views)

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
        shown = list[NDArray[np.uint8]]()
        for rope, heading, pull, outcome in zip(
            ropes, headings, [*pulls, None], outcomes, strict=True
        ):
            shown.append(Film.frame(rope, goal, heading, pull, outcome, views, side))
            Counts.end_item()
        return shown + shown[-1:] * FRAMES_PER_SECOND


def _encode(
    av: Any, path: Path, frames: Sequence[Array], encoder: str, options: dict[str, str]
) -> None:
    with av.open(f"file:{path}", "w") as film:  # what stands before a colon would be a protocol
        stream = film.add_stream(encoder, rate=FRAMES_PER_SECOND, options=options)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"  # the only pixel format that all browsers play
        for frame in Counts.over(frames, _WRITING):
            film.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        film.mux(stream.encode(None))  # what the encoder still holds
