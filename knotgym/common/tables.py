"""Tables: columns declared by a schema, in memory and in HDF5 files.

A file holds one group per table and one dataset per column. A column is stored contiguously, and
then the reader maps it into memory at its offset in the file, or it is compressed ("packed") and
read whole. Text is `str` in memory and fixed-length UTF-8 in the file.

The reader trusts nothing: it follows no links, refuses data stored in other files, and reads a
column only after checking its type, shape and size.
"""

import hashlib
import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.atomic_files import atomic_write, require_regular
from knotgym.common.errors import InvalidFile, InvalidInput, one_line

# A column may be this many times as large as its stored bytes: gzip expands at most 1032-fold.
_MOST_EXPANDED, _SMALL = 1100, 1 << 20  # columns of up to _SMALL bytes are always read
_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
_PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
_MAPPABLE = {"libver": ("v110", "v110"), "alignment_threshold": 1, "alignment_interval": 8}
_CHUNK = 1 << 20  # bytes of a packed chunk before compression
_HEADER = ("format", "format_version")


class Column(NamedTuple):
    """Schema of one column.

    Attributes:
        name: may contain slashes; "source/steps" is stored in the group `source`.
        dtype: NumPy's name of the type, such as "float64" or "bool", or "text".
        shape: shape of one row. A word, such as "beads", stands for a size that is the same in the
            whole file.
        unit: unit of the values; "" if they have none.
        doc: description.
        optional: whether a table may do without the column.
        finite: whether files with infinity or NaN are refused.
        least: the smallest number that a file may hold; None for no limit.
        of: what a value belongs to, where a table's rows stand for two things: in a table of steps
            "state" or "pull"; the last row of an episode is a state without a pull.
        derived: computes a row's value from what the schema's rows are made of (see the schema);
            None for a column that can't be computed again.
        padded: whether the first dimension of a row may differ between tables that are appended;
            shorter ones are padded with zeros.
        stepped: whether the engine makes the values again.
        unknown: what rows hold that have no value; None for what `no_value` says of the type.
    """

    name: str
    dtype: str
    shape: tuple[int | str, ...] = ()
    unit: str = ""
    doc: str = ""
    optional: bool = False
    finite: bool = False
    least: float | None = None
    of: str = ""
    derived: Callable[[Any], Any] | None = None
    padded: bool = False
    stepped: bool = False
    unknown: Any = None

    @property
    def origin(self) -> str:
        """Where values come from: "stepped" by an engine, "derived", or "given", which nothing can
        make again.
        """
        return "stepped" if self.stepped else "derived" if self.derived else "given"

    @property
    def numpy(self) -> Any:
        """The type as NumPy takes it, for new arrays; text gets as long as it needs."""
        return np.str_ if self.dtype == "text" else self.dtype

    @property
    def no_value(self) -> Any:
        """What rows hold that have no value: `unknown`, or else "", NaN or -1; None if each number
        of the type is a value, or files refuse that one.
        """
        if self.unknown is not None or self.dtype == "text":
            return "" if self.unknown is None else self.unknown
        kind = np.dtype(self.dtype).kind
        if kind == "f":
            return None if self.finite else float("nan")
        return -1 if kind == "i" and (self.least is None or self.least <= -1) else None

    def _require_values(self, values: NDArray[Any]) -> None:
        """Raise InvalidInput if text has control characters or numbers are out of range."""
        if self.dtype == "text":
            if not "".join(values.tolist()).isprintable():
                raise InvalidInput(f"column {self.name} holds control characters")
        elif self.dtype == "bool" and values.size and values.view(np.uint8).max() > 1:
            raise InvalidInput(f"column {self.name} holds bytes other than 0 and 1")
        elif self.finite and not np.isfinite(values).all():
            first = np.argwhere(~np.isfinite(values))[0].tolist()
            raise InvalidInput(f"column {self.name} holds {values[tuple(first)]} at {first}")
        elif self.least is not None and values.size and values.min() < self.least:
            least = f"{values.min()}, should be at least {self.least:g}"
            raise InvalidInput(f"column {self.name} holds {least}")


