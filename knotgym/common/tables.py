"""Tables: columns declared by a schema, in memory; `table_files` writes and reads them.

Text is `str`.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.errors import InvalidInput

Array = NDArray[np.float64]
Ids = NDArray[np.int64]  # indices of rows, beads, lanes, nodes, ...


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
                Column(name, type_name(values.dtype), values.shape[1:], optional=True, of="state")
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
            values = columns[c.name]
            if not self._columns:
                self.rows = len(values) if values.ndim else 0
            wanted = (self.rows, *c.shape)
            if len(wanted) == values.ndim:
                for word, size in zip(wanted, values.shape, strict=True):
                    if isinstance(word, str):
                        sizes.setdefault(word, size)
            expected = tuple(sizes.get(n, n) if isinstance(n, str) else n for n in wanted)
            if type_name(values.dtype) != c.dtype or values.shape != expected:
                given, right = f"{type_name(values.dtype)} {values.shape}", f"{c.dtype} {expected}"
                raise InvalidInput(f"column {c.name} is {given}, should be {right}")
            self._columns[c.name] = values
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
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
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


def padded(values: NDArray[Any], width: int, axis: int = -1) -> NDArray[Any]:
    """Cut an axis at a width, or lengthen it with zeros; only lengthening copies."""
    kept = values[(slice(None),) * (axis % values.ndim) + (slice(width),)]
    lacking = [(0, 0)] * values.ndim
    lacking[axis] = (0, width - kept.shape[axis])
    return np.pad(kept, lacking) if kept.shape[axis] < width else kept


def type_name(dtype: np.dtype[Any]) -> str:
    """Return the name that a column has for a type of NumPy's."""
    return "text" if dtype.kind == "U" else str(dtype)
