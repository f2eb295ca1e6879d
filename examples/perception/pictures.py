"""Read the pictures of a table with a sign of progress, and draw a page of misread ones."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.datasets import read_rows
from knotgym.runs import Progress

# picture (size, size, 3), true code, code read
Misread = tuple[NDArray[np.uint8], str, str]


COLUMNS, ROWS, SIDE = 5, 8, 256  # of a page, and pixels of a picture on it
WHITE, RED = (255, 255, 255), (255, 90, 90)


def shown_rows(folder: Path, split: str | None, count: int | None) -> Iterator[dict[str, Any]]:
    """Yield the first `count` rows of a split, or all; show on standard error how many they are."""
    with Progress(lines=False) as progress:
        rows = itertools.islice(read_rows(folder, split), count)
        for number, row in enumerate(rows, 1):
            progress.stage(f"picture {number}" + (f" of {count}" if count else ""))
            yield row


def page(missed: list[Misread], path: Path) -> None:
    """Draw the first misread pictures, at least one, with true code (white) and code read (red)."""
    tiles = []
    for picture, code, read in missed[: ROWS * COLUMNS]:
        tile = np.zeros((SIDE + 40, SIDE, 3), dtype=np.uint8)
        tile[:SIDE] = cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
        for text, down, colour in ((code, 14, WHITE), (read, 32, RED)):
            font = cv2.FONT_HERSHEY_SIMPLEX, 0.36, colour, 1, cv2.LINE_AA
            cv2.putText(tile, text or "loop", (2, SIDE + down), *font)
        tiles.append(tile)
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % COLUMNS)
    lines = [np.concatenate(tiles[k : k + COLUMNS], 1) for k in range(0, len(tiles), COLUMNS)]
    cv2.imwrite(str(path), np.concatenate(lines)[..., ::-1])
