"""Opening HDF5 files of ours, and what is taken from them: every name, type, size and link checked.

Every file we write names its `format` and `format_version` in its attributes. A reader says which
versions it knows; a foreign, torn or newer file is refused with the reader's own error. HDF5 would
follow a link to any other file, and make any array that a file declares; here nothing is followed,
and nothing is read before its type and its size are known to be right.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, MutableMapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import KnotgymError, MissingFile, one_line

# whatever h5py, and what reads its arrays, says to foreign bytes
_FOREIGN = (
    OSError,
    KeyError,
    IndexError,
    RuntimeError,
    TypeError,
    ValueError,
    AttributeError,
    MemoryError,
    OverflowError,
)
# bytes of a column for each that the file stores of it: gzip makes at most 1032 of one
MOST_EXPANDED = 1100
_SMALL = 1 << 20  # bytes that any column may have
_FILTERS = frozenset({h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32})
_TEXTS_AT_ONCE, _LONGEST_TEXT = 256, 1 << 20
_CLASSES = {"f": "f", "i": "iu", "u": "iu", "b": "b"}


class UnexpectedContent(KnotgymError, ValueError):
    """Something in a file that its schema doesn't allow; readers make their own error of it."""


@dataclass(frozen=True)
class Column:
    """One column or attribute of a file.

    Attributes:
        name: in the file; "source/steps" stands in the group `source`.
        kind: "float64", "int64", "uint8", "bool" and so on; "text", UTF-8; "any" of these. A
            narrower type of the same class will do. "integer" is one of any width.
        shape: of one row. A word is a size that is the same in all of a file; None any size. None
            instead of a shape is any shape.
        unit: "" where there is none.
        doc: what it holds.
        finite: no infinity, no NaN.
        least: the smallest number there may be.
    """

    name: str
    kind: str
    shape: tuple[int | str | None, ...] | None
    unit: str = ""
    doc: str = ""
    finite: bool = False
    least: float | None = None

    def has_kind(self, values: NDArray[Any]) -> bool:
        """Whether values are of this type, or of a narrower one of its class."""
        if self.kind in ("text", "any"):
            return values.dtype.kind in ("U" if self.kind == "text" else "Ufiub")
        return self._holds(values.dtype)

    def has_shape(self, values: NDArray[Any], rows: int, sizes: MutableMapping[str, int]) -> bool:
        """Whether values, of so many rows, are of this shape; `sizes` says what words stand for."""
        return _fits(values.shape, self.full_shape(rows, sizes))

    def full_shape(self, rows: int, sizes: MutableMapping[str, int]) -> tuple[int | None, ...]:
        """The shape of the whole column, None where any size will do."""
        return (rows, *(sizes[n] if isinstance(n, str) else n for n in self.shape or ()))

    def require_type(self, found: h5py.h5t.TypeID, dtype: Any) -> None:
        """Refuse what is stored as another type.

        Raises:
            UnexpectedContent: naming both.
        """
        text = h5py.check_string_dtype(dtype) is not None or dtype.kind == "S"
        if isinstance(found, h5py.h5t.TypeEnumID) and dtype.kind != "b":
            right = False
        elif self.kind in ("text", "any") and text:
            right = True
        else:
            right = dtype.kind in "fiub" if self.kind == "any" else self._holds(dtype)
        if not right:
            raise UnexpectedContent(f"{self.name} is {_told(found, dtype)}, should be {self.kind}")

    def _holds(self, dtype: Any) -> bool:
        if self.kind in ("text", "integer"):
            return self.kind == "integer" and dtype.kind in "iu"
        wanted = np.dtype(self.kind)
        return dtype.kind in _CLASSES[wanted.kind] and np.can_cast(dtype, wanted)

    def require_values(self, values: NDArray[Any]) -> None:
        """Refuse numbers out of range and text that no terminal should see.

        Raises:
            UnexpectedContent: naming the first such.
        """
        if values.dtype.kind == "U":
            if not "".join(values.ravel().tolist()).isprintable():
                raise UnexpectedContent(f"{self.name} holds control characters")
            return
        if self.finite and not np.isfinite(values).all():
            first = np.argwhere(~np.isfinite(values))[0].tolist()
            raise UnexpectedContent(f"{self.name} holds {values[tuple(first)]} at {first}")
        if self.least is not None and values.size and values.min() < self.least:
            raise UnexpectedContent(
                f"{self.name} is {values.min()}, should be at least {self.least:g}"
            )


@contextmanager
def opened_hdf5(
    path: str | os.PathLike[str],
    *,
    what: str,
    format: str,
    versions: Sequence[int],
    error: type[KnotgymError],
) -> Iterator[h5py.File]:
    """Open a file for reading, checked; what goes wrong while it is read is the caller's error too.

    Args:
        path: of the file.
        what: it should be, as "state file".
        format, versions: that can be read.
        error: raised for a file that isn't whole, or of another format or version.

    Raises:
        MissingFile: there is none.
    """
    require_regular(path, what, error)
    with foreign_bytes_as(error, f"{path} isn't a whole {what}"), h5py.File(path, "r") as file:
        check_format(file, format=format, versions=versions, error=error)
        yield file


