"""Safe reading of HDF5 files: formats, names, types, shapes, sizes and links are checked.

Every file that this package writes has the attributes `format` and `format_version`. A reader says
which versions it supports, and which error to raise for a foreign, corrupted or newer file. The
HDF5 library would follow links to any other file and allocate any array that a file declares. Here
links aren't followed, and data is read only after its type and size have been checked.
"""

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

from knotgym.common.errors import InvalidFile, KnotgymError, MissingFile, one_line

# errors that h5py and array operations raise on corrupted or foreign files
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
# largest ratio of a column's size to the bytes stored for it; gzip expands at most 1032-fold
MOST_EXPANDED = 1100
_SMALL = 1 << 20  # columns up to this many bytes are accepted whatever the ratio
_FILTERS = frozenset({h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32})
_TEXTS_AT_ONCE, _LONGEST_TEXT = 256, 1 << 20
_CLASSES = {"f": "f", "i": "iu", "u": "iu", "b": "b"}  # kinds of dtype accepted for a column's kind


@dataclass(frozen=True)
class Column:
    """Schema of one column or attribute of a file.

    Attributes:
        name: path in the file; "source/steps" is in the group `source`.
        kind: "float64", "int64", "uint8", "bool" and so on; a narrower type of the same class is
            accepted. "text" is UTF-8, "integer" an integer of any width, "any" any of these.
        shape: shape of one row. A word stands for a size that is the same everywhere in the file,
            None for any size. None instead of a tuple accepts any shape.
        unit: unit of the values; "" if they have none.
        doc: description.
        finite: whether to reject infinity and NaN.
        least: the smallest allowed number; None for no limit.
    """

    name: str
    kind: str
    shape: tuple[int | str | None, ...] | None
    unit: str = ""
    doc: str = ""
    finite: bool = False
    least: float | None = None

    def has_kind(self, values: NDArray[Any]) -> bool:
        """Return whether an array has this type, or a narrower one of the same class."""
        if self.kind in ("text", "any"):
            return values.dtype.kind in ("U" if self.kind == "text" else "Ufiub")
        return self._holds(values.dtype)

    def has_shape(self, values: NDArray[Any], rows: int, sizes: MutableMapping[str, int]) -> bool:
        """Return whether an array of so many rows has this shape; `sizes` resolves its words."""
        return _fits(values.shape, self.full_shape(rows, sizes))

    def full_shape(self, rows: int, sizes: MutableMapping[str, int]) -> tuple[int | None, ...]:
        """Return the shape of the whole column, with None where any size is accepted."""
        return (rows, *(sizes[n] if isinstance(n, str) else n for n in self.shape or ()))

    def require_type(self, found: h5py.h5t.TypeID, dtype: Any) -> None:
        """Raise InvalidFile if a stored type, `dtype` in NumPy, doesn't match `kind`."""
        text = h5py.check_string_dtype(dtype) is not None or dtype.kind == "S"
        if isinstance(found, h5py.h5t.TypeEnumID) and dtype.kind != "b":  # h5py stores bool as enum
            matches = False
        elif self.kind in ("text", "any") and text:
            matches = True
        else:
            matches = dtype.kind in "fiub" if self.kind == "any" else self._holds(dtype)
        if not matches:
            raise InvalidFile(f"{self.name} is {_type_name(found, dtype)}, should be {self.kind}")

    def _holds(self, dtype: Any) -> bool:
        if self.kind in ("text", "integer"):
            return self.kind == "integer" and dtype.kind in "iu"
        wanted = np.dtype(self.kind)
        return dtype.kind in _CLASSES[wanted.kind] and np.can_cast(dtype, wanted)

    def require_values(self, values: NDArray[Any]) -> None:
        """Raise InvalidFile if numbers are out of range or text has control characters."""
        if values.dtype.kind == "U":
            if not "".join(values.ravel().tolist()).isprintable():
                raise InvalidFile(f"{self.name} holds control characters")
            return
        if self.finite and not np.isfinite(values).all():
            first = np.argwhere(~np.isfinite(values))[0].tolist()
            raise InvalidFile(f"{self.name} holds {values[tuple(first)]} at {first}")
        if self.least is not None and values.size and values.min() < self.least:
            raise InvalidFile(f"{self.name} is {values.min()}, should be at least {self.least:g}")


