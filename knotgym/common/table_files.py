"""Files of tables: one HDF5 group per table, and one dataset per column.

A column is stored contiguously, and then the reader maps it into memory at its offset in the file,
or it is compressed ("packed") and read whole. Text is fixed-length UTF-8.

The reader trusts nothing: it follows no links, refuses data stored in other files, and reads a
column only after checking its type, shape and size.
"""

import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write, require_regular
from knotgym.common.errors import InvalidFile, InvalidInput, one_line
from knotgym.common.tables import Column, Schema, Table, type_name

# A column may be this many times as large as its stored bytes: gzip expands at most 1032-fold.
_MOST_EXPANDED, _SMALL = 1100, 1 << 20  # columns of up to _SMALL bytes are always read
_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
_PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
_MAPPABLE = {"libver": ("v110", "v110"), "alignment_threshold": 1, "alignment_interval": 8}
_CHUNK = 1 << 20  # bytes of a packed chunk before compression
_HEADER = ("format", "format_version")

# changes a file's items by name, and its attributes, in place; an item may become an array
Upgrade = Callable[[dict[str, Any], dict[str, Any]], None]


def write_tables(
    path: str | os.PathLike[str],
    tables: Iterable[Table | Sequence[Table]],
    attributes: Mapping[str, Any],
    *,
    format: str,
    version: int = 1,
    pack: bool = False,
) -> None:
    """Write tables to a file atomically; it is replaced if it exists.

    Args:
        path: path of the file.
        tables: each a table, or its parts, which are appended as by `Table.joined` but one at a
            time, so that mapped files aren't read into memory.
        attributes: attributes of the file: text and numbers, or lists and dictionaries, which are
            stored as JSON. So text that begins with "{" or "[" is read as JSON.
        format, version: what `read_tables` requires.
        pack: whether to compress the columns, which then aren't mapped but read.

    Raises:
        InvalidInput: parts of a table differ in schema, or values are out of range.
    """
    with atomic_write(path) as part, new_hdf5(part, **_MAPPABLE) as file:
        for name, value in {**attributes, "format": format, "format_version": version}.items():
            plain = isinstance(value, str | int | float | np.generic)
            stored = value if plain else json.dumps(value, sort_keys=True)
            file.attrs[name] = _fixed(stored) if isinstance(stored, str) else stored
        for table in tables:
            _write_table(file, [table] if isinstance(table, Table) else table, pack)


@contextmanager
def new_hdf5(path: str | os.PathLike[str], **options: Any) -> Iterator[h5py.File]:
    """Yield a new HDF5 file; `options` are passed to h5py.File.

    The HDF5 library can't handle a failed write: on a full disk it can't close the file, and may
    crash. So failures are hidden from it: data that doesn't fit is dropped, and the error is raised
    here once the file is closed.

    Raises:
        OSError: something could not be written.
    """
    with _Sink(path, "w+") as sink:
        try:
            with h5py.File(sink, "w", **options) as file:
                yield file
        finally:
            if failure := sink.failure:
                raise OSError(failure.errno, failure.strerror, str(path)) from failure


class _Sink(io.FileIO):
    """A file for h5py whose writes never fail; `failure` is the first error."""

    failure: OSError | None = None

    def write(self, data: Any) -> int:
        view, done = memoryview(data).cast("B"), 0
        try:
            while self.failure is None and done < len(view):
                done += super().write(view[done:]) or 0
        except OSError as error:
            self.failure = error
        return len(view)

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        count = super().readinto(view) or 0
        view[count:] = bytes(len(view) - count)  # dropped data reads as zeros
        return len(view)


def _fixed(text: str) -> NDArray[Any]:
    """Return text of fixed length: damaged heaps of others make the HDF5 library hang."""
    return np.array(text.encode(), h5py.string_dtype("utf-8", len(text.encode()) or 1))


