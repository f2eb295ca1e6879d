"""Contact sheets: knot diagrams of states and of final states of episodes, and pictures."""

import os
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.common import Counts
from knotgym.datasets.episode_dataset import EpisodeDataset, columns_of
from knotgym.datasets.episodes import gauss_codes
from knotgym.datasets.image_table import decode, encode, read_table
from knotgym.rendering import draw_diagram
from knotgym.states import SPLITS, States, read_states

if TYPE_CHECKING:
    from knotgym.datasets.located import Located

SHOWN, MOST_STATES = 64, 400  # at most so many episodes or pictures, and states, in a gallery
_WHITE = (225, 225, 225)
_TILE, _EDGE, _LINE = 192, 6, 14  # pixels: tile, margin, height of a line of text
_FONT, _LETTERS, _GREY = cv2.FONT_HERSHEY_SIMPLEX, 0.4, (40, 40, 40)


class Tile(NamedTuple):
    """A picture in a contact sheet."""

    picture: NDArray[np.uint8]  # uint8 (size, size, 3), RGB
    captions: Sequence[str]  # lines of text below
    # RGB of the text. Unless it is _WHITE, the picture gets a frame of this colour.
    colour: tuple[int, int, int] = _WHITE


def _contact_sheet(tiles: Sequence[Tile], columns: int = 8) -> NDArray[np.uint8]:
    """Arrange pictures of one size in rows of at most `columns`: uint8 (height, width, 3), RGB."""
    size = len(tiles[0].picture) if tiles else _TILE
    wide = size + 2 * _EDGE
    high = wide + 2 + _LINE * max([2, *(len(one.captions) for one in tiles)])
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
    return sheet


def write_gallery(path: Path, shown: States | Sequence[Path]) -> None:
    """Write the contact sheet of states, or of datasets of episodes, as a PNG."""
    tiles = _state_tiles(shown) if isinstance(shown, States) else _episode_tiles(shown)
    path.write_bytes(encode(_contact_sheet(tiles)))


def write_sheet(path: Path, located: "Located") -> str:
    """Write the contact sheet of states, episodes or pictures; return a one-line summary."""
    if located.pictures:
        tiles, count = _picture_tiles(located.pictures)
        what = "pictures"
    elif located.states:
        states = read_states(located.states, images=False)
        tiles, what, count = _state_tiles(states), "states", len(states)
    else:
        tiles, what = _episode_tiles(located.episodes), "episodes, each at its end"
        count = sum(columns_of(one).episodes.episodes.rows for one in located.episodes)
    path.write_bytes(encode(_contact_sheet(tiles)))
    return f"{len(tiles)} of {count} {what}" if len(tiles) < count else f"{count} {what}"


def _state_tiles(states: States) -> list[Tile]:
    """Return the knot diagrams of states, sorted by crossings, code and split.

    Of more than MOST_STATES they are a sample, even over crossings and splits.
    """
    kinds = [*zip(states.nx.tolist(), states.split.tolist(), strict=True)]
    order = sorted(
        _sample(kinds, MOST_STATES),
        key=lambda i: (states.nx[i], states.gauss_code[i], not SPLITS[states.split[i]].trains),
    )
    captions = (
        (states.gauss_code_chiral[i] or "loop", f"nx {states.nx[i]}  {states.split[i]}  row {i}")
        for i in order
    )
    told = Counts.over(order, "drawing diagrams")
    return [
        Tile(draw_diagram(states.points[i]), words) for i, words in zip(told, captions, strict=True)
    ]


def _episode_tiles(datasets: Sequence[Path]) -> list[Tile]:
    """Return the knot diagrams of the final states of a sample of SHOWN episodes.

    The sample is even over datasets, crossings of goals, and outcomes.
    """
    from knotgym.rendering import Film  # here, as states need no films

    every, strata, tiles = list[tuple[EpisodeDataset, int]](), list[Hashable](), list[Tile]()
    for number, dataset in enumerate(map(columns_of, datasets)):
        rows = dataset.episodes.episodes
        crossings = np.count_nonzero(rows["goal_visits"], axis=1) // 2
        every += [(dataset, row) for row in range(rows.rows)]
        strata += zip(
            [number] * rows.rows, crossings.tolist(), rows["success"].tolist(), strict=True
        )
    for dataset, row in (every[k] for k in _sample(strata)):
        (rows, steps), last = dataset.episodes, dataset.episodes.last()[row]
        both = steps["visits"][[last]], rows["goal_visits"][[row]]
        code, goal = (str(gauss_codes(visits)[0]) or "loop" for visits in both)
        outcome = "reached" if rows["success"][row] else "failed"
        end = outcome if rows["success"][row] else f"{outcome}, goal {goal}"
        name = f"{dataset.name}  " if len(datasets) > 1 else ""
        captions = (code, f"{name}episode {row}", end)
        points = steps["observation"][last].astype(np.float64)
        tiles.append(Tile(draw_diagram(points), captions, Film.OUTCOMES[outcome]))
    return tiles


def _picture_tiles(table: str | os.PathLike[str]) -> tuple[list[Tile], int]:
    """Return a sample of SHOWN pictures of a perception table, even over splits and nx, of all."""
    pictures = read_table(table, columns=["image", "gauss_code_chiral", "split", "nx"])
    rows = _sample([*zip(pictures["split"].to_pylist(), pictures["nx"].to_pylist(), strict=True)])
    tiles = [
        Tile(
            np.asarray(cv2.resize(decode(row["image"]["bytes"]), (_TILE, _TILE)), np.uint8),
            (row["gauss_code_chiral"] or "loop", f"{row['split']}  nx {row['nx']}"),
        )
        for row in pictures.take(rows).to_pylist()
    ]
    return tiles, len(pictures)


def _sample(strata: Sequence[Hashable], most: int = SHOWN) -> list[int]:
    """Choose at most `most` rows, as many of each stratum as possible, evenly spaced in it.

    >>> _sample(["a", "b", "a", "a"], 2), _sample([3, 3, 1], 9)
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
