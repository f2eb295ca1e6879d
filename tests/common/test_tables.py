"""Tables are written and read back; files that don't fit are refused in one line."""

import fcntl
import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from knotgym.common.errors import InvalidFile, InvalidInput, MissingFile
from knotgym.common.table_files import format_of, read_tables, write_tables
from knotgym.common.tables import Column, Schema, Table

SCHEMA = Schema(
    "rows",
    (
        Column("points", "float64", ("beads", 3), "m", "where", finite=True),
        Column("source/seed", "int64", (), "[0, 9]", "seed", least=0),
        Column("code", "text", (), "", "Gauss code"),
        Column("done", "bool"),
        Column("score", "float32", optional=True),
    ),
    "a row",
)


def table(rows: int = 5, beads: int = 4) -> Table:
    return Table(
        SCHEMA,
        {
            "points": np.random.default_rng(0).random((rows, beads, 3)),
            "source/seed": np.arange(rows),
            "code": np.array(["", "1+,1-", "ä", "1-,1+", "x"])[np.arange(rows) % 5],
            "done": np.arange(rows) % 2 == 0,
        },
    )


def read_back(path: Path) -> Table:
    return read_tables(path, SCHEMA, format="ours")[0][0]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_tables(tmp_path / "rows.h5", [table()], {}, format="ours")
    return tmp_path / "rows.h5"


@pytest.mark.parametrize("pack", [False, True])
def test_a_table_comes_back_as_it_was(tmp_path: Path, pack: bool) -> None:
    write_tables(tmp_path / "rows.h5", [table()], {}, format="ours", pack=pack)
    back = read_back(tmp_path / "rows.h5")
    assert Table.digest(back) == Table.digest(table())
    assert dict(back.schema.sizes) == {"beads": 4}
    flags = back["points"].flags
    assert pack or not (flags.owndata or flags.writeable) and flags.aligned  # mapped
    with h5py.File(tmp_path / "rows.h5") as file:
        units = [{**file[SCHEMA.name][name].attrs} for name in ("points", "done")]
    assert units == [{"unit": b"m"}, {}]


@pytest.mark.parametrize("rows", [0, 1, 7])
def test_parts_are_appended(tmp_path: Path, path: Path, rows: int) -> None:
    parts = [table(rows), read_back(path)]
    write_tables(tmp_path / "all.h5", [parts], {}, format="ours", pack=True)
    whole = Table.digest(Table.joined([table(rows), table()]))
    assert Table.digest(read_back(tmp_path / "all.h5")) == Table.digest(*parts) == whole
    with pytest.raises(InvalidInput, match="tables to append differ: column points is float64"):
        Table.joined([table(beads=4), table(beads=5)])


def test_an_optional_column_that_a_part_lacks_is_unknown_there() -> None:
    scored = Table(SCHEMA, {**table(), "score": np.ones(5, np.float32)})
    assert "score" in Table.joined([scored, scored])
    joined = Table.joined([table(), scored])["score"]
    assert np.isnan(joined[:5]).all() and (joined[5:] == 1).all()


def test_padded_columns_get_the_longest_length(tmp_path: Path) -> None:
    schema = Schema("", (Column("code", "int64", ("visits", 2), padded=True),))
    parts = [Table(schema, {"code": np.ones((2, length, 2), np.int64)}) for length in (1, 3)]
    assert Table.joined(parts)["code"].sum(axis=(1, 2)).tolist() == [2, 2, 6, 6]
    write_tables(tmp_path / "rows.h5", [parts], {}, format="ours")
    (found,), _ = read_tables(tmp_path / "rows.h5", schema, format="ours")
    assert Table.digest(found) == Table.digest(Table.joined(parts))


def test_a_table_is_filled_with_values_that_say_unknown() -> None:
    columns = [
        Column("a", "int64"),
        Column("name", "text", optional=True),
        Column("score", "float64", ("wide",), optional=True),
        Column("row", "int64", optional=True),
    ]
    schema = Schema("", (*columns,), sizes=(("wide", 2),))
    whole = Table(schema, {"a": np.arange(3)}).filled(schema)
    assert whole["name"].tolist() == [""] * 3 and whole["row"].tolist() == [-1] * 3
    assert whole["score"].shape == (3, 2) and np.isnan(whole["score"]).all()
    steps = Schema("", (columns[0], Column("steps", "int64", optional=True, least=0)))
    with pytest.raises(InvalidInput, match="column steps is missing"):
        Table(steps, {"a": np.arange(3)}).filled(steps)


def test_rows_and_columns_are_taken_in_the_order_given() -> None:
    assert table().take([3, 0])["source/seed"].tolist() == [3, 0]
    assert table().take(table()["done"])["source/seed"].tolist() == [0, 2, 4]
    assert table().take([]).rows == 0
    assert list(table().only("done", "code")) == ["code", "done"]
    with pytest.raises(InvalidInput, match="no column colour"):
        table().only("colour")


def test_the_digest_depends_on_names_types_shapes_and_values() -> None:
    others = [
        Table(Schema("", (Column(name, dtype),)), {name: np.arange(rows, dtype=dtype)})
        for name, dtype, rows in (("a", "int64", 2), ("a", "int64", 3), ("b", "int64", 2))
        + (("a", "uint64", 2),)
    ]
    texts = [table().take([1]).replaced(code=np.array([code])) for code in ("1+,1-", "1-,1+")]
    assert len({Table.digest(one) for one in (table().take([0]), *others, *texts)}) == 7


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"done": np.zeros(5)}, r"column done is float64 \(5,\), should be bool \(5,\)"),
        ({"done": np.zeros(4, bool)}, r"column done is bool \(4,\), should be bool \(5,\)"),
        ({"points": np.zeros((5, 4))}, r"is float64 \(5, 4\), should be float64 \(5, 'beads', 3\)"),
        ({"code": np.array(["a"] * 5, object)}, r"column code is object \(5,\), should be text"),
    ],
)
def test_columns_that_do_not_fit_are_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        Table(SCHEMA, {**table(), **changed})