def _write_table(file: h5py.File, parts: Sequence[Table], pack: bool) -> None:
    parts = Table.alike(parts)
    schema, rows = parts[0].schema, sum(part.rows for part in parts)
    group = file.require_group(schema.name) if schema.name else file
    for c in schema.columns:
        values = [part[c.name] for part in parts]
        for array in values:
            _require_values(c, array)
        dtype: Any = c.dtype
        if c.dtype == "text":
            values = [np.strings.encode(array, "utf-8") for array in values]
            dtype = h5py.string_dtype("utf-8", max(1, *(array.dtype.itemsize for array in values)))
            values = [array.astype(dtype) for array in values]
        shape, options, at = values[0].shape[1:], {}, 0
        if pack and rows and prod(shape):
            fitting = max(1, _CHUNK // (np.dtype(dtype).itemsize * prod(shape)))
            options = {**_PACKED, "chunks": (min(rows, fitting), *shape)}
        data = group.create_dataset(c.name, (rows, *shape), dtype, **options)
        if c.unit:
            data.attrs["unit"] = _fixed(c.unit)
        for array in values:
            data[at : at + len(array)] = array
            at += len(array)


def read_tables(
    path: str | os.PathLike[str],
    *schemas: Schema,
    format: str,
    version: int = 1,
    upgrades: Mapping[int, Upgrade] = MappingProxyType({}),
) -> tuple[list[Table], dict[str, Any]]:
    """Read tables from a file and check them against their schemas.

    Args:
        path: path of the file.
        schemas: the tables to read; columns that they don't list are left alone.
        format, version: what the file must say it is.
        upgrades: earlier version -> function that makes its content that of the next version.

    Returns:
        One table per schema, and the file's attributes. Contiguous columns are read-only and mapped
        into memory. The file must not be modified meanwhile, only replaced.

    Raises:
        MissingFile: there is no such file.
        InvalidFile: it is damaged, of another format or version, or doesn't fit the schemas.
    """
    require_regular(path, f"{format} file")
    try:
        with h5py.File(path, "r", locking=False) as file:
            attributes = {name: _attribute(file, name) for name in file.attrs}
            name, stored = (attributes.pop(name, None) for name in _HEADER)
            items: dict[str, Any] = {}
            file.visititems(items.__setitem__)  # follows no links but hard ones
            while name == format and type(stored) is int and stored in upgrades:
                upgrades[stored](items, attributes)
                stored += 1
            if (name, stored) != (format, version) or type(stored) is not int:
                raise InvalidFile(
                    f"{path} has format {name!r} version {stored!r}; this version reads"
                    f" {format!r} version {version}"
                )
            tables: list[Table] = []
            sizes: dict[str, int] = {}
            for schema in schemas:
                within = f"{schema.name}/".lstrip("/")
                schema = schema.with_own(
                    {
                        name.removeprefix(within): item
                        for name, item in items.items()
                        if name.startswith(within) and isinstance(item, h5py.Dataset)
                    }
                )
                names = {c: within + c.name for c in schema.columns}
                columns = {c.name: _read(c, items[n], path) for c, n in names.items() if n in items}
                tables.append(Table(schema.sized(**{**sizes, **dict(schema.sizes)}), columns))
                sizes |= dict(tables[-1].schema.sizes)
            return tables, attributes
    except InvalidFile:
        raise
    except Exception as error:  # there is no end to what foreign bytes make h5py and NumPy raise
        # trouble of access, which has a number, isn't damage
        fault = "can't be read" if getattr(error, "errno", None) else "isn't a whole HDF5 file"
        raise InvalidFile(f"{path} {fault}: {one_line(error)}") from error


def format_of(path: str | os.PathLike[str]) -> str | None:
    """Return the format that a file claims to have; None if it isn't one of ours."""
    try:
        require_regular(path, "file")
        with h5py.File(path, "r", locking=False) as file:
            return str(_attribute(file, "format"))
    except Exception:
        return None


def _attribute(file: h5py.HLObject, name: str, is_json: bool = True) -> Any:
    """Read an attribute of a file or column: text, a number, or what its JSON holds."""
    stored = file.attrs.get_id(name)  # a damaged one may declare any size
    if stored.shape != () or stored.dtype.kind not in "biufS":
        raise InvalidInput(f"attribute {name} is {stored.dtype} {stored.shape}, not text or number")
    value = file.attrs[name]
    value = value.decode() if isinstance(value, bytes) else value.item()
    if not f"{name}{value}".isprintable():
        raise InvalidInput(f"attribute {name!r} holds control characters")
    is_json &= isinstance(value, str) and value[:1] in ("{", "[")
    return json.loads(value) if is_json else value


def _read(column: Column, data: Any, path: str | os.PathLike[str]) -> NDArray[Any]:
    """Return the values of a column, all checked but for their shape: mapped if contiguous."""
    if isinstance(data, np.ndarray):  # an upgrade made it
        return data
    if not isinstance(data, h5py.Dataset) or data.shape is None:
        raise InvalidInput(f"column {column.name} should be a dataset")
    if h5py.check_enum_dtype(data.dtype) is not None or data.dtype.hasobject:
        kind = type_name(data.dtype)
        raise InvalidInput(f"column {column.name} is {kind}, should be {column.dtype}")
    require_stored(data, column.name)
    # files that ship have units of variable length, which isn't read
    is_fixed = "unit" in data.attrs and data.attrs.get_id("unit").dtype.kind == "S"
    if is_fixed and (unit := _attribute(data, "unit", is_json=False)) != column.unit:
        raise InvalidInput(f"column {column.name} is in {unit!r}")
    offset = data.id.get_offset()
    if data.dtype.kind == "S":
        values: NDArray[Any] = np.strings.decode(np.asarray(data[()]), "utf-8").astype(np.str_)
    elif offset is None or not data.size:
        values = np.asarray(data[()])
    else:
        # a plain array over the mapped bytes: unlike np.memmap itself, it is fast to slice
        mapped = np.memmap(Path(path), data.dtype, "r", offset, data.shape)
        values = np.require(np.asarray(mapped), None, "A")
    if type_name(values.dtype) == column.dtype:
        _require_values(column, values)
    return values


def require_stored(data: h5py.Dataset, name: str) -> None:
    """Refuse data in other files, unusual filters, and sizes beyond what the bytes can hold."""
    made = data.id.get_create_plist()
    layout = made.get_layout()
    if layout == h5py.h5d.VIRTUAL or made.get_external_count():
        raise InvalidInput(f"column {name} is in other files, should be stored in the file itself")
    if any(made.get_filter(k)[0] not in _FILTERS for k in range(made.get_nfilters())):
        raise InvalidInput(f"column {name} is compressed, but not with gzip")
    chunk = prod(made.get_chunk()) if layout == h5py.h5d.CHUNKED else 0
    size = data.dtype.itemsize * max(prod(data.shape), chunk)
    stored = min(data.id.get_storage_size(), os.path.getsize(data.file.filename))
    if size > _SMALL + _MOST_EXPANDED * stored:
        raise InvalidInput(f"column {name} declares {size} bytes and stores {stored}")


def _require_values(column: Column, values: NDArray[Any]) -> None:
    """Raise InvalidInput if text has control characters or numbers are out of range."""
    if column.dtype == "text":
        if not "".join(values.tolist()).isprintable():
            raise InvalidInput(f"column {column.name} holds control characters")
    elif column.dtype == "bool" and values.size and values.view(np.uint8).max() > 1:
        raise InvalidInput(f"column {column.name} holds bytes other than 0 and 1")
    elif column.finite and not np.isfinite(values).all():
        first = np.argwhere(~np.isfinite(values))[0].tolist()
        raise InvalidInput(f"column {column.name} holds {values[tuple(first)]} at {first}")
    elif column.least is not None and values.size and values.min() < column.least:
        least = f"{values.min()}, should be at least {column.least:g}"
        raise InvalidInput(f"column {column.name} holds {least}")
