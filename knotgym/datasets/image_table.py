"""Perception tables: labelled pictures of ropes as Parquet files, one row per picture.

A folder holds `data/SPLIT-00000-of-00012.parquet` (`test-code` is written `test_code` there, as
Hugging Face requires), a card and a manifest. Pixel coordinates are those of
`knotgym.rendering.camera`: continuous, x right and y down. Pictures are lossless PNG in the layout
of Hugging Face's Image feature. pyarrow is imported on demand.
"""

import hashlib
import json
import os
import tomllib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import (
    Array,
    Counts,
    InvalidFile,
    MissingExtra,
    MissingFile,
    Stream,
    require_no_links,
    require_regular,
)
from knotgym.datasets.png import encode
from knotgym.quality import Limits, Quality, grade_of
from knotgym.rendering import APPEARANCES, AppearanceConfig, Drawer, Drawn
from knotgym.states import IMAGE_SPLITS, STATES, RopeAtRest
from knotgym.topology import GaussCode

FORMAT = "knotgym-images"
VERSION = 2  # 2: ropes are drawn by distance
_DIGEST = "content_sha256"  # metadata key of the digest of all rows, see `_content_digest`
_ROW_GROUP = 100  # rows per Parquet row group, the smallest unit that can be read
_LEAST_ROW = 64  # bytes; every row stores more, because it has its own picture
_MOST_EXPANDED = 1000  # limit of uncompressed bytes per stored byte

# `columns.toml` has the types of Arrow, from which the schema of pyarrow is made
_COLUMNS_FILE = files("knotgym.datasets") / "columns.toml"
TABLES: dict[str, Any] = tomllib.loads(_COLUMNS_FILE.read_text("utf-8"))
_MEASURES = "quality"  # the one column whose fields may be fewer
TABLES["pictures"][_MEASURES]["type"] = dict.fromkeys(Quality.UNITS, "float64")
_CODES = STATES.only(*("gauss_code", "gauss_code_chiral", "pd_code", "dt_code", "nx", "knot"))
COLUMNS: dict[str, Any] = {name: column["type"] for name, column in TABLES["pictures"].items()}


def arrow(module: str = "pyarrow") -> Any:
    """Import pyarrow, or one of its modules; raise MissingExtra if it isn't installed."""
    return MissingExtra.imported(module, "huggingface", "Parquet")


def shown(*names: str) -> dict[str, str]:
    """Return the metadata by which Hugging Face reads columns as pictures."""
    features = {name: {"_type": "Image"} for name in names}
    return {"huggingface": json.dumps({"info": {"features": features}})}


def _columns_among(names: Collection[str]) -> dict[str, Any]:
    """Return all columns and their types of a table with these names.

    They are COLUMNS, and own ones of appearances, those of a file if all are among the names.
    """
    types = dict(COLUMNS)
    for extra in (columns for kind in APPEARANCES.values() for columns in kind.own_columns):
        if extra.keys() <= {*names}:
            types |= {name: column["type"] for name, column in extra.items()}
    return types


def _pngs(columns: Mapping[str, Any]) -> list[str]:
    return [name for name, kind in columns.items() if kind == "image"]


def marks_base(table: Any) -> bool:
    """Whether all pictures of a table mark the base bead and the direction of the code."""
    return all(
        len(APPEARANCES[look["name"]].marks) == 2 and look["colours"] != "single"
        for look in table["appearance"].to_pylist()
    )


def picture_column(pictures: Iterable[bytes]) -> Any:
    """Return PNG bytes as a pyarrow.Array in the layout of Hugging Face's Image feature."""
    return arrow().array([{"bytes": png, "path": None} for png in pictures], _arrow_type("image"))