# changes a file's items by name, and its attributes, in place; an item may become an array
Upgrade = Callable[[dict[str, Any], dict[str, Any]], None]


class Schema(NamedTuple):
    """Schema of a table.

    Attributes:
        name: name of the HDF5 group; "" for the root group.
        columns: the columns.
        row: what one row is, for the documentation.
        sizes: values of the words in the columns' shapes. Words that have none yet get theirs from
            the first table or file that is checked against the schema.
        own: how names of columns begin that users add to tables, see `with_own`; "" for none.
    """

    name: str
    columns: tuple[Column, ...]
    row: str = ""
    sizes: tuple[tuple[str, int], ...] = ()
    own: str = ""

    def sized(self, **sizes: int) -> "Schema":
        """Return the schema with values for words in shapes."""
        return self._replace(sizes=tuple(sorted({**dict(self.sizes), **sizes}.items())))

    def only(self, *names: str) -> "Schema":
        """Return the schema of some of the columns, which stay in their order."""
        unknown = set(names) - {column.name for column in self.columns}
        if unknown:
            raise InvalidInput(f"no column {', '.join(sorted(unknown))} in table {self.name!r}")
        columns = tuple(c for c in self.columns if c.name in names)
        words = {word for column in columns for word in column.shape}
        sizes = tuple(size for size in self.sizes if size[0] in words)
        return self._replace(columns=columns, sizes=sizes)

    def without(self, *names: str) -> "Schema":
        """Return the schema without some of its columns, if it has them."""
        return self.only(*(column.name for column in self.columns if column.name not in names))

    @property
    def names(self) -> list[str]:
        """The names of the columns."""
        return [column.name for column in self.columns]

    def extended(self, *columns: Column) -> "Schema":
        """Return the schema with more columns, unless it has them."""
        known = {column.name for column in self.columns}
        more = tuple(column for column in columns if column.name not in known)
        return self._replace(columns=(*self.columns, *more))

    def with_own(self, columns: Mapping[str, NDArray[Any]]) -> "Schema":
        """Return the schema with the columns that users added to these."""
        return self.extended(
            *(
                Column(name, _type_name(values.dtype), values.shape[1:], optional=True, of="state")
                for name, values in columns.items()
                if self.own and name.startswith(self.own)
            )
        )

    def derive(self, origin: Any) -> dict[str, Any]:
        """Compute the derived columns of a row, by name, from what the row is made of."""
        return {name: of(origin) for name, of in self.derived().items()}

    def derived(self) -> dict[str, Callable[[Any], Any]]:
        """Return the functions of the derived columns by name."""
        return {c.name: c.derived for c in self.columns if c.derived}

    def _shape(self, column: Column) -> tuple[int, ...]:
        """Return the shape of a row of a column; all of its words must have values."""
        sizes = dict(self.sizes)
        return tuple(sizes[size] if isinstance(size, str) else size for size in column.shape)

    def empty(self, rows: int) -> dict[str, NDArray[Any]]:
        """Return new columns of zeros, by name, to be filled; without those of text if rows > 0.

        An array of text can't be filled, because it cuts texts to the length that it was made for.
        """
        return {
            c.name: np.zeros((rows, *self._shape(c)), "U1" if c.dtype == "text" else c.dtype)
            for c in self.columns
            if not rows or c.dtype != "text"
        }

    def page(self) -> str:
        """Return the documentation's table of the columns, in Markdown."""
        lines = ["| column | type, shape of a row | unit | |", "| --- | --- | --- | --- |"]
        for c in self.columns:
            shape = f" ({', '.join(map(str, c.shape))})" if c.shape else ""
            doc = f"optional; {c.doc}" if c.optional else c.doc
            lines.append(f"| `{c.name}` | {c.dtype}{shape} | {c.unit} | {doc} |")
        return "\n".join(lines)


