"""Rows of a perception table: a configuration, what follows from it, and its picture.

The same rows give the same bytes on any worker.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import Failed
from knotgym.common.streams import Stream, generator
from knotgym.datasets.image_table import encode, parquet, table_of
from knotgym.quality.difficulty import grade
from knotgym.quality.limits import LEGIBLE, Quality
from knotgym.rendering.appearance import Appearance, appearance, render
from knotgym.rendering.appearance_config import AppearanceConfig
from knotgym.rendering.picture import crossing_pixels
from knotgym.rope.model import Array
from knotgym.states.derivation import derived_row
from knotgym.topology.crossings import find_crossings
from knotgym.topology.reference_labeller import pyknotid_code

_RGB = ("first", "last", "background")
_QUALITY = "quality/"


class PictureRow(NamedTuple):
    """A picture to render.

    Attributes:
        points: float64 (beads, 3), metres.
        split: one of IMAGE_SPLITS.
        source: as in `image_table.COLUMNS`; `seed` and `row` seed the appearance.
    """

    points: Array
    split: str
    source: dict[str, Any]


def drawn(rows: Sequence[PictureRow], config: AppearanceConfig) -> dict[str, NDArray[np.uint8]]:
    """Render rows; the result has the bytes of their Parquet file."""
    table = table_of([record(row, config) for row in rows])
    return {"parquet": np.frombuffer(parquet(table), dtype=np.uint8)}


def record(row: PictureRow, config: AppearanceConfig) -> dict[str, Any]:
    """Return all columns of a row by name, `image` as PNG bytes.

    Raises:
        Failed: two labellers read different codes.
    """
    source = row.source
    rng = generator(Stream.IMAGE_APPEARANCE, source["seed"], source["row"])
    look = appearance(row.points, config, rng)
    code, second = find_crossings(row.points).code, pyknotid_code(row.points)
    if code != second:
        raise Failed(
            f"row {source['row']}: our labeller reads {code.chiral}, pyknotid reads {second.chiral}"
        )
    return {
        **derived(row.points, look),
        "points": row.points.ravel().tolist(),
        "appearance": {**asdict(look), **{name: list(getattr(look, name)) for name in _RGB}},
        "source": source,
        "split": row.split,
    }


def derived(points: Array, look: Appearance) -> dict[str, Any]:
    """Return the columns that follow from a configuration and its appearance."""
    row, crossings = derived_row(points), find_crossings(points)
    quality = {
        name.removeprefix(_QUALITY): row.pop(name) for name in [*row] if name.startswith(_QUALITY)
    }
    measured = Quality(**quality)
    pixels = crossing_pixels(crossings, points, look.picture())
    positions = pixels[:, 0], pixels[:, 1], crossings.over_place, crossings.under_place
    columns = [column.tolist() for column in (*positions, crossings.sign)]
    names = ("x", "y", "over_place", "under_place", "sign")
    return {
        **row,
        "crossings": [dict(zip(names, one, strict=True)) for one in zip(*columns, strict=True)],
        "accepted": not LEGIBLE.faults(measured, crossings.nx),
        "grade": grade(measured, LEGIBLE),
        "quality": quality,
        "image": encode(render(points, look)),
    }


def appearance_of(column: dict[str, Any]) -> Appearance:
    """Read the appearance of a picture from the column `appearance` of its row."""
    return Appearance(**{**column, **{name: tuple(column[name]) for name in _RGB}})
