"""Rows of a perception table: a configuration, what follows from it, and its picture.

The same rows give the same bytes on any worker.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.common import Stream, generator
from knotgym.datasets.image_table import encode, parquet, table_of
from knotgym.quality import LEGIBLE, ease, grade_of
from knotgym.rendering import (
    Appearance,
    AppearanceConfig,
    Photo,
    Shot,
    appearance,
    crossing_pixels,
    drawn_photo,
    render,
    take,
)
from knotgym.rope import Array
from knotgym.states import STATES, RopeAtRest
from knotgym.topology import DIAGRAM, canonical

_RGB = ("first", "last", "background")
_OF_PHOTOS = {one.name for one in fields(Photo)} - {one.name for one in fields(Appearance)}
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
    rng = generator(Stream.IMAGE_APPEARANCE, source["seed"], source["row"])
    if config.style == "photo":
        size = config.sizes[int(rng.integers(len(config.sizes)))]
        marked = bool(rng.random() < config.marked)
        shot = drawn_photo(row.points, size, rng, *row.camera, marked=marked)
        look: Appearance = shot.look
    else:
        shot, look = None, appearance(row.points, config, rng)
    return {
        **derived(RopeAtRest(row.points), look, shot),
        "points": row.points.ravel().tolist(),
        "appearance": {one.name: getattr(look, one.name) for one in fields(Appearance)},
        "source": source,
        "split": row.split,
    }


def derived(rope: RopeAtRest, look: Appearance, shot: Shot | None = None) -> dict[str, Any]:
    """Return the columns that follow from a configuration and its appearance.

    Args:
        rope: the configuration.
        look: the appearance.
        shot: the photo, if it was taken already.
    """
    points, crossings = rope.points, rope.crossings
    if isinstance(look, Photo):
        shot = shot or take(points, look)
        pixels, image, more = shot.pixels, shot.image, _answers(shot)
    else:
        pixels, more = crossing_pixels(crossings, points, look.picture()), {}
        image = render(points, look)
    positions = pixels[:, 0], pixels[:, 1], crossings.over_place, crossings.under_place
    columns = [column.tolist() for column in (*positions, crossings.sign)]
    names = ("x", "y", "over_place", "under_place", "sign")
    return {
        **_CODES.derive(rope),
        "crossings": [dict(zip(names, one, strict=True)) for one in zip(*columns, strict=True)],
        "accepted": not LEGIBLE.faults(rope.quality, crossings.nx),
        "grade": grade_of(ease(rope.quality, LEGIBLE)),
        "quality": asdict(rope.quality),
        "image": encode(image, 3 if more else 9),
        **more,
    }


def _answers(shot: Shot) -> dict[str, Any]:
    """Return the columns of photos alone."""
    boxes = []
    for strand in range(1, max(2 * shot.crossings.nx, 1) + 1):
        box = cv2.boundingRect((shot.strands == strand).view(np.uint8))
        boxes.append(
            dict(zip(("strand", "x", "y", "width", "height"), (strand, *box), strict=True))
        )
    measured = {name: getattr(shot, name) for name in ("contrast", "order", "region")}
    own = {name: value for name, value in asdict(shot.look).items() if name in _OF_PHOTOS}
    return {
        "canonical_code": str(canonical(shot.crossings.code, DIAGRAM)),
        "strands": encode(shot.strands),
        "boxes": boxes,
        "line": shot.line.ravel().tolist(),
        "photo": {
            **own,
            "ground": list(shot.look.ground),
            "rope_width": 2 * shot.look.radius,
            **measured,
        },
    }


def appearance_of(row: Mapping[str, Any]) -> Appearance:
    """Read the appearance of a picture from its row, as `read_rows` gives it."""
    look = row["appearance"] | {name: tuple(row["appearance"][name]) for name in _RGB}
    if "photo" not in row:
        return Appearance(**look)
    own = {name: row["photo"][name] for name in _OF_PHOTOS}
    return Photo(**look | own | {"ground": tuple(own["ground"])})
