"""Contact sheets of all kinds of datasets."""

import os
from collections.abc import Hashable, Sequence
from pathlib import Path

import cv2
import numpy as np

from knotgym.datasets.episode_dataset import EpisodeDataset, columns_of
from knotgym.datasets.episodes import gauss_codes
from knotgym.datasets.image_table import read_table
from knotgym.datasets.located import Located
from knotgym.datasets.png import TILE, Tile, contact_sheet, decode, sample
from knotgym.datasets.state_card import state_tiles
from knotgym.rendering import Film, draw_diagram
from knotgym.states import read_states


def write_episode_gallery(path: Path, datasets: Sequence[Path]) -> None:
    """Write the contact sheet of datasets of episodes as a PNG."""
    path.write_bytes(contact_sheet(_episode_tiles(datasets)))


def write_sheet(path: Path, located: Located) -> str:
    """Write the contact sheet of states, episodes or pictures; return a one-line summary."""
    if located.pictures:
        tiles, count = _picture_tiles(located.pictures)
        what = "pictures"
    elif located.states:
        states = read_states(located.states, images=False)
        tiles, what, count = state_tiles(states), "states", len(states)
    else:
        tiles, what = _episode_tiles(located.episodes), "episodes, each at its end"
        count = sum(len(columns_of(path)) for path in located.episodes)
    path.write_bytes(contact_sheet(tiles))
    return f"{len(tiles)} of {count} {what}" if len(tiles) < count else f"{count} {what}"


def _episode_tiles(datasets: Sequence[Path]) -> list[Tile]:
    """Return the knot diagrams of the final states of a sample of SHOWN episodes.

    The sample is even over datasets, crossings of goals, and outcomes.
    """
    every, strata, tiles = list[tuple[EpisodeDataset, int]](), list[Hashable](), list[Tile]()
    for number, dataset in enumerate(map(columns_of, datasets)):
        rows = dataset.episodes.episodes
        crossings = np.count_nonzero(rows["goal_visits"], axis=1) // 2
        every += [(dataset, row) for row in range(rows.rows)]
        strata += zip(
            [number] * rows.rows, crossings.tolist(), rows["success"].tolist(), strict=True
        )
    for dataset, row in (every[k] for k in sample(strata)):
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
    rows = sample([*zip(pictures["split"].to_pylist(), pictures["nx"].to_pylist(), strict=True)])
    tiles = [
        Tile(
            np.asarray(cv2.resize(decode(row["image"]["bytes"]), (TILE, TILE)), np.uint8),
            (row["gauss_code_chiral"] or "loop", f"{row['split']}  nx {row['nx']}"),
        )
        for row in pictures.take(rows).to_pylist()
    ]
    return tiles, len(pictures)
