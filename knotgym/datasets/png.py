"""Pictures as PNG files, without loss, and contact sheets of many of them."""

import struct
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidFile

SHOWN = 64  # pictures in a contact sheet, at most, if no other number is given
_WHITE = (225, 225, 225)
TILE, _EDGE, _LINE = 192, 6, 14  # pixels: tile, margin, height of a line of text
_FONT, _LETTERS, _GREY = cv2.FONT_HERSHEY_SIMPLEX, 0.4, (40, 40, 40)
_LARGEST = 4096  # pixels, side of the largest picture that is decoded
_PNG = b"\x89PNG\r\n\x1a\n"


def encode(image: NDArray[np.uint8], *, grained: bool = False) -> bytes:
    """Encode a picture, uint8 (size, size, 3), RGB, or (size, size), as PNG.

    Flat colours are stored as they are, in runs: a thirtieth of the time of zlib's level 9, and an
    eighth smaller. Where each pixel differs (`grained`), rows are stored as differences, at level
    1: less than half the time of level 3, and a fourteenth larger.
    """
    png, flags = cv2.IMWRITE_PNG_FILTER, [cv2.IMWRITE_PNG_COMPRESSION, 1]
    if grained:
        flags += [png, cv2.IMWRITE_PNG_FILTER_UP]
    else:
        runs = cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE
        flags += [png, cv2.IMWRITE_PNG_FILTER_NONE, *runs]
    stored = image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1])
    done, data = cv2.imencode(".png", stored, flags)
    if not done:
        raise InvalidFile(f"a picture is uint8 (size, size, 3), got {image.dtype} {image.shape}")
    return bytes(data)


def decode(data: bytes) -> NDArray[np.uint8]:
    """Decode a PNG of at most _LARGEST pixels a side to uint8 (size, size, 3), RGB."""
    if len(data) < 33 or data[:8] != _PNG:
        raise InvalidFile(f"{len(data)} bytes that aren't a PNG picture")
    width, height = struct.unpack(">II", data[16:24])
    if not (0 < width <= _LARGEST and 0 < height <= _LARGEST):
        raise InvalidFile(f"a picture has at most {_LARGEST} pixels a side, got {width} x {height}")
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise InvalidFile(f"{len(data)} bytes that aren't a PNG picture")
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)


class Tile(NamedTuple):
    """A picture in a contact sheet."""

    picture: NDArray[np.uint8]  # uint8 (size, size, 3), RGB
    captions: Sequence[str]  # lines of text below
    # RGB of the text. Unless it is _WHITE, the picture gets a frame of this colour.
    colour: tuple[int, int, int] = _WHITE


def contact_sheet(tiles: Sequence[Tile], columns: int = 8) -> bytes:
    """Arrange pictures of one size in rows of at most `columns`; return a PNG."""
    size = len(tiles[0].picture) if tiles else TILE
    wide = size + 2 * _EDGE
    high = wide + 2 + _LINE * max([2, *(len(tile.captions) for tile in tiles)])
    columns = max(1, min(columns, len(tiles)))
    rows = -(-max(1, len(tiles)) // columns)
    sheet = np.full((rows * high, columns * wide, 3), _GREY, dtype=np.uint8)
    for k, tile in enumerate(tiles):
        top, left = k // columns * high + _EDGE, k % columns * wide + _EDGE
        if tile.colour != _WHITE:
            corner = (left + size + 1, top + size + 1)
            cv2.rectangle(sheet, (left - 2, top - 2), corner, tile.colour, 2)
        sheet[top : top + size, left : left + size] = tile.picture
        for number, line in enumerate(tile.captions):
            # long lines are written smaller, so that they fit below their picture
            width = int(cv2.getTextSize(line, _FONT, _LETTERS, 1)[0][0])
            scale = min(_LETTERS, _LETTERS * size / max(1, width))
            at = (left, top + size + 15 + _LINE * number)
            cv2.putText(sheet, line, at, _FONT, scale, tile.colour, 1, cv2.LINE_AA)
    return encode(sheet)


def sample(strata: Sequence[Hashable], most: int = SHOWN) -> list[int]:
    """Choose at most `most` rows, as many of each stratum as possible, evenly spaced in it.

    >>> sample(["a", "b", "a", "a"], 2), sample([3, 3, 1], 9)
    ([0, 1], [0, 1, 2])
    """
    rows: dict[Hashable, list[int]] = {}
    for row, stratum in enumerate(strata):
        rows.setdefault(stratum, []).append(row)
    chosen, left = list[int](), min(most, len(strata))
    # the smallest first, so that what they leave goes to the others
    for number, stratum_rows in enumerate(sorted(rows.values(), key=len)):
        count = min(len(stratum_rows), left // (len(rows) - number))
        chosen += [stratum_rows[k * len(stratum_rows) // count] for k in range(count)]
        left -= count
    return sorted(chosen)
