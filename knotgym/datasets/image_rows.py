"""Rows of a perception table: label, measure, render and write configurations.

The same rows give the same bytes on any worker.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from knotgym.common.atomic_files import atomic_write, sha256
from knotgym.common.errors import Failed
from knotgym.common.streams import Stream, generator
from knotgym.datasets.image_table import encode, write_rows
from knotgym.envs.tasks import TaskConfig
from knotgym.quality.difficulty import grade
from knotgym.quality.measures import Limits, measure, noise_survival
from knotgym.rendering.appearance import Appearance, appearance, render
from knotgym.rendering.appearance_config import AppearanceConfig
from knotgym.rendering.picture import crossing_pixels
from knotgym.rope.model import Array
from knotgym.topology.crossings import Crossings, find_crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import knot_type
from knotgym.topology.notation import dt_text, pd_text
from knotgym.topology.reference_labeller import pyknotid_code

_RGB = ("first", "last", "background")
NOISE = TaskConfig.reset_noise  # noise level at which `noise_survival` is measured


@dataclass(frozen=True, eq=False)
class Row:
    """A picture to render."""

    points: Array  # float64 (beads, 3), metres
    code: GaussCode  # the Gauss code that it must show, with chirality
    split: str
    # as in `image_table.COLUMNS`; `seed` and `row` seed its appearance and its noise.
    source: dict[str, Any]


@dataclass(frozen=True, eq=False)
class TableFile:
    """A file to write, and a file for its checksum, which shows that it is complete on resume."""

    path: Path
    seal: Path
    rows: tuple[Row, ...]
    appearance: AppearanceConfig


def write_table_file(file: TableFile) -> Path:
    """Write a file of the table atomically, unless it exists with the right checksum."""
    if not (
        file.path.is_file()
        and file.seal.is_file()
        and file.seal.read_bytes() == sha256(file.path).encode()
    ):
        write_rows(file.path, [record(row, file.appearance) for row in file.rows])
        with atomic_write(file.seal) as temporary:
            temporary.write_text(sha256(file.path))
    return file.path


def record(row: Row, config: AppearanceConfig) -> dict[str, Any]:
    """Return all columns of a row by name, `image` as PNG bytes."""
    crossings, second = find_crossings(row.points), pyknotid_code(row.points)
    if not crossings.code == second == row.code:
        raise Failed(
            f"row {row.source['row']} should show {row.code.chiral}, but our labeller reads"
            f" {crossings.code.chiral} and pyknotid reads {second.chiral}"
        )
    look = appearance(
        row.points,
        config,
        generator(Stream.IMAGE_APPEARANCE, row.source["seed"], row.source["row"]),
    )
    return {
        **labels(row.points, crossings, look),
        **measures(row.points, crossings, row.source),
        **picture(row.points, look),
        "split": row.split,
    }


def labels(points: Array, crossings: Crossings, look: Appearance) -> dict[str, Any]:
    """Return the columns that label a configuration, with pixels for this appearance."""
    pixels = crossing_pixels(crossings, points, look.picture())
    positions = crossings.over_place, crossings.under_place
    columns = pixels[:, 0], pixels[:, 1], *positions, crossings.sign
    return {
        "gauss_code": str(crossings.code),
        "gauss_code_chiral": crossings.code.chiral,
        "pd_code": pd_text(crossings.code),
        "dt_code": dt_text(crossings.code),
        "nx": crossings.nx,
        "knot": knot_type(crossings.code),
        "points": points.ravel().tolist(),
        "crossings": [
            {"x": x, "y": y, "over_place": over, "under_place": under, "sign": sign}
            for x, y, over, under, sign in zip(
                *(column.tolist() for column in columns), strict=True
            )
        ],
    }


def measures(points: Array, crossings: Crossings, source: dict[str, Any]) -> dict[str, Any]:
    """Return the columns of origin and of quality, measured in the published picture."""
    survival = noise_survival(
        points, NOISE, generator(Stream.IMAGE_NOISE, source["seed"], source["row"])
    )
    limits = Limits()
    quality = replace(measure(points, crossings), noise_survival=survival)
    accepted = not limits.faults(quality, crossings.nx)
    return {
        "accepted": accepted,
        "grade": grade(quality, limits),
        "quality": asdict(quality),
        "source": source,
    }


def picture(points: Array, look: Appearance) -> dict[str, Any]:
    """Render the picture; return it with its appearance."""
    return {
        "image": encode(render(points, look)),
        "appearance": {**asdict(look), **{name: list(getattr(look, name)) for name in _RGB}},
    }


def appearance_of(column: dict[str, Any]) -> Appearance:
    """Read the appearance of a picture from the column `appearance` of its row."""
    return Appearance(**{**column, **{name: tuple(column[name]) for name in _RGB}})
