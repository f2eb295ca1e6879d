"""Corrupted Parquet shards are refused in one line, or every fault is reported."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from synthetic_pictures import picture_rows

import knotgym
from knotgym.common import InvalidFile, InvalidInput
from knotgym.datasets import image_table as tables
from knotgym.datasets import select
from knotgym.datasets.image_table import PictureRow, arrow, read_rows, read_table
from knotgym.datasets.png import decode, encode
from knotgym.datasets.row_verification import _image_faults
from knotgym.datasets.subsets import kept
from knotgym.rendering import AppearanceConfig
from knotgym.states import read_states, shipped, write_states

from ..small_job import knotgym as typed


@pytest.fixture(scope="module")
def shard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A shard with one picture."""
    rows = picture_rows(read_states(shipped(), images=False).points[[20]])
    path = tmp_path_factory.mktemp("shard") / "train-00000-of-00001.parquet"
    path.write_bytes(tables.parquet(PictureRow.drawn(rows, AppearanceConfig())))
    return path


def changed(shard: Path, tmp_path: Path, change: Callable[[Any], Any]) -> Path:
    """Write a copy with a changed table."""
    from pyarrow import parquet

    path = tmp_path / shard.name
    parquet.write_table(change(parquet.read_table(shard)), path)
    return path


def with_cell(shard: Path, tmp_path: Path, *place: Any) -> Path:
    """Write a copy with one value changed: `place` is the column, its fields, and the value."""
    import pyarrow as pa

    def change(table: Any) -> Any:
        rows = table.to_pylist()
        held = rows[0]
        for name in place[:-2]:
            held = held[name]
        held[place[-2]] = place[-1]
        return pa.Table.from_pylist(rows, schema=table.schema)

    return changed(shard, tmp_path, change)


def test_tables_from_before_a_measure_was_added_stay_valid(shard: Path, tmp_path: Path) -> None:
    """Read, verified, selected, shown and streamed; a measure that isn't one is refused."""

    def with_measures(change: Callable[[Any], Any]) -> Path:
        table = read_table(shard)
        column = arrow().array([change(one) for one in table["quality"].to_pylist()])
        made = table.set_column(table.column_names.index("quality"), "quality", column)
        path = tmp_path / shard.name
        path.write_bytes(tables.parquet(made))
        return path

    older = with_measures(lambda own: {k: v for k, v in own.items() if k != "writhe"})
    assert knotgym.verify(older) == []
    part = select(older, tmp_path / "part.parquet", where="nx >= 0 and margin > 0")
    assert knotgym.verify(part) == [] and "writhe" not in tables.measures_of(read_table(part))
    assert typed("dataset", "show", older, "--quiet") == 0
    assert typed("dataset", "page", older, "--out", tmp_path / "page.html", "--quiet") == 0
    few = read_states(shipped()).take([0, 20])
    names = {*few.table} - {"quality/writhe"}
    write_states(tmp_path / "few.h5", type(few)(few.table.only(*names), few.attributes))
    assert knotgym.verify(tmp_path / "few.h5") == []
    with pytest.raises(InvalidFile, match="column quality is struct<.*new: double>, should be"):
        read_table(with_measures(lambda own: own | {"new": 1.0}))


def test_a_file_of_selected_pictures_is_known_by_its_suffix(shard: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="must end in .parquet, as files of pictures"):
        select(shard, out=tmp_path / "part")
    assert not any(tmp_path.iterdir())
    assert kept(select(shard, out=tmp_path / "part.parquet")) == "1 of 1 rows"


@pytest.mark.parametrize(
    ("place", "told"),
    [
        (("points", 0, 1e30), "m apart, the rope is 1.33 m long"),
        (("points", 0, float("nan")), "points are nan m apart"),
        (("quality", "margin", 3.0), "quality.margin is 3.0, recomputed"),
        (("appearance", "size", 2**31 - 1), "appearance.size is 2147483647, should be 64 to 512"),
        (("appearance", "blur", 1e30), "appearance.blur is 1e+30, should be -1000 to 1000"),
        (("appearance", "colours", "x"), "should be published or single or gradient"),
        (("gauss_code", None), "column gauss_code has missing values"),
        (("nx", 9), "nx is"),
        (("split", "validation"), "split is"),
        (("accepted", False), "accepted is"),
        (("appearance", "turn", 0.1), "image is not"),
        (("image", "bytes", encode(np.zeros((128, 128, 3), np.uint8))), "image is not"),
        (("crossings", 0, "x", 0.0), "crossings is"),
        (("source", "rope", 99), "its rows were changed after writing (SHA-256 differs)"),
    ],
)
def test_a_cell_is_checked(shard: Path, tmp_path: Path, place: tuple[Any, ...], told: str) -> None:
    found = [*_image_faults(with_cell(shard, tmp_path, *place))]
    assert any(told in fault for fault in found), found


def test_columns_of_another_type_missing_or_twice_are_refused(shard: Path, tmp_path: Path) -> None:
    import pyarrow as pa

    assert [*_image_faults(shard)] == []
    for change, told in (
        (lambda t: t.set_column(5, "nx", pa.array(["3"])), "column nx is string, should be int64"),
        (lambda t: t.drop_columns(["nx"]), "column nx must exist once, found 0"),
        (lambda t: t.append_column(t.field(5), t.column(5)), "column nx must exist once, found 2"),
        (lambda t: t.replace_schema_metadata({"knotgym": "[]"}), "has format 'none'"),
    ):
        with pytest.raises(InvalidFile, match=told):
            read_table(changed(shard, tmp_path, change))


@pytest.mark.parametrize("grained", [False, True])
def test_a_picture_is_stored_without_loss(grained: bool) -> None:
    drawn = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    assert np.array_equal(decode(encode(drawn, grained=grained)), drawn)


def test_a_picture_that_an_earlier_version_compressed_is_sound(shard: Path, tmp_path: Path) -> None:
    drawn = decode(next(iter(read_rows(shard)))["image"])
    levels = [cv2.IMWRITE_PNG_COMPRESSION, 9]
    packed = bytes(cv2.imencode(".png", drawn[..., ::-1], levels)[1])
    faults = [*_image_faults(with_cell(shard, tmp_path, "image", "bytes", packed))]
    assert [one for one in faults if "SHA-256" not in one] == []  # which is of the file's bytes


def test_a_picture_that_would_fill_the_memory_is_refused() -> None:
    sound = encode(np.zeros((8, 8, 3), np.uint8))
    assert decode(sound).shape == (8, 8, 3)
    bomb = sound[:16] + struct.pack(">II", 60_000, 60_000) + sound[24:]
    for data in (bomb, b"", b"GIF89a" + sound):
        with pytest.raises(InvalidFile):
            decode(data)
