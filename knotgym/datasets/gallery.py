"""A contact sheet of rope pictures, each with its code under it."""

from __future__ import annotations

import os
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.atomic_files import atomic_write
from knotgym.datasets.states import InvalidStates, States
from knotgym.rendering.picture import PictureError

_EDGE, _TEXT = 6, 30  # pixels round a tile, and below its picture
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
        captions: up to two lines of text a picture.
        colours: RGB of each caption; white by default.
        columns: pictures in a row.

    Returns:
        uint8 (height, width, 3).
    """
    size = images.shape[1]
    wide, high = size + 2 * _EDGE, size + 2 * _EDGE + _TEXT
    rows = -(-max(1, len(images)) // columns)
    sheet = np.full((rows * high, columns * wide, 3), _GREY, dtype=np.uint8)
    for k, (image, lines) in enumerate(zip(images, captions, strict=True)):
        top, left = k // columns * high + _EDGE, k % columns * wide + _EDGE
        sheet[top : top + size, left : left + size] = image
        colour = colours[k] if colours else _WHITE
        for number, line in enumerate(lines[:2]):
            wide_at_full = cv2.getTextSize(line, cv2.FONT_HERSHEY_SIMPLEX, 0.4, 1)[0][0]
            scale = min(0.4, 0.4 * size / max(1, wide_at_full))
            at = (left, top + size + 13 + 14 * number)
            cv2.putText(sheet, line, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
    return sheet


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