def require_regular(path: str | os.PathLike[str], what: str, error: type[KnotgymError]) -> None:
    """Refuse what isn't a file on a disk: opening a pipe or a device may never end.

    Raises:
        MissingFile: there is nothing, or a folder.
    """
    given = Path(path)
    if given.exists() and not given.is_file() and not given.is_dir():
        raise error(f"{path} isn't a regular file, so no {what} is read from it")
    if not given.is_file():
        raise MissingFile(f"no {what} at {path}")


@contextmanager
def foreign_bytes_as(error: type[KnotgymError], complaint: str) -> Iterator[None]:
    """Turn what reading foreign or torn bytes raises into `error`, one line after `complaint`."""
    try:
        yield
    except error:
        raise
    except _FOREIGN as trouble:
        raise error(f"{complaint}: {one_line(trouble)}") from trouble


def check_format(
    file: h5py.File, *, format: str, versions: Sequence[int], error: type[KnotgymError]
) -> int:
    """The version of an open file; raises `error` unless it is one of `versions` of the format."""
    name, version = (
        read_attribute(file, Column(name, "any", ())) if name in file.attrs else "none"
        for name in ("format", "format_version")
    )
    if name != format or not isinstance(version, np.integer) or version not in versions:
        kind = f" ({version.dtype})" if isinstance(version, np.generic) else ""
        raise error(
            f"{file.filename} has format {name!r} version {version}"
            f"{'' if isinstance(version, np.integer) else kind}; this version reads {format!r}"
            f" version {' or '.join(map(str, versions))}"
        )
    return int(version)


def hdf5_format(path: str | os.PathLike[str]) -> str | None:
    """The format an HDF5 file says it has; None if it says nothing or isn't one."""
    if not Path(path).is_file():
        return None
    try:
        with h5py.File(path, "r") as file:
            return str(read_attribute(file, Column("format", "text", ())))
    except _FOREIGN:
        return None


def member(group: h5py.Group, name: str) -> Any:
    """A group or dataset inside this very file.

    Args:
        group: it is in.
        name: "a/b" for a dataset or group in the group `a`.

    Raises:
        UnexpectedContent: a link on the way to it leads elsewhere, or it is neither.
        KeyError: there is none.
    """
    found = group
    for part in name.split("/"):
        if not isinstance(found, h5py.Group):
            raise UnexpectedContent(f"{name} should be in a group, {part} is in none")
        encoded = part.encode()
        if not found.id.links.exists(encoded):
            raise KeyError(f"{name} is missing")
        if found.id.links.get_info(encoded).type != h5py.h5l.TYPE_HARD:
            raise UnexpectedContent(f"{name} is a link to another place, should be stored here")
        found = found[part]
    if not isinstance(found, h5py.Group | h5py.Dataset):
        raise UnexpectedContent(f"{name} should be an array or a group")
    return found


def members(group: h5py.Group, name: str) -> list[str]:
    """The names in a group of a group."""
    found = member(group, name)
    if not isinstance(found, h5py.Group):
        raise UnexpectedContent(f"{name} should be a group")
    return list(found)


def stored_column(
    group: h5py.Group, column: Column, sizes: MutableMapping[str, int], name: str = ""
) -> h5py.Dataset:
    """The dataset of a column, whose type and size are right; none of it is read.

    Args:
        group: it is in.
        column: what it should be; `shape` is here that of the whole column.
        sizes: what words in shapes stand for; a new word is what is found.
        name: in the group, where it isn't the column's.

    Raises:
        UnexpectedContent, KeyError: it isn't.
    """
    data = member(group, name or column.name)
    if not isinstance(data, h5py.Dataset):
        raise UnexpectedContent(f"{column.name} is a group, should be {column.kind}")
    column.require_type(data.id.get_type(), _dtype(data.id, column))
    require_stored_here(data, column.name)
    _require_shape(column, data.shape, sizes)
    return data


def read_column(
    group: h5py.Group, column: Column, sizes: MutableMapping[str, int], name: str = ""
) -> NDArray[Any]:
    """A column's values, checked; arguments and errors as of `stored_column`."""
    data = stored_column(group, column, sizes, name)
    if data.dtype.kind == "S":
        values = np.char.decode(np.asarray(data[()]), "utf-8")
    elif data.dtype.kind == "O":
        values = _texts(data, column.name)
    else:
        values = np.asarray(data[()])
        plain = column.kind in ("any", "integer")
        wanted = data.dtype.newbyteorder("=") if plain else np.dtype(column.kind)
        values = values.astype(wanted, copy=False)
    column.require_values(values)
    return values


