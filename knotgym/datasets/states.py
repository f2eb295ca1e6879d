"""The state file, `states.h5`: curated rope states that an environment resets from, one row a
state.

Layout (n rows): qpos (n, nq), points (n, beads, 3), image (n, 128, 128, 3), gauss_code,
gauss_code_chiral, knot, nx, split, quality/* (n,) with a `unit` attribute each, source/* (what
makes the row again: start, actions, seed, policy). The file's attributes name the format, the
versions of the package and of MuJoCo, the rope's fingerprint and the whole configuration.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from knotgym.atomic_files import atomic_write, new_hdf5
from knotgym.errors import KnotgymError, MissingFile

FORMAT = "knotgym-states"
FORMAT_VERSION = 1
SPLITS = ("train", "test")

_COMPRESSED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
_COLUMNS = ("qpos", "points", "image", "gauss_code", "gauss_code_chiral", "knot", "nx", "split")


class InvalidStates(KnotgymError, ValueError):
    """A file that isn't a state file this version can read, or arrays that don't make one."""


@dataclass(frozen=True)
class States:
    """The rows of a state file; arrays are read-only.

    Attributes:
        qpos: float64 (n, nq), MuJoCo generalized positions, at rest.
        points: float64 (n, beads, 3), metres.
        image: uint8 (n, size, size, 3), or None where not asked for.
        gauss_code, gauss_code_chiral, knot, split: str (n,).
        nx: int64 (n,).
        quality: measure -> float64 (n,).
        units: measure -> its unit.
        source: name -> (n, ...); `start_qpos` float64 (n, nq) laid at rest, then `actions` float32
            (n, T, 6), of which the first `steps` are taken, end in the row's qpos bit for bit;
            `seed`, `policy`, `trajectory` say where from.
        attributes: of the file.
    """

    qpos: NDArray[np.float64]
    points: NDArray[np.float64]
    image: NDArray[np.uint8] | None
    gauss_code: NDArray[np.str_]
    gauss_code_chiral: NDArray[np.str_]
    knot: NDArray[np.str_]
    nx: NDArray[np.int64]
    split: NDArray[np.str_]
    quality: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    source: dict[str, NDArray[Any]] = field(default_factory=dict)
    attributes: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.qpos)
        columns = {
            name: getattr(self, name) for name in _COLUMNS if getattr(self, name) is not None
        }
        for name, column in {**columns, **self.quality, **self.source}.items():
            if len(column) != n:
                raise InvalidStates(f"column {name} has {len(column)} rows, qpos has {n}")
            column.setflags(write=False)

    def __len__(self) -> int:
        return len(self.qpos)

    def rows(self, nx: int, split: str) -> NDArray[np.int64]:
        """Indices of the rows with nx crossings in a split."""
        return np.flatnonzero((self.nx == nx) & (self.split == split))


def shipped() -> Path:
    """The curated states that come with the package: 17 loops and 40 states for each nx from 1 to
    4.
    """
    return Path(str(files("knotgym.datasets") / "curated" / "states.h5"))


def states_file(named: str) -> Path:
    """The state file that a path means, or the id of a Minari dataset that carries one."""
    from knotgym.datasets.episode_reader import minari_root

    carried = minari_root() / named / "data" / "states.h5"
    return carried if carried.is_file() and not Path(named).is_file() else Path(named)


def write_states(path: str | os.PathLike[str], states: States) -> None:
    """Write a state file; it appears under its name whole or not at all."""
    if states.image is None:
        raise InvalidStates("a state file holds images; these states were read without")
    with atomic_write(path) as temporary, new_hdf5(temporary) as file:
        for name, value in {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            **states.attributes,
        }.items():
            file.attrs[name] = json.dumps(value) if isinstance(value, dict) else value
        for name in _COLUMNS:
            _write(file, name, getattr(states, name))
        for group in ("quality", "source"):  # there even if empty
            file.create_group(group)
        for name, values in states.quality.items():
            _write(file, f"quality/{name}", values).attrs["unit"] = states.units[name]
        for name, values in states.source.items():
            _write(file, f"source/{name}", values)


def read_states(path: str | os.PathLike[str], *, images: bool = True) -> States:
    """Read a state file.

    Args:
        path: of the file.
        images: whether to read the pictures, most of the bytes.

    Raises:
        FileNotFoundError: there is none.
        InvalidStates: foreign, truncated, or of a format this version doesn't know.
    """
    if not Path(path).is_file():
        raise MissingFile(f"no state file at {path}")
    try:
        with h5py.File(path, "r") as file:
            found = file.attrs.get("format", "none"), file.attrs.get("format_version", "none")
            if found != (FORMAT, FORMAT_VERSION):
                raise InvalidStates(
                    f"{path} has format {found[0]!r} version {found[1]}; this version reads"
                    f" {FORMAT!r} version {FORMAT_VERSION}"
                )
            text = {
                name: file[name].asstr()[()].astype(np.str_)
                for name in ("gauss_code", "gauss_code_chiral", "knot", "split")
            }
            return States(
                qpos=file["qpos"][()],
                points=file["points"][()],
                image=file["image"][()] if images else None,
                nx=file["nx"][()],
                quality={name: data[()] for name, data in file["quality"].items()},
                units={name: str(data.attrs["unit"]) for name, data in file["quality"].items()},
                source={name: _column(data) for name, data in file["source"].items()},
                attributes={
                    name: value
                    for name, value in file.attrs.items()
                    if name not in ("format", "format_version")
                },
                **text,
            )
    except InvalidStates:
        raise
    except (
        OSError,
        KeyError,
        RuntimeError,
        TypeError,
        ValueError,
        AttributeError,
    ) as error:  # whatever h5py says to foreign bytes
        raise InvalidStates(
            f"{path} isn't a whole state file: {' '.join(str(error).split())}"
        ) from error


def merge_states(parts: Sequence[States]) -> States:
    """Put the rows of several state files one after another, in order of nx; rows of one nx keep
    their order.

    Args:
        parts: read with images; made for the same rope, with the same measures.

    Raises:
        InvalidStates: they don't go together.
    """
    if not parts:
        raise InvalidStates("nothing to merge: name at least one state file")
    first = parts[0]
    for other in parts[1:]:
        if other.attributes.get("rope") != first.attributes.get("rope"):
            raise InvalidStates(
                f"states of one rope model can be merged, got {first.attributes.get('rope')} and"
                f" {other.attributes.get('rope')}"
            )
        if set(other.quality) != set(first.quality) or set(other.source) != set(first.source):
            raise InvalidStates("the files have different quality or source columns")
    longest = (
        max(part.source["actions"].shape[1] for part in parts) if "actions" in first.source else 0
    )
    order = np.argsort(np.concatenate([part.nx for part in parts]), kind="stable")

    def joined(columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate(columns)[order]

    def padded(actions: NDArray[Any]) -> NDArray[Any]:
        return np.pad(actions, ((0, 0), (0, longest - actions.shape[1]), (0, 0)))

    configs = [config for part in parts for config in _configs(part)]
    images = [part.image for part in parts if part.image is not None]
    return States(
        qpos=joined([part.qpos for part in parts]),
        points=joined([part.points for part in parts]),
        image=joined(images) if len(images) == len(parts) else None,
        gauss_code=joined([part.gauss_code for part in parts]),
        gauss_code_chiral=joined([part.gauss_code_chiral for part in parts]),
        knot=joined([part.knot for part in parts]),
        nx=joined([part.nx for part in parts]),
        split=joined([part.split for part in parts]),
        quality={name: joined([part.quality[name] for part in parts]) for name in first.quality},
        units=dict(first.units),
        source={
            name: joined(
                [
                    padded(part.source[name]) if name == "actions" else part.source[name]
                    for part in parts
                ]
            )
            for name in first.source
        },
        attributes={
            **first.attributes,
            "config": json.dumps(configs if len(configs) > 1 else configs[0]),
        },
    )


def _configs(part: States) -> list[Any]:
    config = json.loads(part.attributes.get("config", "{}"))
    return config if isinstance(config, list) else [config]


def _write(file: h5py.File, name: str, values: NDArray[Any]) -> h5py.Dataset:
    if values.dtype.kind == "U":
        return file.create_dataset(
            name, data=values.astype(object), dtype=h5py.string_dtype("utf-8"), **_COMPRESSED
        )
    chunks = (1, *values.shape[1:]) if name == "image" and len(values) else None
    options = _COMPRESSED if values.size else {}
    return file.create_dataset(name, data=values, chunks=chunks, **options)


def _column(data: h5py.Dataset) -> NDArray[Any]:
    if h5py.check_string_dtype(data.dtype):
        return np.asarray(data.asstr()[()].astype(np.str_))
    return np.asarray(data[()])
