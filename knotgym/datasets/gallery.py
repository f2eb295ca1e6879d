"""A contact sheet of rope pictures, each with its code under it."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.atomic_files import atomic_write
from knotgym.datasets.states import InvalidStates, States
from knotgym.rendering.picture import PictureError

_EDGE, _LINE = 6, 14  # pixels round a tile, and of a line of text below its picture
_FONT, _LETTERS = cv2.FONT_HERSHEY_SIMPLEX, 0.4
_GREY, _WHITE = (40, 40, 40), (225, 225, 225)


def contact_sheet(
    images: NDArray[np.uint8],
    captions: Sequence[Sequence[str]],
    colours: Sequence[tuple[int, int, int]] | None = None,
    columns: int = 8,
) -> NDArray[np.uint8]:
    """Lay pictures out in rows.

    Args:
        images: uint8 (n, size, size, 3).
        captions: lines of text of each picture; a long one goes on in the next line.
        colours: RGB of each caption; white by default.
        columns: pictures in a row.

    Returns:
        uint8 (height, width, 3).
    """
    size = images.shape[1]
    wrapped = [[part for line in lines for part in _wrapped(line, size)] for lines in captions]
    text = 2 + _LINE * max(2, *map(len, wrapped)) if wrapped else 0
    wide, high = size + 2 * _EDGE, size + 2 * _EDGE + text
    rows = -(-max(1, len(images)) // columns)
    sheet = np.full((rows * high, columns * wide, 3), _GREY, dtype=np.uint8)
    for k, (image, lines) in enumerate(zip(images, wrapped, strict=True)):
        top, left = k // columns * high + _EDGE, k % columns * wide + _EDGE
        sheet[top : top + size, left : left + size] = image
        colour = colours[k] if colours else _WHITE
        for number, line in enumerate(lines):
            scale = min(_LETTERS, _LETTERS * size / max(1, _width(line)))
            at = (left, top + size + 13 + _LINE * number)
            cv2.putText(sheet, line, at, _FONT, scale, colour, 1, cv2.LINE_AA)
    return sheet


def _wrapped(line: str, width: int) -> list[str]:
    """A line of text in lines of at most `width` pixels, parted after commas and spaces."""
    parts = [""]
    for word in re.split("(?<=[, ])", line):
        if parts[-1] and _width(parts[-1] + word.rstrip()) > width:
            parts.append("")
        parts[-1] += word
    return parts


def _width(line: str) -> int:
    """Of a line of text, pixels."""
    return int(cv2.getTextSize(line, _FONT, _LETTERS, 1)[0][0])


def write_gallery(path: str | os.PathLike[str], states: States, columns: int = 8) -> None:
    """Write a contact sheet of every state, by crossings and code, train before test, as PNG."""
    if states.image is None:
        raise InvalidStates("a gallery needs states read with their images")
    order = sorted(
        range(len(states)),
        key=lambda i: (states.nx[i], states.gauss_code[i], states.split[i] != "train"),
    )
    captions = [
        (states.gauss_code_chiral[i] or "loop", f"nx {states.nx[i]}  {states.split[i]}  row {i}")
        for i in order
    ]
    columns = min(columns, max(1, len(order)))
    write_png(path, contact_sheet(states.image[order], captions, columns=columns))


def write_png(path: str | os.PathLike[str], image: NDArray[np.uint8]) -> None:
    """Write an RGB picture, uint8 (height, width, 3), whole or not at all."""
    encoded, data = cv2.imencode(".png", image[..., ::-1])
    if not encoded:
        raise PictureError(f"no PNG can be made of an array of shape {image.shape}")
    with atomic_write(path) as temporary:
        temporary.write_bytes(data.tobytes())
