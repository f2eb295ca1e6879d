"""Damage done to files of each kind, by class: mutations.py runs it.

Pictures are a Parquet shard; manifests, policies and transcripts are a JSON file with what lies
beside it in its folder.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from damaged_hdf5 import HDF5, Damage, Random

from knotgym.atomic_files import sha256

ODD: tuple[Any, ...] = (
    None,
    True,
    -1,
    1.5,
    2**70,
    float("nan"),
    "",
    "\x1b[2J",
    "../../x",
    "/dev/zero",
    [],
    {},
    [[1]],
    {"a": {"b": None}},
)


def _pick(rng: Random, choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]


def _places(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in a JSON value but the whole, as keys to go by."""
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    found = []
    for name, one in inner:
        found.append((*at, name))
        if isinstance(one, dict | list):
            found += _places(one, (*at, name))
    return found


def _holder(value: Any, place: tuple[Any, ...]) -> Any:
    for name in place[:-1]:
        value = value[name]
    return value


def _changed(path: Path, rng: Random, change: Callable[[Any, Any], None]) -> None:
    """Change a place in a JSON file, or in a line of a file of such lines."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.suffix == ".jsonl" else [""]
    line = int(rng.integers(len(lines)))
    value = json.loads(lines[line] or path.read_text(encoding="utf-8"))
    # shallow places, where readers look, as often as all the deep ones
    places = _places(value)
    depth = _pick(rng, sorted({len(place) for place in places}))
    place = _pick(rng, [one for one in places if len(one) == depth])
    change(_holder(value, place), place[-1])
    lines[line] = json.dumps(value)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def bytes_changed(path: Path, rng: Random) -> None:
    """One to four bits flipped."""
    raw = bytearray(path.read_bytes())
    for at in rng.integers(0, len(raw), int(rng.integers(1, 5))):
        raw[at] ^= 1 << int(rng.integers(8))
    path.write_bytes(raw)


def ending(path: Path, rng: Random) -> None:
    """One bit of the last 4 kB flipped, where Parquet says what there is."""
    raw = bytearray(path.read_bytes())
    raw[-1 - int(rng.integers(min(4096, len(raw))))] ^= 1 << int(rng.integers(8))
    path.write_bytes(raw)


def cut_short(path: Path, rng: Random) -> None:
    """Its end missing."""
    raw = path.read_bytes()
    path.write_bytes(raw[: int(rng.integers(len(raw)))])


def value_changed(path: Path, rng: Random) -> None:
    """One value of another type, out of range, or leading elsewhere."""
    odd = _pick(rng, ODD)

    def change(holder: Any, name: Any) -> None:
        holder[name] = odd

    _changed(path, rng, change)


def value_missing(path: Path, rng: Random) -> None:
    """One value gone."""
    _changed(path, rng, lambda holder, name: holder.__delitem__(name))


def not_json(path: Path, rng: Random) -> None:
    """Something else in its place: nested too deeply, another kind of value, no text, nothing."""
    other = (b"[" * 200_000, b"[1]", b'"a"', b"null", b"\xff\xfe", b"", b"9" * 10_000, b"{}")
    path.write_bytes(_pick(rng, other))


def no_file(path: Path, rng: Random) -> None:
    """A pipe in its place, a device, a link that leads nowhere or round in a circle, a folder."""
    path.unlink()
    way = int(rng.integers(5))
    if way == 0:
        os.mkfifo(path)
    elif way == 4:
        path.mkdir()
    else:
        path.symlink_to(("/dev/zero", "nowhere", path.name)[way - 1])


def column_type(path: Path, rng: Random) -> None:
    """A column of a table of another type."""
    import pyarrow as pa

    def change(table: Any) -> Any:
        k = int(rng.integers(table.num_columns))
        other = (
            pa.array([None] * len(table)),
            pa.array(["a"] * len(table)),
            pa.array([1.5] * len(table)),
            pa.array([2**40] * len(table)),
            pa.array([[1.0]] * len(table)),
            pa.array([{"a": 1}] * len(table)),
            pa.array([b"\xff"] * len(table)),
        )
        return table.set_column(k, table.column_names[k], _pick(rng, other))

    _table_changed(path, change)


def columns_moved(path: Path, rng: Random) -> None:
    """A column of a table missing, or there twice; or no rows, or all of them many times."""
    import pyarrow as pa

    def change(table: Any) -> Any:
        k, way = int(rng.integers(table.num_columns)), int(rng.integers(4))
        if way == 0:
            return table.remove_column(k)
        if way == 1:
            return table.append_column(table.field(k), table.column(k))
        if way == 2:
            return table.slice(0, 0)
        return pa.concat_tables([table] * 3)

    _table_changed(path, change)


def cell_changed(path: Path, rng: Random) -> None:
    """One number, word or picture of a table another, of the same type."""
    import pyarrow as pa

    def change(table: Any) -> Any:
        rows = table.to_pylist()
        row = _pick(rng, rows)
        places = [p for p in _places(row) if p[0] != "points" or len(p) == 1 or p[1] < 3]
        odd = {
            float: (float("nan"), 1e30, -7.0, None),
            int: (-1, 99, 2**31 - 1, None),
            str: ("", "\x1b[2J", "9" * 100, None),
            bytes: (b"", b"\x89PNG\r\n\x1a\n" + b"\xff" * 40, None),
            bool: (None,),
        }
        choices = [p for p in places if type(_holder(row, p)[p[-1]]) in odd]
        at = _pick(rng, choices)
        now = _holder(row, at)[at[-1]]
        _holder(row, at)[at[-1]] = _pick(rng, odd[type(now)]) if now is not True else False
        try:
            return pa.Table.from_pylist(rows, schema=table.schema)
        except (pa.ArrowException, OverflowError):
            return table.slice(0, max(1, len(table) - 1))

    _table_changed(path, change)


def metadata_changed(path: Path, rng: Random) -> None:
    """What a table says of itself, another."""
    other = (b"", b"[]", b"{", b'{"format": 1}', b"null", b'{"format": "knotgym-images"}')
    _table_changed(
        path, lambda table: table.replace_schema_metadata({"knotgym": _pick(rng, other)})
    )


def _table_changed(path: Path, change: Callable[[Any], Any]) -> None:
    from pyarrow import parquet

    table = change(parquet.read_table(path))
    parquet.write_table(table, path, compression="zstd")


def forged(path: Path, rng: Random) -> None:
    """Weights of other numbers, types or shapes, with the checksum made right."""
    import torch
    from safetensors.torch import load_file, save_file

    weights = path.with_name("weights.safetensors")
    tensors = load_file(weights)
    name = _pick(rng, sorted(tensors))
    now = tensors[name]
    spoilt = now.clone()
    spoilt.view(-1)[0] = _pick(rng, (float("nan"), float("inf")))
    other = (spoilt, now[..., :0], now.to(torch.int8), now.reshape(-1, 1), now.to(torch.bool), None)
    tensors[name] = _pick(rng, other)
    if tensors[name] is None:
        del tensors[name]
    save_file({key: own.contiguous() for key, own in tensors.items()}, weights)
    card = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**card, "weights_sha256": sha256(weights)}), encoding="utf-8")


def weights_changed(path: Path, rng: Random) -> None:
    """Bits of the weights flipped, their end missing, or no file there."""
    _pick(rng, (bytes_changed, cut_short, no_file))(path.with_name("weights.safetensors"), rng)


_JSON = (bytes_changed, cut_short, value_changed, value_missing, not_json, no_file)
DAMAGES: dict[str, tuple[Damage, ...]] = {
    "states": HDF5,
    "episodes": HDF5,
    "pictures": (
        bytes_changed,
        ending,
        cut_short,
        column_type,
        columns_moved,
        cell_changed,
        metadata_changed,
        no_file,
    ),
    "manifests": _JSON,
    "policies": (*_JSON, forged, weights_changed),
    "transcripts": _JSON,
    "walks": HDF5,
    "archives": HDF5,
}
_WITH = {"manifests": "*", "policies": "*", "walks": "manifest.json", "archives": "manifest.json"}


def copied(kind: str, source: Path, folder: Path) -> Path:
    """A copy to do damage to, with those of the files beside it that its readers look at."""
    beside = source.parent.glob(_WITH[kind]) if kind in _WITH else []
    for one in sorted({source, *beside}):
        target = folder / one.name
        if target.is_dir() and not target.is_symlink():
            target.rmdir()
        target.unlink(missing_ok=True)
        if one.is_file():
            target.write_bytes(one.read_bytes())
    return folder / source.name
