"""Draw the picture with which every prompt begins, for the package and the page on prompting.

    python docs/first_picture.py

It shows a plain loop before and after a unit pull along each axis, and a rope with its Gauss code.
Nothing in it comes from a state file, so it can't show a goal.
"""

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array
from knotgym.datasets import encode
from knotgym.rendering import PictureConfig, draw, project
from knotgym.rope import MUJOCO, Rope, simulation
from knotgym.topology import find_crossings

PAGES = Path(__file__).parent

Canvas = NDArray[np.uint8]
Pixel = tuple[float, float]

_PANEL, _TEXT, _GAP = 232, 28, 6  # pixels
_LARGE = 2 * _PANEL  # so that all columns have equal height
_CLOSER = 1.75  # zoom of the rope with its code
_FONT, _WHITE, _GREY = cv2.FONT_HERSHEY_SIMPLEX, (255, 255, 255), (150, 150, 150)
_ARROW = 36.0  # length of the arrow of a unit pull, pixels
# heading, bead pulled, axis of the pull, view
_PULLS = (
    ("pull +x", 0, 0, "top"),
    ("pull +y", 25, 1, "top"),
    ("pull +z, seen from the front", 75, 2, "front"),
)
# the world axes that point right and up in the image of a view
_RIGHT_UP = {"top": (0, 1), "front": (0, 2)}


@lru_cache(maxsize=1)
def first_picture() -> Canvas:
    """Draw the picture, uint8 (height, width, 3), RGB, read-only; the same bytes at every call."""
    columns = [_pull(*pull) for pull in _PULLS]
    rope = _rope_with_code()
    gap = np.full((len(rope), _GAP, 3), 60, dtype=np.uint8)
    parts = [part for column in (*columns, rope) for part in (column, gap)][:-1]
    picture: Canvas = np.concatenate(parts, axis=1)
    picture.setflags(write=False)
    return picture


def example_rope() -> Array:
    """Return the rope whose code the picture shows, float64 (beads, 3), metres."""
    # a curve with two kinks, at whose crossings the strands differ in height
    at = -0.5 + np.linspace(0, 2 * np.pi, 600, endpoint=False)
    flat = np.exp(1j * at) + 0.7 * np.exp(3j * at)
    return Rope().from_curve(np.stack([flat.real, flat.imag, 0.25 * np.cos(at)], axis=1))


def _pull(heading: str, bead: int, axis: int, view: str) -> Canvas:
    """Draw a rope before and after a pull, one above the other, and the action between them."""
    ropes = simulation(MUJOCO)
    before = ropes.points[0].copy()
    force = np.eye(3)[axis]
    action = ropes.actions([bead], force[None])[0]
    ropes.act(action[None])
    config = PictureConfig(size=_PANEL, views=(view,))
    right, up = _RIGHT_UP[view]
    old, new = draw(before, config), _over(ropes.points[0], before, config, (right, up))
    start = _pixel(before[bead], before, config, (right, up))
    toward = np.array([force[right], -force[up]])
    end = (start[0] + _ARROW * toward[0], start[1] + _ARROW * toward[1])
    _arrow(old, start, end)
    _axes(old, "xyz"[right], "xyz"[up])
    _write(old, "before", (8, 18), _GREY)
    _write(new, "after", (8, 18), _GREY)
    numbers = ", ".join(f"{round(value, 2) + 0.0:g}" for value in action.tolist())
    head, below = _lines([heading], _PANEL), _lines([f"[{numbers}]"], _PANEL)
    return np.concatenate([head, old, below, new])


def _over(after: Array, before: Array, config: PictureConfig, right_up: tuple[int, int]) -> Canvas:
    """Draw the rope after a pull, over a grey shade of the rope before it."""
    # the camera follows the rope's middle, so the shade moves the opposite way
    moved = (after.mean(axis=0) - before.mean(axis=0)) * config.zoom * config.size / config.view
    right, up = (round(float(moved[axis])) for axis in right_up)
    shade = draw(before, config).max(axis=2, keepdims=True) // 4
    picture: Canvas = np.maximum(draw(after, config), np.roll(shade, (up, -right), axis=(0, 1)))
    return picture


