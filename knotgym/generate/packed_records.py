"""Checkpoints of runs: records packed into arrays, and the errors of reading corrupted ones."""

import json
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints
from zipfile import BadZipFile

import numpy as np

from knotgym.common.atomic_files import atomic_write, sha256
from knotgym.common.errors import InvalidFile, one_line
from knotgym.topology.gauss import GaussCode

Record = TypeVar("Record")
# errors of NumPy and zipfile for a file that isn't a complete archive
FOREIGN = (
    *(OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, MemoryError),
    *(RuntimeError, BadZipFile, struct.error, zlib.error),  # RuntimeError is zipfile's
)


@contextmanager
def reading_checkpoint(folder: Path) -> Iterator[None]:
    """Turn what a corrupted checkpoint raises in the block into InvalidFile."""
    try:
        yield
    except FOREIGN as error:
        raise InvalidFile(
            f"{folder} can't be resumed, it is corrupted ({one_line(error)}); start with --restart"
        ) from error


def require_digest(path: Path, digest: str) -> None:
    """Raise InvalidFile if a file doesn't have this SHA-256."""
    if sha256(path) != digest:
        raise InvalidFile(f"SHA-256 of {path.name} differs")


def write_records(path: Path, groups: Mapping[str, Sequence[Any]]) -> str:
    """Write groups of frozen dataclasses, one class per group, to a .npz; return its SHA-256.

    Arrays of a field are joined along their first axis; Gauss codes and values for JSON are text.
    """
    columns: dict[str, Any] = {}
    for group, records in groups.items():
        rows = [vars(record) for record in records]
        arrays = [name for name, one in (rows or [{}])[0].items() if isinstance(one, np.ndarray)]
        texts = [
            json.dumps({name: _plain(one) for name, one in row.items() if name not in arrays})
            for row in rows
        ]
        columns[f"{group}.text"] = np.array(texts, dtype=np.str_)
        for name in arrays:
            columns[f"{group}.{name}"] = np.concatenate([row[name] for row in rows])
            columns[f"{group}.{name}.lengths"] = np.array([len(row[name]) for row in rows])
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **columns)
    return sha256(path)


def read_records(path: Path, group: str, kind: type[Record]) -> list[Record]:
    """Read a group of `write_records`, whose class is `kind`; arrays must have their types."""
    types = {  # NDArray[x] is ndarray[shape, dtype[x]]
        name: np.dtype(get_args(get_args(hint)[1])[0])
        for name, hint in get_type_hints(kind).items()
        if get_origin(hint) is np.ndarray
    }
    with np.load(path, allow_pickle=False) as file:
        values = [json.loads(text) for text in file[f"{group}.text"].tolist()]
        for name in file.files if values else ():
            if name.endswith(".lengths") and name.startswith(f"{group}."):
                ends = np.cumsum(file[name])[:-1]
                column = name.removesuffix(".lengths")
                field = column.removeprefix(f"{group}.")
                if file[column].dtype != types[field]:
                    raise InvalidFile(f"{field} is {file[column].dtype}, should be {types[field]}")
                for row, own in zip(values, np.split(file[column], ends), strict=True):
                    row[field] = own
    for row in values:
        if "code" in row:
            row["code"] = GaussCode.parse(row["code"])
    return [_made(kind, row) for row in values]


def _made(kind: Any, value: Any) -> Any:
    """Turn objects of JSON into dataclasses and lists into tuples, by the type of their field."""
    one = next((each for each in (kind, *get_args(kind)) if is_dataclass(each)), None)
    if isinstance(value, dict) and one is not None:
        hints = get_type_hints(one)
        return one(**{name: _made(hints[name], inner) for name, inner in value.items()})  # type: ignore[operator]
    return tuple(_made(None, inner) for inner in value) if isinstance(value, list) else value


def _plain(value: Any) -> Any:
    if isinstance(value, GaussCode):
        return value.chiral
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else value
