"""Damage done to files of each kind, by class: mutations.py runs it.

What files of a kind are, file_readers.py says.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from damaged_hdf5 import HDF5, Damage, Random, bits, cut
from damaged_json import holder, not_json, pick, places, value_changed, value_missing

from knotgym.common.atomic_files import sha256


def ending(path: Path, rng: Random) -> None:
    """One bit of the last 4 kB flipped, where Parquet says what there is."""
    raw = bytearray(path.read_bytes())
    raw[-1 - int(rng.integers(min(4096, len(raw))))] ^= 1 << int(rng.integers(8))
    path.write_bytes(raw)


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
        return table.set_column(k, table.column_names[k], pick(rng, other))

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
        row = pick(rng, rows)
        found = [p for p in places(row) if p[0] != "points" or len(p) == 1 or p[1] < 3]
        odd = {
            float: (float("nan"), 1e30, -7.0, None),
            int: (-1, 99, 2**31 - 1, None),
            str: ("", "\x1b[2J", "9" * 100, None),
            bytes: (b"", b"\x89PNG\r\n\x1a\n" + b"\xff" * 40, None),
            bool: (None,),
        }
        choices = [p for p in found if type(holder(row, p)[p[-1]]) in odd]
        at = pick(rng, choices)
        now = holder(row, at)[at[-1]]
        holder(row, at)[at[-1]] = pick(rng, odd[type(now)]) if now is not True else False
        try:
            return pa.Table.from_pylist(rows, schema=table.schema)
        except (pa.ArrowException, OverflowError):
            return table.slice(0, max(1, len(table) - 1))

    _table_changed(path, change)


def metadata_changed(path: Path, rng: Random) -> None:
    """What a table says of itself, another."""
    other = (b"", b"[]", b"{", b'{"format": 1}', b"null", b'{"format": "knotgym-images"}')
    _table_changed(path, lambda table: table.replace_schema_metadata({"knotgym": pick(rng, other)}))


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
    name = pick(rng, sorted(tensors))
    now = tensors[name]
    spoilt = now.clone()
    spoilt.view(-1)[0] = pick(rng, (float("nan"), float("inf")))
    other = (spoilt, now[..., :0], now.to(torch.int8), now.reshape(-1, 1), now.to(torch.bool), None)
    tensors[name] = pick(rng, other)
    if tensors[name] is None:
        del tensors[name]
    save_file({key: own.contiguous() for key, own in tensors.items()}, weights)
    card = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**card, "weights_sha256": sha256(weights)}), encoding="utf-8")


def weights_changed(path: Path, rng: Random) -> None:
    """Bits of the weights flipped, their end missing, or no file there."""
    pick(rng, (bits, cut, no_file))(path.with_name("weights.safetensors"), rng)


def beside_changed(path: Path, rng: Random) -> None:
    """What lies beside or below a checkpoint changed: bits flipped, its end missing, no file."""
    others = [one for one in sorted(path.parent.rglob("*")) if one.is_file() and one != path]
    others = [one for one in others if one.stat().st_size]
    pick(rng, (bits, cut, no_file))(pick(rng, others), rng)


def request_changed(path: Path, rng: Random) -> None:
    """What a run was asked for, another."""
    request = next(iter(sorted(path.parent.glob("request.json")) + [path]))
    pick(rng, (value_changed, value_missing, not_json, no_file))(request, rng)


def text_changed(path: Path, rng: Random) -> None:
    """A word or character of a text another."""
    text = path.read_text(encoding="utf-8")
    at = int(rng.integers(len(text)))
    odd = pick(rng, ("nan", "1e999", "-", "x", "\x1b[2J", "", "\n\n", ",", "9" * 400))
    path.write_text(text[:at] + odd + text[at + 1 :], encoding="utf-8")


_BYTES = (bits, cut, not_json, no_file)
_JSON = (bits, cut, value_changed, value_missing, not_json, no_file)
_STAGED = (*_JSON, beside_changed, request_changed)
DAMAGES: dict[str, tuple[Damage, ...]] = {
    "states": HDF5,
    "episodes": HDF5,
    "pictures": (
        bits,
        ending,
        cut,
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
    "transitions": HDF5,
    "settings": _JSON,
    "scores": _JSON,
    "curves": (*_BYTES, text_changed),
    "models": _BYTES,
    "searches": _STAGED,
    "random_walks": _STAGED,
    "episode_files": (*_JSON, beside_changed),
    "walk_files": _BYTES,
    "trainings": (*_BYTES, beside_changed),
    "replies": _JSON,
    "caches": (cut, not_json, no_file),
}
# of files that are read with others, which
_WITH = {
    **dict.fromkeys(("manifests", "policies", "searches", "random_walks"), "**/*"),
    **dict.fromkeys(("walks", "archives"), "manifest.json"),
    **dict.fromkeys(("episode_files", "trainings", "caches"), "*"),
}


def copied(kind: str, source: Path, folder: Path) -> Path:
    """A copy to do damage to, with those of the files beside it that its readers look at."""
    for one in folder.iterdir():
        if one.is_dir() and not one.is_symlink():
            shutil.rmtree(one)
        else:
            one.unlink()
    beside = source.parent.glob(_WITH[kind]) if kind in _WITH else []
    for one in sorted({source, *beside}):
        if one.is_file() and one.name != "lock":
            target = folder / one.relative_to(source.parent)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(one.read_bytes())
    return folder / source.name