def _rope_with_code() -> Canvas:
    """Draw the example rope with its first bead and crossings marked, and its code below."""
    points = example_rope()
    config = PictureConfig(size=_LARGE, zoom=_CLOSER)
    picture = draw(points, config)
    found = find_crossings(points)
    middle = np.array([_LARGE / 2, _LARGE / 2])
    # the code numbers crossings by their first visit: take the rank of each crossing's first place
    labels = 1 + np.minimum(found.over_place, found.under_place).argsort().argsort()
    pixels = project(found.over_points, config, points.mean(axis=0))
    for pixel, label in zip(pixels, labels, strict=True):
        outward = (pixel - middle) / np.linalg.norm(pixel - middle)
        place = pixel + 34 * outward
        _write(picture, str(label), (int(place[0]) - 8, int(place[1]) + 8), _WHITE, 0.8)
    beads = project(points[[0, 5]], config, center=points.mean(axis=0))
    outward = (beads[0] - middle) / np.linalg.norm(beads[0] - middle)
    near, far = beads + 18 * outward
    _arrow(picture, (near[0], near[1]), (far[0], far[1]))
    _write(picture, "start: the white bead,", (8, 20), _GREY)
    _write(picture, "then towards red", (8, 40), _GREY)
    head = _lines(["a rope and its Gauss code"], _LARGE)
    return np.concatenate([head, picture, _lines([f"Gauss code: {found.code}"], _LARGE)])


def _pixel(point: Array, points: Array, config: PictureConfig, right_up: tuple[int, int]) -> Pixel:
    """Project a point to a view whose image axes, right and up, are the given world axes."""
    scale = config.zoom * config.size / config.view
    offset = point - points.mean(axis=0)
    return (
        float(config.size / 2 + scale * offset[right_up[0]]),
        float(config.size / 2 - scale * offset[right_up[1]]),
    )


def _arrow(picture: Canvas, start: Pixel, end: Pixel) -> None:
    near, far = ((round(x), round(y)) for x, y in (start, end))
    cv2.arrowedLine(picture, near, far, _WHITE, 2, cv2.LINE_AA, tipLength=0.35)


def _axes(picture: Canvas, right: str, up: str) -> None:
    """Draw two named axes in the lower left corner."""
    x, y = 16, len(picture) - 16
    for end, name, at in (
        ((x + 30, y), right, (x + 34, y + 5)),
        ((x, y - 30), up, (x - 4, y - 36)),
    ):
        cv2.arrowedLine(picture, (x, y), end, _GREY, 1, cv2.LINE_AA, tipLength=0.25)
        _write(picture, name, at, _GREY)


def _lines(lines: list[str], wide: int) -> Canvas:
    """Draw lines of text on black, each shrunk to fit."""
    strip = np.zeros((_TEXT * len(lines), wide, 3), dtype=np.uint8)
    for number, line in enumerate(lines):
        at_full = cv2.getTextSize(line, _FONT, 0.55, 1)[0][0]
        letters = 0.55 * min(1.0, (wide - 12) / max(1, at_full))
        _write(strip, line, (6, _TEXT * number + 19), _WHITE, letters)
    return strip


def _write(
    picture: Canvas,
    text: str,
    at: tuple[int, int],
    colour: tuple[int, int, int],
    letters: float = 0.45,
) -> None:
    cv2.putText(picture, text, at, _FONT, letters, colour, 1, cv2.LINE_AA)


if __name__ == "__main__":
    for folder in (PAGES, PAGES.parent / "knotgym" / "prompting"):
        (folder / "first-picture.png").write_bytes(encode(first_picture()))
