"""Contact sheets: knot diagrams of states and of final states of episodes, and pictures."""

import os
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write
from knotgym.common.errors import InvalidInput
from knotgym.datasets.episode_dataset import columns_of
from knotgym.datasets.episodes import gauss_codes
from knotgym.datasets.image_table import decode, read_rows
from knotgym.rendering.diagram import draw_diagram
from knotgym.rendering.video import OUTCOMES
from knotgym.states.state_file import States

SHOWN = 64  # maximum number of episodes or pictures in a gallery
WHITE = (225, 225, 225)
_TILE, _EDGE, _LINE = 192, 6, 14  # pixels: tile, margin, height of a line of text
_FONT, _LETTERS, _GREY = cv2.FONT_HERSHEY_SIMPLEX, 0.4, (40, 40, 40)


class Tile(NamedTuple):
    """A picture in a contact sheet."""

    picture: NDArray[np.uint8]  # uint8 (size, size, 3), RGB
    captions: Sequence[str]  # lines of text below
    # RGB of the text. Unless it is WHITE, the picture gets a frame of this colour.
    colour: tuple[int, int, int] = WHITE


def contact_sheet(tiles: Sequence[Tile], columns: int = 8) -> NDArray[np.uint8]:
    """Arrange pictures of one size in rows of at most `columns`: uint8 (height, width, 3), RGB."""
    size = len(tiles[0].picture) if tiles else _TILE
    wide = size + 2 * _EDGE
    high = wide + 2 + _LINE * max([2, *(len(one.captions) for one in tiles)])
    columns = max(1, min(columns, len(tiles)))
    rows = -(-max(1, len(tiles)) // columns)
    sheet = np.full((rows * high, columns * wide, 3), _GREY, dtype=np.uint8)
    for k, tile in enumerate(tiles):
        top, left = k // columns * high + _EDGE, k % columns * wide + _EDGE
        if tile.colour != WHITE:
            corner = (left + size + 1, top + size + 1)
            cv2.rectangle(sheet, (left - 2, top - 2), corner, tile.colour, 2)
        sheet[top : top + size, left : left + size] = tile.picture
        for number, line in enumerate(tile.captions):
            # long lines are written smaller, so that they fit below their picture
            width = int(cv2.getTextSize(line, _FONT, _LETTERS, 1)[0][0])
            scale = min(_LETTERS, _LETTERS * size / max(1, width))
            at = (left, top + size + 15 + _LINE * number)
            cv2.putText(sheet, line, at, _FONT, scale, tile.colour, 1, cv2.LINE_AA)
    return sheet


def write_gallery(path: str | os.PathLike[str], states: States, columns: int = 8) -> None:
    """Write a PNG contact sheet of all states, sorted by crossings, code and split."""
    order = sorted(
        range(len(states)),
        key=lambda i: (states.nx[i], states.gauss_code[i], states.split[i] != "train"),
    )
    tiles = [
        Tile(
            draw_diagram(states.points[i]),
            (
                states.gauss_code_chiral[i] or "loop",
                f"nx {states.nx[i]}  {states.split[i]}  row {i}",
            ),
        )
        for i in order
    ]
    write_png(path, contact_sheet(tiles, columns))


def write_episode_gallery(
    path: str | os.PathLike[str], datasets: Sequence[Path], columns: int = 8
) -> int:
    """Write a PNG of the final states of the first SHOWN episodes; return how many there are."""
    tiles: list[Tile] = []
    for dataset in datasets:
        opened = columns_of(dataset)
        (own, steps), last = opened.episodes, opened.episodes.last()[: SHOWN - len(tiles)]
        codes = gauss_codes(steps["visits"][last], steps["signs"][last])
        for row, code in enumerate(codes.tolist()):
            outcome = "reached" if own["success"][row] else "failed"
            captions = (code or "loop", f"{opened.name}  episode {row}", outcome)
            points = steps["observation"][last[row]].astype(np.float64)
            tiles.append(Tile(draw_diagram(points), captions, OUTCOMES[outcome]))
    if tiles:
        write_png(path, contact_sheet(tiles, columns))
    return len(tiles)


def write_picture_gallery(
    path: str | os.PathLike[str], table: str | os.PathLike[str], columns: int = 8
) -> int:
    """Write a PNG of the first SHOWN pictures of a perception table; return how many there are."""
    rows = read_rows(table, columns=["image", "gauss_code_chiral", "split"])
    tiles = [
        Tile(
            np.asarray(cv2.resize(decode(row["image"]), (_TILE, _TILE)), np.uint8),
            (row["gauss_code_chiral"] or "loop", row["split"]),
        )
        for row in islice(rows, SHOWN)
    ]
    if tiles:
        write_png(path, contact_sheet(tiles, columns))
    return len(tiles)


def write_png(path: str | os.PathLike[str], image: NDArray[np.uint8]) -> None:
    """Write an RGB picture, uint8 (height, width, 3), atomically."""
    encoded, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not encoded:
        raise InvalidInput(
            f"can't write an array of shape {image.shape} as PNG; it must be (height, width, 3)"
        )
    with atomic_write(path) as temporary:
        temporary.write_bytes(data.tobytes())
