"""Croissant: a machine-readable description of a dataset, with its responsible-AI fields.

Source: MLCommons Croissant 1.0 and Croissant RAI 1.0. `croissant.json` has what is the same for
every dataset: the context that mlcroissant writes, licence, and the responsible-AI fields.
"""

import json
import re
from collections.abc import Sequence
from importlib.resources import files as files_of
from pathlib import Path
from typing import Any, NamedTuple

from knotgym.common.atomic_files import sha256
from knotgym.datasets.cards.citation import BIBTEX
from knotgym.datasets.exports.parquet_tables import TableColumn

_TYPES = {"string": "sc:Text", "bool": "sc:Boolean", "float32": "sc:Float", "float64": "sc:Float"}


class FileObject(NamedTuple):
    """One Parquet file of a folder."""

    config: str  # kind of table, such as "states"
    split: str
    path: str  # relative to the folder
    rows: int
    columns: Sequence[TableColumn]


def croissant(
    folder: Path, files: Sequence[FileObject], name: str, description: str
) -> dict[str, Any]:
    """Describe a folder whose tables have been written; the result can be written as JSON."""
    fixed = json.loads((files_of("knotgym.datasets.exports") / "croissant.json").read_text("utf-8"))
    return {
        **fixed,
        "name": re.sub(r"[^\w-]+", "-", name),
        "description": description,
        "citeAs": BIBTEX,
        "distribution": [
            {
                "@type": "cr:FileObject",
                "@id": file.path,
                "name": file.path,
                "contentUrl": file.path,
                "contentSize": f"{(folder / file.path).stat().st_size} B",
                "encodingFormat": "application/x-parquet",
                "sha256": sha256(folder / file.path),
            }
            for file in files
        ],
        "recordSet": [_records(file) for file in files],
    }


def _records(file: FileObject) -> dict[str, Any]:
    name = Path(file.path).stem.replace("-00000-of-00001", "")
    where = f"{file.config}/{name}"
    fields = [_field(where, file.path, column) for column in file.columns]
    return {
        "@type": "cr:RecordSet",
        "@id": where,
        "name": where,
        "description": f"{file.rows} rows of split {file.split}.",
        "field": [field for field in fields if field],
    }


def _field(where: str, path: str, column: TableColumn) -> dict[str, Any]:
    """Describe a column; {} for structs other than pictures, which Croissant would flatten."""
    kind, repeated = column.kind, False
    if isinstance(kind, list) and isinstance(kind[0], str):
        kind, repeated = kind[0], True
    if not isinstance(kind, str):
        return {}
    source: dict[str, Any] = {
        "fileObject": {"@id": path},
        "extract": {"column": column.name},
    }
    if kind == "image":
        source["transform"] = {"jsonPath": "bytes"}
    return {
        "@type": "cr:Field",
        "@id": f"{where}/{column.name}",
        "name": f"{where}/{column.name}",
        "description": f"{column.doc}{f' [{column.unit}]' if column.unit else ''}",
        "dataType": "sc:ImageObject" if kind == "image" else _TYPES.get(kind, "sc:Integer"),
        **({"repeated": True} if repeated else {}),
        "source": source,
    }
