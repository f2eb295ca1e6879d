"""Damage done to HDF5 files of any kind: bits, types, sizes, links, attributes, values."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from damaged_json import change_one

TYPES = ("c16", "f4", "i1", "u8", "?", "S3", "V5", "i4,f8", "O", "ref", "enum")
Random = np.random.Generator
Damage = Callable[[Path, Random], None]


def _datasets(file: h5py.File) -> list[str]:
    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if hasattr(item, "dtype") else None)
    return names


def _one(file: h5py.File, rng: Random) -> str:
    names = _datasets(file)
    return names[int(rng.integers(len(names)))]


def bits(path: Path, rng: Random) -> None:
    """One to four bits flipped."""
    raw = bytearray(path.read_bytes())
    for at in rng.integers(0, len(raw), int(rng.integers(1, 5))):
        raw[at] ^= 1 << int(rng.integers(8))
    path.write_bytes(raw)


def head(path: Path, rng: Random) -> None:
    """One bit in the first 4 kB flipped, which are mostly the library's."""
    raw = bytearray(path.read_bytes())
    raw[int(rng.integers(min(4096, len(raw))))] ^= 1 << int(rng.integers(8))
    path.write_bytes(raw)


def cut(path: Path, rng: Random) -> None:
    """Its end missing."""
    raw = path.read_bytes()
    path.write_bytes(raw[: int(rng.integers(len(raw)))])


def types(path: Path, rng: Random) -> None:
    """A column of another type."""
    kind = TYPES[int(rng.integers(len(TYPES)))]
    special = {
        "O": h5py.string_dtype(),
        "ref": h5py.ref_dtype,
        "enum": h5py.enum_dtype({"a": 0, "b": 1}),
    }
    with h5py.File(path, "a") as file:
        name = _one(file, rng)
        shape = file[name].shape
        del file[name]
        file.create_dataset(name, shape, dtype=special.get(kind) or np.dtype(kind))


def sizes(path: Path, rng: Random) -> None:
    """A column of other sizes, up to 10 billion rows that aren't stored."""
    with h5py.File(path, "a") as file:
        name = _one(file, rng)
        old = file[name]
        shape, kind = list(old.shape) or [1], old.dtype
        del file[name]
        shape[int(rng.integers(len(shape)))] = int(rng.choice([0, 1, 3, 10**6, 10**10]))
        chunks = None if 0 in shape else tuple(min(n, 4) for n in shape)
        file.create_dataset(name, tuple(shape), dtype=kind, chunks=chunks)


def links(path: Path, rng: Random) -> None:
    """A column, or its group, that is a link, or that lies in another file."""
    with h5py.File(path, "a") as file:
        name = _one(file, rng)
        old = file[name]
        shape, kind = old.shape, old.dtype
        del file[name]
        way = int(rng.integers(4))
        if way == 0:
            file[name] = h5py.ExternalLink("/dev/zero", "/a")
        elif way == 1:
            file[name] = h5py.SoftLink("/" + _one(file, rng))
        elif way == 2 and kind.kind != "O" and shape:
            file.create_dataset(name, shape, kind, external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])
        elif shape:
            layout = h5py.VirtualLayout(shape, "f8")
            layout[:] = h5py.VirtualSource("/dev/zero", "a", shape)
            file.create_virtual_dataset(name, layout)


def attributes(path: Path, rng: Random) -> None:
    """An attribute of another type or value."""
    values = [1.5, True, "\x1b[2J", b"\xff", np.arange(3), "{}", -1, h5py.Empty("f8"), 2**63]
    with h5py.File(path, "a") as file:
        places = [file, *(file[name] for name in file if len(file[name].attrs))]
        holder = places[int(rng.integers(len(places)))]
        names = list(holder.attrs)
        holder.attrs[names[int(rng.integers(len(names)))]] = values[int(rng.integers(len(values)))]


def values(path: Path, rng: Random) -> None:
    """One number of a column another: a NaN, a huge one, a negative one."""
    with h5py.File(path, "a") as file:
        numeric = [name for name in _datasets(file) if file[name].dtype.kind in "fiu"]
        data = file[numeric[int(rng.integers(len(numeric)))]]
        if data.size:
            at = tuple(int(rng.integers(size)) for size in data.shape)
            new = [float("nan"), 1e30, -7.0] if data.dtype.kind == "f" else [99, 7, 1]
            data[at] = new[int(rng.integers(3))]


def inner(path: Path, rng: Random) -> None:
    """A value inside an attribute that is JSON, as a task or a configuration, another."""
    with h5py.File(path, "a") as file:
        told = {name: text for name, text in file.attrs.items() if str(text)[:1] == "{"}
        if told:
            name = sorted(told)[int(rng.integers(len(told)))]
            value = json.loads(told[name])
            change_one(value, rng)
            file.attrs[name] = json.dumps(value)


HDF5: tuple[Damage, ...] = (bits, head, cut, types, sizes, links, attributes, values, inner)
