"""Read the pictures of a table with a sign of progress, and draw a page of misread ones."""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.datasets import read_rows
from knotgym.runs import Progress

# picture (size, size, 3), true code, code read
Misread = tuple[NDArray[np.uint8], str, str]


def shown_rows(
    folder: Path, split: str | None, count: int | None, columns: Sequence[str] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield the first `count` rows of a split, or all; show on standard error how many they are."""
    with Progress(lines=False) as progress:
        rows = itertools.islice(read_rows(folder, split, columns), count)
        for number, row in enumerate(rows, 1):
            progress.stage(f"picture {number}" + (f" of {count}" if count else ""))
            yield row


def page(
    missed: list[Misread], path: Path, columns: int = 5, rows: int = 8, side: int = 256
) -> None:
    """Draw the first misread pictures, at least one, with true code (white) and code read (red)."""
    tiles = []
    for picture, code, read in missed[: rows * columns]:
        tile = np.zeros((side + 40, side, 3), dtype=np.uint8)
        tile[:side] = cv2.resize(picture, (side, side), interpolation=cv2.INTER_NEAREST)
        for line, (text, colour) in enumerate(((code, (255, 255, 255)), (read, (255, 90, 90)))):
            cv2.putText(
                tile,
                text or "loop",
                (2, side + 14 + 18 * line),
                cv2.FONT_HERSHEY_SIMPLEX,
                0.36,
                colour,
                1,
                cv2.LINE_AA,
            )
        tiles.append(tile)
    tiles += [np.zeros((side + 40, side, 3), dtype=np.uint8)] * (-len(tiles) % columns)
    cv2.imwrite(
        str(path),
        np.concatenate(
            [np.concatenate(tiles[k : k + columns], axis=1) for k in range(0, len(tiles), columns)]
        )[..., ::-1],
    )