def external(file: h5py.File) -> None:
    file["rows"].create_dataset("source/seed", (5,), "i8", external=[("raw", 0, 40)])


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((5,), "i8")
    layout[:] = h5py.VirtualSource("other.h5", "numbers", (5,))
    file["rows"].create_virtual_dataset("source/seed", layout)


def stored(values: Any, **options: Any) -> Callable[[h5py.File], Any]:
    return lambda file: file["rows"].create_dataset("source/seed", data=values, **options)


def put(name: str, values: Any) -> Callable[[h5py.File], Any]:
    return lambda file: file[f"rows/{name}"].write_direct(
        np.asarray(values).astype(file[f"rows/{name}"].dtype)
    )


def attribute(name: str, value: Any) -> Callable[[h5py.File], Any]:
    return lambda file: file.attrs.update({name: value})


# what takes the place of the column source/seed, and the complaint
HARMED: dict[str, tuple[Callable[[h5py.File], Any], str]] = {
    "missing": (lambda file: None, "source/seed is missing"),
    "big-endian": (stored(np.arange(5, dtype=">i8")), "seed is >i8"),
    "enumeration": (stored([0] * 5, dtype=h5py.enum_dtype({"a": 0}, "i8")), "seed is int64, "),
    "nothing": (stored(h5py.Empty("i8")), "source/seed should be a dataset"),
    "too small": (stored(np.arange(5) - 2), "seed holds -2, should be at least 0"),
    "linked": (
        lambda file: file["rows/source"].update({"seed": h5py.SoftLink("/rows/done")}),
        "source/seed is missing",
    ),
    "external": (external, "is in other files"),
    "virtual": (virtual, "is in other files"),
    "another filter": (stored(np.arange(5), compression="lzf"), "but not with gzip"),
    "huge": (
        lambda file: file["rows"].create_dataset("source/seed", (10**10,), "i8", chunks=(1000,)),
        "declares 80000000000 bytes and stores 0",
    ),
    "not finite": (put("points", np.full((5, 4, 3), np.nan)), r"points holds nan at \[0, 0, 0\]"),
    "control characters": (put("code", [b"\x1b"] * 5), "code holds control characters"),
    "other text": (put("code", [b"\xff"] * 5), "utf-8"),
    "another format": (attribute("format", np.bytes_("theirs")), "format 'theirs'"),
    "another version": (attribute("format_version", 2), "version 2; .* 1"),
    "another unit": (
        lambda file: file["rows/points"].attrs.update(unit=np.bytes_(b"k")),
        "column points is in 'k'",
    ),
    "attribute of any length": (attribute("n", "a"), "attribute n is object"),
    "attribute to a terminal": (attribute("n", np.bytes_("\x1b")), "control characters"),
    "attribute of torn JSON": (attribute("n", np.bytes_("{1")), "isn't a whole HDF5 file"),
}


@pytest.mark.parametrize("harm", HARMED)
def test_a_harmed_file_is_refused_in_one_line(path: Path, harm: str) -> None:
    change, message = HARMED[harm]
    with h5py.File(path, "a") as file:
        if harm not in ("not finite", "control characters", "other text"):
            del file["rows/source/seed"]
        change(file)
    with pytest.raises(InvalidFile, match=message) as caught:
        read_back(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
def test_a_torn_file_is_refused(path: Path, share: float) -> None:
    raw = path.read_bytes()
    path.write_bytes(raw[: int(share * len(raw))])
    with pytest.raises(InvalidFile, match="isn't a whole HDF5 file"):
        read_back(path)


def test_what_is_no_file_is_named(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.h5")
    with pytest.raises(InvalidFile, match="isn't a regular file"):
        read_back(tmp_path / "pipe.h5")
    assert format_of(tmp_path / "pipe.h5") is None
    for name in ("absent.h5", ""):
        with pytest.raises(MissingFile, match=rf"no ours file at .*{name}"):
            read_back(tmp_path / name)


def test_a_file_that_a_writer_holds_is_read(path: Path) -> None:
    with path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # what HDF5 does
        assert read_back(path).rows == 5 and format_of(path) == "ours"


def test_a_size_is_the_same_in_the_whole_file(tmp_path: Path) -> None:
    other = Schema("other", (Column("x", "int64", ("beads",)),))
    for beads in (4, 5):
        more = Table(other, {"x": np.zeros((2, beads), int)})
        write_tables(tmp_path / f"{beads}.h5", [table(beads=4), more], {}, format="ours")
    assert len(read_tables(tmp_path / "4.h5", SCHEMA, other, format="ours")[0]) == 2
    with pytest.raises(InvalidFile, match=r"column x is int64 \(2, 5\), should be int64 \(2, 4\)"):
        read_tables(tmp_path / "5.h5", SCHEMA, other, format="ours")


def test_what_could_not_be_read_is_not_written(tmp_path: Path) -> None:
    harmed = Table(SCHEMA, {**table(), "code": np.array(["\x07"] * 5)})
    with pytest.raises(InvalidInput, match="control characters"):
        write_tables(tmp_path / "rows.h5", [harmed], {}, format="ours")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("pack", [False, True])
@pytest.mark.parametrize("room", [0, 1000, 100_000])
def test_a_full_disk_is_an_error_that_leaves_nothing(tmp_path: Path, pack: bool, room: int) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
        with pytest.raises(OSError, match="too large"):
            write_tables(tmp_path / "rows.h5", [table(20_000)], {}, format="ours", pack=pack)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert not list(tmp_path.iterdir())