def _table_of(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Return rows of one appearance, pictures as PNG bytes, as a pyarrow.Table."""
    columns = _columns_among(rows[0] if rows else ())
    pngs = _pngs(columns)
    full = [{**row, **{n: {"bytes": row[n], "path": None} for n in pngs}} for row in rows]
    types = [(name, _arrow_type(kind)) for name, kind in columns.items()]
    return arrow().Table.from_pylist(full, arrow().schema(types, metadata=shown(*pngs)))


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

    @staticmethod
    def drawn(rows: Sequence["PictureRow"], config: AppearanceConfig) -> Any:
        """Render rows as a pyarrow.Table."""
        drawer, records = Drawer.of(config.name), list[dict[str, Any]]()
        ropes = RopeAtRest.measured(np.array([row.points for row in rows]))
        for row, rope in zip(rows, ropes, strict=True):
            rng = Stream.IMAGE_APPEARANCE.generator(row.source["seed"], row.source["row"])
            picture = drawer.sampled(row.points, config, rng, row.camera, rope.crossings)
            given = {
                "points": row.points.ravel().tolist(),
                "source": row.source,
                "split": row.split,
            }
            look = {name: getattr(picture.look, name) for name in COLUMNS["appearance"]}
            records.append({**derived(rope, picture), **given, "appearance": look})
            Counts.end_item()
        return _table_of(records)


def derived(rope: RopeAtRest, drawn: Drawn) -> dict[str, Any]:
    """Return the columns that follow from a configuration and its picture."""
    x, y = drawn.pixels.T
    columns = {"x": x, "y": y}
    for name in ("over_place", "under_place", "sign"):
        columns[name] = getattr(rope.crossings, name)[drawn.seen]
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    pngs = _pngs(_columns_among(drawn.columns))
    more = {n: encode(value) if n in pngs else value for n, value in drawn.columns.items()}
    grained = APPEARANCES[drawn.look.name].grained or drawn.look.noise > 0
    return {
        **_of_code(rope.code),
        "crossings": [dict(zip(columns, row, strict=True)) for row in rows],
        "accepted": not Limits().faults(rope.quality, rope.crossings.nx),
        "grade": grade_of(rope.quality.ease()),
        "quality": dict(vars(rope.quality)),
        "image": encode(drawn.image, grained=grained),
        **more,
    }


@lru_cache(maxsize=2**12)
def _of_code(code: GaussCode) -> dict[str, Any]:
    return _CODES.derive(RopeAtRest((), code=code))


def parquet(rows: Any) -> bytes:
    """Return the bytes of a shard of rows, or a pyarrow.Table; the same rows give the same."""
    table = _table_of(rows) if isinstance(rows, Sequence) else rows
    named = {"format": FORMAT, "format_version": VERSION, _DIGEST: _content_digest(table)}
    metadata = {**table.schema.metadata, b"knotgym": json.dumps(named, sort_keys=True)}
    table, sink = table.replace_schema_metadata(metadata), arrow().BufferOutputStream()
    arrow("pyarrow.parquet").write_table(
        table, sink, row_group_size=_ROW_GROUP, compression="zstd", write_page_index=True
    )
    return bytes(sink.getvalue())


def shard_name(split: str, index: int, count: int) -> str:
    """Name a shard in its folder, in the pattern by which Hugging Face finds splits.

    >>> shard_name("test-code", 0, 2)
    'data/test_code-00000-of-00002.parquet'
    """
    return f"data/{file_stem(split)}-{index:05d}-of-{count:05d}.parquet"


def file_stem(split: str) -> str:
    """Write a split for file names: with underscores, as Hugging Face requires."""
    return split.replace("-", "_")


def shards(path: str | os.PathLike[str], split: str | None = None) -> list[Path]:
    """List the shards of a folder or of the folder `data` in it, or the one file, in order.

    Raises:
        MissingFile: nothing exists at path.
        InvalidFile: there are no shards, or none of this split, or one is a link.
    """
    given = Path(path)
    if not given.exists():
        raise MissingFile(f"no perception table at {path}")
    if split is not None and split not in IMAGE_SPLITS:
        raise InvalidFile(f"no split {split!r}; splits are {', '.join(IMAGE_SPLITS)}")
    inside = given / "data" if (given / "data").is_dir() else given
    files = [given] if given.is_file() else sorted(inside.glob("*.parquet"))
    if split is not None and given.is_dir():
        files = [file for file in files if file.name.startswith(f"{file_stem(split)}-")]
    if not files:
        which = f"of split {split} " if split else ""
        raise InvalidFile(f"no Parquet shard {which}at {path}; knotgym images writes them")
    require_no_links(given, files)
    return files


def read_table(
    path: str | os.PathLike[str],
    split: str | None = None,
    columns: Sequence[str] | None = None,
    *,
    images: bool = True,
) -> Any:
    """Read a table, or some of its columns, as a pyarrow.Table.

    Args:
        path, split: as in `shards`.
        columns: names of columns, of which those are read that it has; None for all.
        images: whether to read the pictures, which are most of the bytes; for all columns.

    Raises:
        InvalidFile: a file is not a shard, truncated, or of an unknown format version.
    """
    pa = arrow()
    wanted = None if columns is None else [*dict.fromkeys([*columns, *["split"] * bool(split)])]
    table = pa.concat_tables([_read(path, wanted, images) for path in shards(path, split)])
    if split is not None:
        table = table.filter(arrow("pyarrow.compute").equal(table["split"], split))
    return table


def read_rows(
    path: str | os.PathLike[str], split: str | None = None, columns: Sequence[str] | None = None
) -> Iterator[dict[str, Any]]:
    """Iterate over rows as dicts of Python values, `image` as PNG bytes.

    Arguments and errors are those of `read_table`.
    """
    for shard in shards(path, split):
        yield from rows_of(read_table(shard, split, columns))


def rows_of(table: Any) -> Iterator[dict[str, Any]]:
    """Iterate over the rows of a pyarrow.Table, see `read_rows`."""
    pngs = _pngs(_columns_among(table.column_names))
    for batch in table.to_batches():
        for row in batch.to_pylist():
            yield row | {name: row[name]["bytes"] for name in pngs if name in row}


def measures_of(table: Any) -> dict[str, tuple[str, NDArray[np.float64]]]:
    """Return the unit and the values, (n,), of each measure of a table's pictures."""
    whole = table[_MEASURES].combine_chunks()
    names = [field.name for field in whole.type]
    return {n: (Quality.UNITS.get(n, ""), whole.field(n).to_numpy()) for n in names}


def is_unchanged(table: Any) -> bool:
    """Whether the rows that were read from a shard are those that were written."""
    try:
        return bool(_named(table.schema).get(_DIGEST) == _content_digest(table))
    except InvalidFile:  # the digest isn't even text
        return False


def _content_digest(table: Any) -> str:
    """Hash rows as lines of JSON, with the SHA-256 of pictures instead of the pictures.

    It is `content_sha256` of a shard, and doesn't depend on how Parquet stores the rows.
    """
    whole, columns = hashlib.sha256(), _columns_among(table.column_names)
    for row in rows_of(table):
        row |= {name: hashlib.sha256(row[name]).hexdigest() for name in _pngs(columns)}
        line = json.dumps([row[name] for name in sorted(columns)], sort_keys=True)
        whole.update(f"{line}\n".encode())
    return whole.hexdigest()


def points_of(table: Any) -> NDArray[np.float64]:
    """Return the column `points` of a table as float64 (n, beads, 3), metres.

    Raises:
        InvalidFile: a number isn't finite.
    """
    flat = table["points"].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    points = np.asarray(flat, dtype=np.float64).reshape(len(table), -1 if len(table) else 0, 3)
    if not np.isfinite(points).all():
        row = int(np.isfinite(points).all(axis=(1, 2)).argmin())
        raise InvalidFile(f"column points holds numbers that aren't finite, first in row {row}")
    return points


def _read(path: Path, columns: list[str] | None, images: bool) -> Any:
    with _faults_named(path):
        file = arrow("pyarrow.parquet").ParquetFile(path)
        named = _named(file.schema_arrow)
        version = named.get("format", "none"), named.get("format_version", "none")
    if version != (FORMAT, VERSION):
        raise InvalidFile(
            f"{path} has format {version[0]!r} version {version[1]}; this version reads {FORMAT!r}"
            f" version {VERSION}"
        )
    with _faults_named(path):
        _require_schema(file, os.path.getsize(path))
        known = _columns_among(file.schema_arrow.names)
        if not images:
            columns = [name for name, kind in known.items() if kind != "image"]
        table = file.read(columns=columns)
        table.validate(full=True)
        for name in (name for name in known if name in table.column_names):
            for values in table[name].chunks:
                _require_values(name, values, may_be_infinite=isinstance(known[name], dict))
        return table


def _faults_named(path: Path) -> AbstractContextManager[None]:
    """Raise what a damaged shard makes pyarrow raise as InvalidFile that names it."""
    require_regular(path, "Parquet shard", InvalidFile)
    raised = (OSError, KeyError, ValueError, RecursionError, MemoryError, arrow().ArrowException)
    return InvalidFile.instead(f"{path} isn't a whole Parquet shard", *raised)


def _named(schema: Any) -> dict[str, Any]:
    """Read the metadata of a shard's schema under the key "knotgym"."""
    with InvalidFile.instead("a shard's metadata isn't JSON", ValueError, RecursionError):
        named = json.loads((schema.metadata or {}).get(b"knotgym", b"{}"))
    return named if isinstance(named, dict) else {}


def _require_schema(file: Any, stored: int) -> None:
    """Refuse a shard with other columns or types, or with sizes that its bytes can't hold."""
    schema = file.schema_arrow
    for name, wanted in _columns_among(schema.names).items():
        at = schema.get_all_field_indices(name)
        if len(at) != 1:
            raise InvalidFile(f"column {name} must exist once, found {len(at)}")
        kind, right = schema.field(at[0]).type, _arrow_type(wanted)
        # a table from before a measure was added lacks it
        fewer = name == _MEASURES and kind.num_fields and {*kind} <= {*right}
        if kind != right and not fewer:
            raise InvalidFile(f"column {name} is {kind}, should be {right}")
    groups = [file.metadata.row_group(k) for k in range(file.num_row_groups)]
    # the footer's own figures: nothing is allocated before they are found plausible
    size = sum(group.total_byte_size for group in groups)
    rows = sum(group.num_rows for group in groups)
    if rows != file.metadata.num_rows or not 0 <= rows * _LEAST_ROW <= stored:
        raise InvalidFile(f"it declares {file.metadata.num_rows} rows but stores {stored} bytes")
    if not 0 <= size <= _MOST_EXPANDED * stored:
        raise InvalidFile(f"it declares {size} bytes but stores {stored}")


def _require_values(name: str, values: Any, *, may_be_infinite: bool) -> None:
    """Refuse missing values in a column, but in a picture's path, which is unused; and floats that
    aren't numbers. Measures, fields of a row's one struct, may be infinite; of points `points_of`
    says where they aren't finite.
    """
    types = arrow("pyarrow.types")
    if values.null_count:
        raise InvalidFile(f"column {name} has missing values")
    if types.is_struct(values.type):
        for field in values.type:
            if field.name != "path":
                _require_values(name, values.field(field.name), may_be_infinite=may_be_infinite)
    elif types.is_list(values.type) or types.is_fixed_size_list(values.type):
        _require_values(name, values.flatten(), may_be_infinite=False)
    elif types.is_floating(values.type) and name != "points":
        numbers = values.to_numpy(zero_copy_only=False)
        if not (~np.isnan(numbers) if may_be_infinite else np.isfinite(numbers)).all():
            raise InvalidFile(f"column {name} holds numbers that aren't finite")


def _arrow_type(kind: Any) -> Any:
    """Convert a type in the notation of COLUMNS to a pyarrow type."""
    pa = arrow()
    if isinstance(kind, dict):
        return pa.struct([(name, _arrow_type(inner)) for name, inner in kind.items()])
    if isinstance(kind, list):
        return pa.list_(_arrow_type(kind[0]), kind[1] or -1)
    if kind == "image":
        return pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    return {"string": pa.string(), "bool": pa.bool_()}.get(kind) or getattr(pa, kind)()
