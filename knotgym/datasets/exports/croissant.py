"""Croissant: a machine-readable description of a dataset, with its responsible-AI fields.

Source: MLCommons Croissant 1.0 and Croissant RAI 1.0; _CONTEXT is the one mlcroissant writes.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from knotgym.common.atomic_files import sha256
from knotgym.datasets.exports.parquet_tables import TableColumn

LICENCE = "https://creativecommons.org/licenses/by/4.0/"
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
_TYPES = {"string": "sc:Text", "bool": "sc:Boolean", "float32": "sc:Float", "float64": "sc:Float"}
# what is true of every knotgym dataset
_RAI = {
    "rai:dataCollection": "Simulated: a closed rope of 100 beads in MuJoCo, pulled at one bead at a"
    " time. There are no persons and no recordings of the real world.",
    "rai:dataCollectionType": ["Software Collection", "Experiments"],
    "rai:dataAnnotationProtocol": "Labels (Gauss codes) are computed from the vertices, exactly;"
    " `knotgym dataset verify` recomputes them with a second labeller and replays every row.",
    "rai:dataPreprocessingProtocol": "Curated states must pass limits on how readable their picture"
    " is; the card counts rejections by reason.",
    "rai:dataUseCases": "Spatial reasoning: reading codes off pictures, goal-conditioned and"
    " offline reinforcement learning. Not meant for judging real ropes.",
    "rai:dataLimitations": "One rope, one simulator, plain pictures. Few crossings, and the"
    " frequency of codes is set by the search or the policy and doesn't reflect real ropes.",
    "rai:dataBiases": "Curated states are easier to read than random ones; shapes that the search"
    " finds quickly are more frequent.",
    "rai:dataSocialImpact": "None known beyond that of better spatial reasoning in machines.",
    "rai:personalSensitiveInformation": "None.",
    "rai:dataReleaseMaintenancePlan": "A release never changes: a change gets a new version. The"
    " same seed gives the same bytes.",
}


class FileObject(NamedTuple):
    """One Parquet file of a folder.

    Attributes:
        config: kind of table, such as "states".
        split: the split that its rows belong to.
        path: relative to the folder.
        rows: number of rows.
        columns: columns of the table.
    """

    config: str
    split: str
    path: str
    rows: int
    columns: Sequence[TableColumn]


def croissant(
    folder: Path,
    files: Sequence[FileObject],
    *,
    name: str,
    description: str,
    version: str,
    citation: str,
) -> dict[str, Any]:
    """Describe a folder whose tables have been written; the result can be written as JSON."""
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [
            "http://mlcommons.org/croissant/1.0",
            "http://mlcommons.org/croissant/RAI/1.0",
        ],
        "name": re.sub(r"[^\w-]+", "-", name),
        "description": description,
        "license": LICENCE,
        "url": "https://huggingface.co/datasets",
        "version": version,
        "creator": {"@type": "Organization", "name": "The knotgym founders"},
        "citeAs": citation,
        "isLiveDataset": False,
        **_RAI,
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
