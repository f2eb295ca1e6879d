"""A shard of a perception table: chosen configurations measured, drawn and written; the same bytes
whoever does it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from knotgym.atomic_files import atomic_write, sha256
from knotgym.datasets.image_table import encode, write_rows
from knotgym.difficulty import grade
from knotgym.errors import KnotgymError
from knotgym.quality import Limits, measure, noise_survival
from knotgym.rendering.appearance import Appearance, AppearanceConfig, appearance, render
from knotgym.rendering.picture import crossing_pixels
from knotgym.rope import Array
from knotgym.streams import Stream, generator
from knotgym.topology.crossings import Crossings, find_crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import knot_type
from knotgym.topology.reference_labeller import pyknotid_code

NOISE = 0.015  # of the reset noise that `noise_survival` is measured with: the environment's


class Untrue(KnotgymError, RuntimeError):
    """A label is not what the coordinates say."""


@dataclass(frozen=True, eq=False)
class Row:
    """A picture to be made.

    Attributes:
        points: float64 (beads, 3), metres.
        code: that it must show, with chirality.
        source: as in datasets.images.COLUMNS; `seed` and `row` decide its appearance and its noise
            draws.
    """

    points: Array
    code: GaussCode
    split: str
    source: dict[str, Any]


@dataclass(frozen=True, eq=False)
class TableFile:
    """A file to be written, and a file for its checksum, by which a later sitting knows that it is
    whole.
    """

    path: Path
    seal: Path
    rows: tuple[Row, ...]
    appearance: AppearanceConfig


def write_table_file(shard: TableFile) -> Path:
    """Write a shard unless it is there already, unspoilt; it appears whole.

    Raises:
        Untrue: one of the two labellers reads another code than the row's.
    """
    if not (
        shard.path.is_file()
        and shard.seal.is_file()
        and shard.seal.read_bytes() == sha256(shard.path).encode()
    ):
        write_rows(shard.path, [record(row, shard.appearance) for row in shard.rows])
        with atomic_write(shard.seal) as temporary:
            temporary.write_text(sha256(shard.path))
    return shard.path


def record(row: Row, config: AppearanceConfig) -> dict[str, Any]:
    """Every column of a row by name, `image` as PNG bytes."""
    found, second = find_crossings(row.points), pyknotid_code(row.points)
    if not found.code == second == row.code:
        raise Untrue(
            f"row {row.source['row']} should show {row.code.chiral}; ours reads"
            f" {found.code.chiral}, pyknotid {second.chiral}"
        )
    look = appearance(
        row.points,
        config,
        generator(Stream.IMAGE_APPEARANCE, row.source["seed"], row.source["row"]),
    )
    return {
        **labels(row.points, found, look),
        **measures(row.points, found, row.source),
        **picture(row.points, look),
        "split": row.split,
    }


def labels(points: Array, found: Crossings, look: Appearance) -> dict[str, Any]:
    """The columns that say what is shown, and where in a picture of that appearance."""
    pixels = crossing_pixels(found, points, look.picture())
    columns = pixels[:, 0], pixels[:, 1], found.over_place, found.under_place, found.sign
    return {
        "gauss_code": str(found.code),
        "gauss_code_chiral": found.code.chiral,
        "nx": found.nx,
        "knot": knot_type(found.code),
        "points": points.ravel().tolist(),
        "crossings": [
            {"x": x, "y": y, "over_place": over, "under_place": under, "sign": sign}
            for x, y, over, under, sign in zip(
                *(column.tolist() for column in columns), strict=True
            )
        ],
    }


def measures(points: Array, found: Crossings, source: dict[str, Any]) -> dict[str, Any]:
    """The columns that say how well it can be read, in the published picture, and where it is
    from.
    """
    survival = noise_survival(
        points, NOISE, generator(Stream.IMAGE_NOISE, source["seed"], source["row"])
    )
    limits = Limits()
    quality = measure(points, found)
    values = {**asdict(quality), "noise_survival": survival}
    accepted = not limits.faults(quality, found.nx) and survival >= limits.noise_survival
    return {
        "accepted": accepted,
        "grade": grade(quality, limits),
        "quality": values,
        "source": source,
    }


def picture(points: Array, look: Appearance) -> dict[str, Any]:
    """The picture and how it was drawn."""
    return {
        "image": encode(render(points, look)),
        "appearance": {**asdict(look), **{name: list(getattr(look, name)) for name in _RGB}},
    }


_RGB = ("first", "last", "background")
