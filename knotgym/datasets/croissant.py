"""Croissant: a machine-readable description of a folder of Parquet files, for dataset search.

Source: MLCommons Croissant 1.0 and Croissant RAI 1.0. `croissant.json` has what is the same for
every dataset: the context that mlcroissant writes, licence, and the responsible-AI fields.
"""

import json
import re
from pathlib import Path
from typing import Any

from knotgym.common import sha256
from knotgym.datasets.card_texts import BIBTEX, TEMPLATES, write_text
from knotgym.datasets.image_table import arrow

_TYPES = {"string": "sc:Text", "bool": "sc:Boolean", "float": "sc:Float", "double": "sc:Float"}
_PICTURE = "struct<bytes: binary"  # how Parquet files hold pictures


def write_croissant(folder: Path, name: str, description: str, appearance: str = "") -> None:
    """Describe the tables data/CONFIG/SPLIT-*.parquet or data/SPLIT-*.parquet of a folder.

    Writes `croissant.json`. The file of an appearance of pictures, such as `photo.json`, if there
    is one, replaces some of its texts.
    """
    texts = [TEMPLATES / f"{name}.json" for name in ("croissant", appearance)]
    fixed = [json.loads(text.read_text("utf-8")) for text in texts if text.is_file()]
    paths = [path.relative_to(folder) for path in sorted(folder.glob("data/**/*.parquet"))]
    described = {
        **{field: value for part in fixed for field, value in part.items()},
        "name": re.sub(r"[^\w-]+", "-", name),
        "description": description,
        "citeAs": BIBTEX,
        "distribution": [
            _node("FileObject", path.as_posix())
            | {"contentUrl": path.as_posix()}
            | {"contentSize": f"{(folder / path).stat().st_size} B"}
            | {"encodingFormat": "application/x-parquet", "sha256": sha256(folder / path)}
            for path in paths
        ],
        "recordSet": [_records(folder, path) for path in paths],
    }
    write_text(folder / "croissant.json", json.dumps(described, indent=1))


def _node(kind: str, name: str) -> dict[str, Any]:
    return {"@type": f"cr:{kind}", "@id": name, "name": name}


def _records(folder: Path, path: Path) -> dict[str, Any]:
    parquet = arrow("pyarrow.parquet").ParquetFile(folder / path)
    split, _, shard = path.stem.partition("-")
    where = f"{path.parent.name}/{split}" + ("" if shard.startswith("00000") else f"-{shard}")
    fields = [
        _field(where, path.as_posix(), member, parent)
        for column in parquet.schema_arrow
        for member, parent in _members(column)
    ]
    said = f"{parquet.metadata.num_rows} rows of split {split}."
    return _node("RecordSet", where) | {"description": said, "field": fields}


def _members(column: Any) -> list[tuple[Any, str]]:
    """Return a column, or the members of a structure and its name; none of lists of structures."""
    kind = str(column.type)
    if kind.startswith("struct") and not kind.startswith(_PICTURE):
        return [(member, column.name) for member in column.type]
    return [] if ": struct<" in kind else [(column, "")]


def _field(where: str, path: str, column: Any, parent: str) -> dict[str, Any]:
    """Describe a column, or a member of the structure `parent`."""
    kind, name = str(column.type), f"{parent}.{column.name}" if parent else column.name
    repeated, picture = kind.startswith(("list<", "fixed_size_list<")), kind.startswith(_PICTURE)
    if repeated:
        kind = str(column.type.value_type)
    source: dict[str, Any] = {"fileObject": {"@id": path}}
    source["extract"] = {"column": parent or column.name}
    if picture or parent:
        source["transform"] = {"jsonPath": "bytes" if picture else column.name}
    described = _node("Field", f"{where}/{name}")
    described["description"] = f"The column {name}, explained in README.md."
    described["dataType"] = "sc:ImageObject" if picture else _TYPES.get(kind, "sc:Integer")
    return described | ({"repeated": True} if repeated else {}) | {"source": source}