@contextmanager
def opened_hdf5(
    path: str | os.PathLike[str],
    *,
    what: str,
    format: str,
    versions: Sequence[int],
    error: type[KnotgymError],
) -> Iterator[h5py.File]:
    """Open a file for reading, check its format, and turn errors from the block into `error`.

    Args:
        path: path of the file; raises MissingFile if it doesn't exist.
        what: kind of file, such as "state file", for error messages.
        format, versions: required attribute `format`, and supported `format_version`s.
        error: error class for a corrupted file, or one of another format or version.
    """
    require_regular(path, what, error)
    with foreign_bytes_as(error, f"{path} isn't a whole {what}"), h5py.File(path, "r") as file:
        check_format(file, format=format, versions=versions, error=error)
        yield file


def require_regular(path: str | os.PathLike[str], what: str, error: type[KnotgymError]) -> None:
    """Raise MissingFile if a path doesn't exist or is a folder, `error` if it is no regular file.

    Reading a pipe or a device may never end.
    """
    given = Path(path)
    if given.exists() and not given.is_file() and not given.is_dir():
        raise error(f"{path} isn't a regular file, so no {what} is read from it")
    if not given.is_file():
        raise MissingFile(f"no {what} at {path}")


@contextmanager
def foreign_bytes_as(error: type[KnotgymError], complaint: str) -> Iterator[None]:
    """Turn errors from reading corrupted or foreign data into `error`, prefixed by `complaint`."""
    try:
        yield
    except error:
        raise
    except _FOREIGN as cause:
        raise error(f"{complaint}: {one_line(cause)}") from cause


def check_format(
    file: h5py.File, *, format: str, versions: Sequence[int], error: type[KnotgymError]
) -> int:
    """Return the format version of an open file; raise `error` for another format or version."""
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
    """Return the `format` attribute of an HDF5 file; None if it has none or isn't an HDF5 file."""
    if not Path(path).is_file():
        return None
    try:
        with h5py.File(path, "r") as file:
            return str(read_attribute(file, Column("format", "text", ())))
    except _FOREIGN:
        return None


def member(group: h5py.Group, name: str) -> Any:
    """Return a group or dataset of a group by its path, such as "a/b", without following links.

    Raises:
        InvalidFile: the path contains a link, or ends at neither a group nor a dataset.
        KeyError: it doesn't exist.
    """
    found = group
    for part in name.split("/"):
        if not isinstance(found, h5py.Group):
            raise InvalidFile(f"{name} should be in a group, but what holds {part} is none")
        encoded = part.encode()
        if not found.id.links.exists(encoded):
            raise KeyError(f"{name} is missing")
        if found.id.links.get_info(encoded).type != h5py.h5l.TYPE_HARD:
            raise InvalidFile(f"{name} is a link, should be stored in the file itself")
        found = found[part]
    if not isinstance(found, h5py.Group | h5py.Dataset):
        raise InvalidFile(f"{name} should be an array or a group")
    return found


def members(group: h5py.Group, name: str) -> list[str]:
    """Return the names in the group `name` of a group."""
    found = member(group, name)
    if not isinstance(found, h5py.Group):
        raise InvalidFile(f"{name} should be a group")
    return list(found)


def stored_column(
    group: h5py.Group, column: Column, sizes: MutableMapping[str, int], name: str = ""
) -> h5py.Dataset:
    """Return the dataset of a column after checking its type, shape and size, without reading it.

    Args:
        group: an open group.
        column: the schema; its `shape` is that of the whole column, including rows.
        sizes: values of the words in shapes; new words are added.
        name: name of the dataset in the group, if different from the column's.

    Raises:
        InvalidFile, KeyError: it doesn't match the schema, or doesn't exist.
    """
    data = member(group, name or column.name)
    if not isinstance(data, h5py.Dataset):
        raise InvalidFile(f"{column.name} is a group, should be {column.kind}")
    column.require_type(data.id.get_type(), _dtype(data.id, column))
    require_stored_here(data, column.name)
    _require_shape(column, data.shape, sizes)
    return data


