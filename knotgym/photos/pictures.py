"""Pictures of strangers as arrays, and what was read of them drawn on top.

After a change run `pytest tests/photos/test_pictures.py`.
"""

import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from knotgym.common import InvalidFile, one_line, require_regular

MOST_PIXELS = 100_000_000  # of a picture; a larger one is refused before it is decoded
_CALLS_OUT = {"EPS", "WMF"}  # formats that Pillow has other programs draw
_COLOURS = ((70, 230, 90), (70, 160, 255), (255, 110, 230), (250, 220, 60))  # of ropes, RGB
_DOUBT, _LOOSE = (255, 40, 40), (255, 140, 0)


def is_picture(path: Path) -> bool:
    """Return whether a file's name is that of a picture."""
    return Image.registered_extensions().get(path.suffix.lower()) in _formats()


def _formats() -> list[str]:
    Image.init()
    return [name for name in Image.OPEN if name not in _CALLS_OUT]


def open_picture(path: Path) -> NDArray[np.uint8]:
    """Read a picture: uint8 (height, width, 3), RGB, turned as its camera was held.

    What is transparent is white, and of several frames the first is read.

    Raises:
        InvalidFile: it isn't one, is truncated, or is too large.
    """
    try:
        require_regular(path, "picture", InvalidFile)
        with (
            warnings.catch_warnings(action="ignore"),
            Image.open(path, formats=_formats()) as image,
        ):
            if image.width * image.height > MOST_PIXELS:
                raise InvalidFile(
                    f"{path} has {image.width} x {image.height} pixels; at most {MOST_PIXELS:,} are"
                    " read"
                )
            if image.mode.startswith(("I", "F")):  # more than 8 bits of grey
                levels = np.asarray(ImageOps.exif_transpose(image), dtype=np.float64)
                low, high = levels.min(), levels.max()
                grey = 255 * (levels - low) / max(high - low, 1e-9)
                return np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=2)
            turned = ImageOps.exif_transpose(image).convert("RGBA")
            white = Image.new("RGBA", turned.size, "white")
            return np.asarray(Image.alpha_composite(white, turned).convert("RGB"))
    except InvalidFile:
        raise
    except Image.DecompressionBombError as error:
        raise InvalidFile(f"{path} has too many pixels: {one_line(error)}") from error
    except FileNotFoundError as error:
        raise InvalidFile(f"no picture {path}") from error
    except Exception as error:  # Pillow's plugins raise anything
        said = one_line(error)[:150].removesuffix(".")
        raise InvalidFile(f"{path} isn't a picture that can be read: {said}") from error


def overlay(picture: NDArray[np.uint8], reading: Any) -> NDArray[np.uint8]:
    """Draw a `PhotoReading` on its picture: centre lines, crossings with the upper strand on top,
    loose ends in orange, and crossings that are doubtful in red.
    """
    height, width = picture.shape[:2]
    grey = 0.6 * picture.mean(axis=2, keepdims=True) + 60
    shown = np.ascontiguousarray(np.repeat(grey, 3, axis=2).astype(np.uint8))
    thick = max(round(max(height, width) / 250), 1)
    for k, rope in enumerate(reading.ropes):
        line = np.rint(rope.line).astype(np.int32).reshape(-1, 1, 2)
        colour = _COLOURS[k % len(_COLOURS)]
        cv2.polylines(shown, [line], rope.closed, colour, thick, cv2.LINE_AA)
    rows = zip(reading.places, reading.votes, reading.over, strict=True)
    for (x, y), vote, (dx, dy) in rows:
        at, way = np.array([x, y]), 6 * thick * np.array([dx, dy])
        start, end = (tuple(np.rint(place).astype(int).tolist()) for place in (at - way, at + way))
        cv2.line(shown, start, end, (255, 255, 255), 2 * thick, cv2.LINE_AA)
        middle = tuple(np.rint(at).astype(int).tolist())
        colour = _DOUBT if vote < 0.5 else (255, 255, 255)
        cv2.circle(shown, middle, 7 * thick, colour, thick, cv2.LINE_AA)
    for x, y in np.rint(reading.loose).astype(int).tolist():
        cv2.circle(shown, (x, y), 4 * thick, _LOOSE, -1, cv2.LINE_AA)
    return shown
