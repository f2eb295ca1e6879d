"""Rows of a perception table: a configuration, what follows from it, and its picture.

The same rows give the same bytes on any worker.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Stream
from knotgym.datasets.image_table import COLUMNS, encode, parquet, table_of
from knotgym.quality import LEGIBLE, ease, grade_of
from knotgym.rendering import APPEARANCES, AppearanceConfig, Drawn, drawer_of, own_columns
from knotgym.rope import Array
from knotgym.states import STATES, RopeAtRest

_CODES = STATES.only(*("gauss_code", "gauss_code_chiral", "pd_code", "dt_code", "nx", "knot"))


class PictureRow(NamedTuple):
    """A picture to render.

    Attributes:
        points: float64 (beads, 3), metres.
        split: one of IMAGE_SPLITS.
        source: as in `image_table.COLUMNS`; `seed` and `row` seed the appearance.
        camera: tilt and heading of the camera in whose axes the points are, degrees.
    """

    points: Array
    split: str
    source: dict[str, Any]
    camera: tuple[float, float] = (0.0, 0.0)


def drawn(rows: Sequence[PictureRow], config: AppearanceConfig) -> dict[str, NDArray[np.uint8]]:
    """Render rows; the result has the bytes of their Parquet file."""
    table = table_of([record(row, config) for row in rows])
    return {"parquet": np.frombuffer(parquet(table), dtype=np.uint8)}


def record(row: PictureRow, config: AppearanceConfig) -> dict[str, Any]:
    """Return all columns of a row by name, `image` as PNG bytes."""
    source = row.source
    rng = Stream.IMAGE_APPEARANCE.generator(source["seed"], source["row"])
    drawn = drawer_of(config.name).sampled(row.points, config, rng, row.camera)
    return {
        **derived(RopeAtRest(row.points), drawn),
        "points": row.points.ravel().tolist(),
        "appearance": {name: getattr(drawn.look, name) for name in COLUMNS["appearance"]},
        "source": source,
        "split": row.split,
    }


def derived(rope: RopeAtRest, drawn: Drawn) -> dict[str, Any]:
    """Return the columns that follow from a configuration and its picture."""
    crossings = rope.crossings
    positions = *drawn.pixels.T, crossings.over_place, crossings.under_place
    columns = [column.tolist() for column in (*positions, crossings.sign)]
    names = ("x", "y", "over_place", "under_place", "sign")
    kinds = own_columns(drawn.look.name)
    own = {
        name: encode(value) if kinds[name]["type"] == "image" else value
        for name, value in drawn.columns.items()
    }
    return {
        **_CODES.derive(rope),
        "crossings": [dict(zip(names, one, strict=True)) for one in zip(*columns, strict=True)],
        "accepted": not LEGIBLE.faults(rope.quality, crossings.nx),
        "grade": grade_of(ease(rope.quality, LEGIBLE)),
        "quality": asdict(rope.quality),
        "image": encode(drawn.image, APPEARANCES[drawn.look.name].compression),
        **own,
    }


def redrawn(points: Array, row: Mapping[str, Any]) -> Drawn:
    """Draw the picture of a row, as `read_rows` gives it, again."""
    drawer = drawer_of(row["appearance"]["name"])
    return drawer.drawn(points, drawer.read(row))
