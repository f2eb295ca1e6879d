"""Rows of a perception table: how they are made and verified.

The same rows give the same bytes on any worker. Verification believes nothing that is stored: it
compares every row with what follows from its points and its appearance, and looks for what splits
share. Each fault is reported as one line.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from knotgym.common import Counts, InvalidFile, KnotgymError, MissingFile, Stream, one_line
from knotgym.datasets.episode_verification import shared_faults
from knotgym.datasets.image_table import (
    COLUMNS,
    arrow,
    digest_of,
    encode,
    marks_base,
    points_of,
    read_table,
    row_line,
    rows_of,
    shards,
    table_of,
)
from knotgym.datasets.manifest import listed_faults, read_manifest
from knotgym.datasets.state_verification import row_faults as state_faults
from knotgym.quality import Limits, Quality, grade_of
from knotgym.rendering import APPEARANCES, AppearanceConfig, Drawer, Drawn
from knotgym.rope import Array, Rope
from knotgym.states import IMAGE_SPLITS, STATES, RopeAtRest, held_form

_CODES = STATES.only(*("gauss_code", "gauss_code_chiral", "pd_code", "dt_code", "nx", "knot"))
_COLOURS = ("published", "single", "gradient")
# what foreign numbers make the renderer and NumPy raise
_RAISED = (KnotgymError, ValueError, TypeError, ArithmeticError, LookupError, cv2.error)
Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]  # `map`, or that of a pool
_SHARED = ("gauss_code", "nx", "split", "points", "source", "appearance")  # compared by splits
_MOST_DRAWN = 1000.0  # of numbers that a picture is drawn with; larger ones would fill the memory


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


def drawn_table(rows: Sequence[PictureRow], config: AppearanceConfig) -> Any:
    """Render rows as a pyarrow.Table."""
    records = list[dict[str, Any]]()
    for row in rows:
        records.append(record(row, config))
        Counts.end_item()
    return table_of(records)


def record(row: PictureRow, config: AppearanceConfig) -> dict[str, Any]:
    """Return all columns of a row by name, `image` as PNG bytes."""
    source = row.source
    rng = Stream.IMAGE_APPEARANCE.generator(source["seed"], source["row"])
    drawn = Drawer.of(config.name).sampled(row.points, config, rng, row.camera)
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
    kinds = APPEARANCES[drawn.look.name].own_columns
    images = {name for name, kind in kinds.items() if kind["type"] == "image"}
    own = {n: encode(value) if n in images else value for n, value in drawn.columns.items()}
    return {
        **_CODES.derive(rope),
        "crossings": [dict(zip(names, one, strict=True)) for one in zip(*columns, strict=True)],
        "accepted": not Limits().faults(rope.quality, crossings.nx),
        "grade": grade_of(rope.quality.ease()),
        "quality": asdict(rope.quality),
        "image": encode(drawn.image, APPEARANCES[drawn.look.name].compression),
        **own,
    }


def _redrawn(points: Array, row: Mapping[str, Any]) -> Drawn:
    """Draw the picture of a row, as `read_rows` gives it, again."""
    drawer = Drawer.of(row["appearance"]["name"])
    return drawer.drawn(points, drawer.read(row))


def image_faults(path: str | Path, each: Map = map) -> Iterator[str]:
    """Yield the faults of a table: manifest and checksums, then rows and splits.

    Args:
        path: a folder made by `knotgym images`, or a single shard, whose rows alone are checked.
        each: `map` or a pool's, for shards; results keep the order.
    """
    folder = Path(path)
    arrow()
    if folder.is_dir():
        manifest, faults = read_manifest(folder)
        yield from [*faults, *listed_faults(folder, manifest)]
    files = shards(path)
    parts, told = list[Any](), each(_shard_faults, files)
    for faults, part in Counts.over(told, "files of pictures", len(files)):
        yield from faults
        parts += [] if part is None else [part]
    if len(parts) < len(files):  # a fault already
        return
    if len(table := arrow().concat_tables(parts)):
        yield from _split_faults(table)
    else:
        yield f"{folder.name} has no rows"


def _shard_faults(path: Path) -> tuple[list[str], Any]:
    """List the faults of the rows of a shard; return them and the columns that splits share.

    The rows are compared with its `content_sha256`. Of a shard that can't be read, or whose points
    aren't finite, no columns are returned.
    """
    faults, digest = list[str](), hashlib.sha256()
    try:
        table = read_table(path)
    except (InvalidFile, MissingFile) as error:
        return [str(error)], None
    for n, row in enumerate(rows_of(table)):
        try:
            own = list(_row_faults(row))
        except _RAISED as error:
            own = [f"it can't be rendered or measured: {one_line(error)}"]
        faults += [f"{path.name} row {n}: {fault}" for fault in own]
        digest.update(row_line(row))
    if digest_of(table) != digest.hexdigest():
        faults.append(f"{path.name}: its rows were changed after writing (SHA-256 differs)")
    try:
        points_of(table)
    except InvalidFile:
        return faults, None
    return faults, table.select(_SHARED)


def _row_faults(row: Mapping[str, Any]) -> Iterator[str]:
    """Yield the faults of one row, as `read_rows` gives it."""
    if (name := row["appearance"]["name"]) not in APPEARANCES:
        yield f"appearance.name is {name!r}, should be {' or '.join(APPEARANCES)}"
        return
    factors = {
        f"{name}.{one}": value
        for name in ("appearance", *APPEARANCES[row["appearance"]["name"]].own_columns)
        if isinstance(row[name], dict)
        for one, value in row[name].items()
    }
    for name, value in factors.items():
        sized = name == "appearance.size"
        low, high = AppearanceConfig.SIZES if sized else (-_MOST_DRAWN, _MOST_DRAWN)
        numeric = isinstance(value, (int, float)) and name != "appearance.seed"
        if numeric and not low <= value <= high:
            yield f"{name} is {value}, should be {low:g} to {high:g}"
            return
    points = np.array(row["points"], dtype=np.float64).reshape(-1, 3)
    whole = {**row, "points": points}
    yield from state_faults(whole, Rope(), lambda own: derived(own, _redrawn(own.points, row)))
    if (colours := row["appearance"]["colours"]) not in _COLOURS:
        yield f"appearance.colours is {colours!r}, should be {' or '.join(_COLOURS)}"
    if row["split"] not in IMAGE_SPLITS:
        yield f"split is {row['split']!r}, should be {' or '.join(IMAGE_SPLITS)}"
    if missed := Limits.UNAMBIGUOUS.faults(Quality(**row["quality"]), row["nx"]):
        yield f"the code is ambiguous in the picture: {', '.join(missed)}"


def _split_faults(table: Any) -> Iterator[str]:
    """Yield what splits share: near-duplicates and ropes; and codes or nx in the wrong split."""
    split, codes, nx = (np.array(table[name].to_pylist()) for name in ("split", "gauss_code", "nx"))
    sources = table["source"].to_pylist()
    numbers = [source["row"] for source in sources]
    # the ropes of several seeds have the same numbers
    ropes = [(source["seed"], source["rope"]) for source in sources]
    yield from shared_faults(points_of(table), split, ropes, numbers)
    # codes of test-nx have more crossings than any other split's, so they aren't compared
    marked = marks_base(table)
    held, seen = (
        {held_form(code, marked=marked) for code in set(codes[np.isin(split, names)].tolist())}
        for names in (("test-code",), ("train", "test"))
    )
    for code in sorted(held & seen):
        same = "" if marked else ", from another base or in another direction,"
        yield f"code {code or 'loop'}{same} is in test-code and in train or test"
    harder, trained = nx[split == "test-nx"], nx[split == "train"]
    if len(harder) and len(trained) and harder.min() <= trained.max():
        yield "test-nx has pictures with no more crossings than train"
    if len(set(numbers)) != len(numbers):
        yield "two rows have the same number"