class Table(Mapping[str, NDArray[Any]]):
    """Columns of equal length that fit a schema; the arrays are shared, not copied.

    Attributes:
        schema: the columns that are present, with the size of every word in their shapes.
        rows: number of rows.

    Raises:
        InvalidInput: a column is missing, or has another type, shape or length.
    """

    def __init__(self, schema: Schema, columns: Mapping[str, NDArray[Any]]) -> None:
        self._columns: dict[str, NDArray[Any]] = {}
        self.rows, sizes = 0, dict(schema.sizes)
        for c in schema.columns:
            if c.name not in columns:
                if c.optional:
                    continue
                raise InvalidInput(f"column {c.name} is missing")
            found = columns[c.name]
            if not self._columns:
                self.rows = len(found) if found.ndim else 0
            wanted = (self.rows, *c.shape)
            if len(wanted) == found.ndim:
                for word, size in zip(wanted, found.shape, strict=True):
                    if isinstance(word, str):
                        sizes.setdefault(word, size)
            expected = tuple(sizes.get(n, n) if isinstance(n, str) else n for n in wanted)
            if _type_name(found.dtype) != c.dtype or found.shape != expected:
                given, right = f"{_type_name(found.dtype)} {found.shape}", f"{c.dtype} {expected}"
                raise InvalidInput(f"column {c.name} is {given}, should be {right}")
            self._columns[c.name] = found
        self.schema = schema.sized(**sizes).only(*self._columns)

    def __reduce__(self) -> tuple[Any, ...]:
        # functions don't travel: a lambda can't be pickled
        plain = tuple(column._replace(derived=None) for column in self.schema.columns)
        return Table, (self.schema._replace(columns=plain), self._columns)

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        """Return the number of columns; `rows` is that of rows."""
        return len(self._columns)

    def take(self, rows: ArrayLike | slice) -> "Table":
        """Return some rows, by a mask or by indices, in the order given; a slice copies nothing."""
        chosen = rows if isinstance(rows, slice) else np.asarray(rows)
        if not isinstance(chosen, slice) and not chosen.size:
            chosen = slice(0)  # an empty list is one of floats
        return Table(self.schema, {name: column[chosen] for name, column in self.items()})

    def only(self, *names: str) -> "Table":
        """Return some columns."""
        return Table(self.schema.only(*names), self)

    def replaced(self, **columns: NDArray[Any]) -> "Table":
        """Return the table with other values in some columns."""
        return Table(self.schema, {**self, **columns})

    @classmethod
    def joined(cls, tables: Sequence["Table"]) -> "Table":
        """Append tables of one schema; of optional columns that some lack they have `no_value`.

        Raises:
            InvalidInput: there is no table, their schemas or sizes differ, or some lack a column
                that is required or has no value for unknown.
        """
        parts = Table.alike(tables)
        columns = {name: np.concatenate([one[name] for one in parts]) for name in parts[0]}
        return cls(parts[0].schema, columns)

    @staticmethod
    def alike(tables: Sequence["Table"]) -> "list[Table]":
        """Return tables with the columns that any has, padded ones as wide as the widest.

        Raises:
            InvalidInput: there is no table, types or sizes differ, or a column that some tables
                lack is required or has no value for unknown.
        """
        if not tables:
            raise InvalidInput("no table to append")
        every = {c.name: c for table in tables for c in table.schema.columns}
        required = {name for name, column in every.items() if not column.optional}
        if lacking := sorted(name for name in required if any(name not in one for one in tables)):
            raise InvalidInput(f"column {', '.join(lacking)} is missing in some tables to append")
        sizes = dict(pair for table in reversed(tables) for pair in table.schema.sizes)
        schema = tables[0].schema._replace(columns=(*every.values(),)).sized(**sizes)
        words = {c.name: str(c.shape[0]) for c in every.values() if c.padded}
        with InvalidInput.instead("tables to append differ", InvalidInput):
            tables = [
                table.filled(schema) if len(table) < len(every) else table for table in tables
            ]
            most = {name: max(table[name].shape[1] for table in tables) for name in words}
            schema = schema.sized(**{words[name]: width for name, width in most.items()})
            return [
                Table(
                    schema, {**table, **{name: padded(table[name], most[name], 1) for name in most}}
                )
                for table in tables
            ]

    def filled(self, schema: Schema) -> "Table":
        """Add the optional columns of a schema that are lacking, so that the two can be appended.

        Raises:
            InvalidInput: a file can't say that such a column has no values.
        """
        lacking = [c for c in schema.columns if c.optional and c.name not in self]
        if never := [c.name for c in lacking if c.no_value is None]:
            raise InvalidInput(
                f"column {', '.join(never)} is missing, and none of its values says that it is"
                " unknown"
            )
        shape = schema.sized(**dict(self.schema.sizes))._shape
        added = {c.name: np.full((self.rows, *shape(c)), c.no_value, c.numpy) for c in lacking}
        names = {*self, *added}
        return Table(schema._replace(sizes=()).only(*names), {**self, **added})

    def digest(self, *others: "Table") -> str:
        """Hash the names, types, shapes and values of all columns (SHA-256, hexadecimal).

        Args:
            others: more parts of the table; they are hashed as if they were `joined`.
        """
        parts, whole = (self, *others), hashlib.sha256()
        for name, values in sorted(self.items()):
            text, shape = values.dtype.kind == "U", (sum(p.rows for p in parts), *values.shape[1:])
            header = [name, "text" if text else values.dtype.str, shape]
            if text:
                header.append([value for part in parts for value in part[name].tolist()])
            whole.update(json.dumps(header).encode())
            for part in parts if not text else ():
                whole.update(np.ascontiguousarray(part[name]).data if part[name].size else b"")
        return whole.hexdigest()


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
        found = super().readinto(view) or 0
        view[found:] = bytes(len(view) - found)  # dropped data reads as zeros
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
        for one in values:
            c._require_values(one)
        dtype: Any = c.dtype
        if c.dtype == "text":
            values = [np.strings.encode(one, "utf-8") for one in values]
            dtype = h5py.string_dtype("utf-8", max(1, *(one.dtype.itemsize for one in values)))
            values = [one.astype(dtype) for one in values]
        shape, options, at = schema._shape(c), {}, 0
        if pack and rows and prod(shape):
            fitting = max(1, _CHUNK // (np.dtype(dtype).itemsize * prod(shape)))
            options = {**_PACKED, "chunks": (min(rows, fitting), *shape)}
        data = group.create_dataset(c.name, (rows, *shape), dtype, **options)
        if c.unit:
            data.attrs["unit"] = _fixed(c.unit)
        for one in values:
            data[at : at + len(one)] = one
            at += len(one)


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
            name, found = (attributes.pop(name, None) for name in _HEADER)
            items: dict[str, Any] = {}
            file.visititems(items.__setitem__)  # follows no links but hard ones
            while name == format and type(found) is int and found in upgrades:
                upgrades[found](items, attributes)
                found += 1
            if (name, found) != (format, version) or type(found) is not int:
                raise InvalidFile(
                    f"{path} has format {name!r} version {found!r}; this version reads"
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
        kind = _type_name(data.dtype)
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
    if _type_name(values.dtype) == column.dtype:
        column._require_values(values)
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


def padded(values: NDArray[Any], width: int, axis: int = -1) -> NDArray[Any]:
    """Cut an axis at a width, or lengthen it with zeros; only lengthening copies."""
    kept = values[(slice(None),) * (axis % values.ndim) + (slice(width),)]
    lacking = [(0, 0)] * values.ndim
    lacking[axis] = (0, width - kept.shape[axis])
    return np.pad(kept, lacking) if kept.shape[axis] < width else kept


def _type_name(dtype: np.dtype[Any]) -> str:
    return "text" if dtype.kind == "U" else str(dtype)