def read_column(
    group: h5py.Group, column: Column, sizes: MutableMapping[str, int], name: str = ""
) -> NDArray[Any]:
    """Read and check the values of a column; arguments and errors as for `stored_column`."""
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
    """Read and check an attribute: a str, a NumPy scalar, or an array, depending on the shape."""
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
    """Raise InvalidFile if a dataset is in other files, has a filter other than those of
    _FILTERS, or is more than MOST_EXPANDED times as large as its stored bytes.
    """
    made = data.id.get_create_plist()
    layout = made.get_layout()
    if layout == h5py.h5d.VIRTUAL or made.get_external_count():
        raise InvalidFile(f"{name} is in other files, should be stored in the file itself")
    if any(made.get_filter(k)[0] not in _FILTERS for k in range(made.get_nfilters())):
        raise InvalidFile(f"{name} is compressed, but not with gzip")
    each = data.id.get_type().get_size()
    size = each * prod(data.shape or (0,))
    chunk = each * prod(made.get_chunk()) if layout == h5py.h5d.CHUNKED else 0
    if max(size, chunk) <= _SMALL:
        return
    stored = min(data.id.get_storage_size(), os.path.getsize(data.file.filename))
    if max(size, chunk) > _SMALL + MOST_EXPANDED * stored:
        raise InvalidFile(
            f"{name} declares {data.shape}, {size} bytes, and stores {stored}; at most"
            f" {MOST_EXPANDED} bytes per stored byte are read"
        )


def _texts(data: h5py.Dataset, name: str) -> NDArray[np.str_]:
    """Read strings of variable length in batches, checking lengths before memory is used up.

    Each row may refer to the same longest string of the file, so a small file can hold a lot.
    """
    if data.ndim == 0:
        return np.array(data[()].decode(), dtype=np.str_)
    if data.ndim != 1:
        raise InvalidFile(f"{name} is of shape {data.shape}, should be one text per row")
    found: list[str] = []
    for start in range(0, len(data), _TEXTS_AT_ONCE):
        texts = [text.decode() for text in data[start : start + _TEXTS_AT_ONCE].tolist()]
        if max(map(len, texts)) * len(data) > MOST_EXPANDED * _LONGEST_TEXT:
            raise InvalidFile(f"{name} holds a text of {max(map(len, texts))} characters")
        found += texts
    return np.array(found, dtype=np.str_)


def _require_shape(
    column: Column, shape: tuple[int, ...] | None, sizes: MutableMapping[str, int]
) -> None:
    """Check a shape; words that are not in `sizes` yet get the size that is found."""
    wanted = (None,) * len(shape or ()) if column.shape is None else column.shape
    expected = tuple(sizes.get(n) if isinstance(n, str) else n for n in wanted)
    if shape is None or not _fits(shape, expected):
        should_be = ", ".join("any" if size is None else str(size) for size in expected)
        raise InvalidFile(f"{column.name} is of shape {shape}, should be ({should_be})")
    for word, size in zip(wanted, shape, strict=True):
        if isinstance(word, str):
            sizes[word] = size


def _fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    return len(shape) == len(expected) and all(
        size in (None, found) for size, found in zip(expected, shape, strict=True)
    )


def _dtype(found: h5py.h5d.DatasetID | h5py.h5a.AttrID, column: Column) -> Any:
    try:
        return found.dtype
    except (TypeError, ValueError) as error:  # NumPy has no such type
        found_type = _type_name(found.get_type(), None)
        raise InvalidFile(f"{column.name} is {found_type}, should be {column.kind}") from error


def _type_name(found: h5py.h5t.TypeID, dtype: Any) -> str:
    """Describe a stored type in a word or two, for error messages."""
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