def read_attribute(
    item: h5py.Group | h5py.Dataset, column: Column, sizes: MutableMapping[str, int] | None = None
) -> Any:
    """An attribute, checked: a str or NumPy scalar, or where `shape` says so an array.

    Raises:
        UnexpectedContent: of another type or shape, or out of range.
        KeyError: there is none.
    """
    if column.name not in item.attrs:
        raise KeyError(f"the attribute {column.name} is missing")
    found = item.attrs.get_id(column.name)
    column.require_type(found.get_type(), _dtype(found, column))
    _require_shape(column, found.shape, {} if sizes is None else sizes)
    value = item.attrs[column.name]
    if isinstance(value, bytes):
        value = value.decode()
    column.require_values(np.asarray(value))
    return value


def require_stored_here(data: h5py.Dataset, name: str) -> None:
    """Refuse an array that lies in other files, or that is far larger than what is stored of it.

    Raises:
        UnexpectedContent: it is.
    """
    made = data.id.get_create_plist()
    layout = made.get_layout()
    if layout == h5py.h5d.VIRTUAL or made.get_external_count():
        raise UnexpectedContent(f"{name} lies in other files, should be stored here")
    if any(made.get_filter(k)[0] not in _FILTERS for k in range(made.get_nfilters())):
        raise UnexpectedContent(f"{name} is compressed in another way than gzip")
    each = data.id.get_type().get_size()
    size = each * prod(data.shape or (0,))
    chunk = each * prod(made.get_chunk()) if layout == h5py.h5d.CHUNKED else 0
    if max(size, chunk) <= _SMALL:
        return
    stored = min(data.id.get_storage_size(), os.path.getsize(data.file.filename))
    if max(size, chunk) > _SMALL + MOST_EXPANDED * stored:
        raise UnexpectedContent(
            f"{name} declares {data.shape}, {size} bytes, and stores {stored}; the most that is"
            f" read is {MOST_EXPANDED} for each byte stored"
        )


def _texts(data: h5py.Dataset, name: str) -> NDArray[np.str_]:
    """Strings of any length, some at a time: each row may name the longest string of the file."""
    if data.ndim == 0:
        return np.array(data[()].decode(), dtype=np.str_)
    if data.ndim != 1:
        raise UnexpectedContent(f"{name} is of shape {data.shape}, should be one text a row")
    found: list[str] = []
    for start in range(0, len(data), _TEXTS_AT_ONCE):
        texts = [text.decode() for text in data[start : start + _TEXTS_AT_ONCE].tolist()]
        if max(map(len, texts)) * len(data) > MOST_EXPANDED * _LONGEST_TEXT:
            raise UnexpectedContent(f"{name} holds a text of {max(map(len, texts))} characters")
        found += texts
    return np.array(found, dtype=np.str_)


def _require_shape(
    column: Column, shape: tuple[int, ...] | None, sizes: MutableMapping[str, int]
) -> None:
    """Refuse another shape; words that `sizes` doesn't know yet are what is found."""
    wanted = (None,) * len(shape or ()) if column.shape is None else column.shape
    right = tuple(sizes.get(n) if isinstance(n, str) else n for n in wanted)
    if shape is None or not _fits(shape, right):
        should_be = ", ".join("any" if size is None else str(size) for size in right)
        raise UnexpectedContent(f"{column.name} is of shape {shape}, should be ({should_be})")
    for word, size in zip(wanted, shape, strict=True):
        if isinstance(word, str):
            sizes[word] = size


def _fits(shape: tuple[int, ...], right: tuple[int | None, ...]) -> bool:
    return len(shape) == len(right) and all(
        size in (None, found) for size, found in zip(right, shape, strict=True)
    )


def _dtype(found: h5py.h5d.DatasetID | h5py.h5a.AttrID, column: Column) -> Any:
    try:
        return found.dtype
    except (TypeError, ValueError) as error:  # NumPy has none for it
        told = _told(found.get_type(), None)
        raise UnexpectedContent(f"{column.name} is {told}, should be {column.kind}") from error


def _told(found: h5py.h5t.TypeID, dtype: Any) -> str:
    """A stored type in a word or two."""
    special = {
        h5py.h5t.TypeEnumID: "an enumeration",
        h5py.h5t.TypeCompoundID: "a compound" if dtype is None or dtype.kind != "c" else str(dtype),
        h5py.h5t.TypeOpaqueID: "opaque",
        h5py.h5t.TypeReferenceID: "references",
        h5py.h5t.TypeVlenID: "arrays of any length",
        h5py.h5t.TypeArrayID: "arrays",
        h5py.h5t.TypeBitfieldID: "bit fields",
        h5py.h5t.TypeStringID: "text",
    }
    known = [word for kind, word in special.items() if isinstance(found, kind)]
    return known[0] if known and (dtype is None or dtype.kind != "b") else str(dtype)
