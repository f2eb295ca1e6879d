"""The state file, `states.h5`: one row per rope state that an environment can reset to.

`schema` lists its columns and attributes.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write, new_hdf5
from knotgym.common.errors import InvalidFile
from knotgym.common.hdf5_files import (
    Column,
    members,
    opened_hdf5,
    read_attribute,
    read_column,
    stored_column,
)
from knotgym.rope.engines import MUJOCO
from knotgym.states.near_duplicates import repeated
from knotgym.states.schema import ATTRIBUTES, COLUMNS, DIGEST, FORMAT, FORMAT_VERSION, ROOT
from knotgym.topology.gauss import GaussCode
from knotgym.topology.notation import dt_text, pd_text
from knotgym.topology.symmetry import diagram_form

_COMPRESSED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
_GROUPS = ("quality", "source")
_DERIVED: Any = None  # a column that follows from the others


@dataclass(frozen=True)
class States:
    """The rows of a state file, as read-only arrays.

    Attributes:
        qpos: float64 (n, nq), MuJoCo generalized positions, at rest.
        points: float64 (n, beads, 3), metres.
        image: uint8 (n, size, size, 3); None if read without pictures.
        gauss_code, gauss_code_chiral, knot, split: str (n,).
        nx: int64 (n,).
        pd_code, dt_code: str (n,), see `topology.notation`; by default those of gauss_code_chiral.
        quality: measure -> float64 (n,).
        units: measure -> its unit.
        source: name -> (n, ...), the provenance. A rope laid at rest at `start_qpos`, float64
            (n, nq), and stepped with the first `steps` of `actions`, float32 (n, T, 6), ends in the
            row's qpos bit for bit; for the other columns see `schema`.
        attributes: attributes of the file.
        digest: `content_digest` when the file was written; "" if the file has none.
    """

    qpos: NDArray[np.float64]
    points: NDArray[np.float64]
    image: NDArray[np.uint8] | None
    gauss_code: NDArray[np.str_]
    gauss_code_chiral: NDArray[np.str_]
    knot: NDArray[np.str_]
    nx: NDArray[np.int64]
    split: NDArray[np.str_]
    pd_code: NDArray[np.str_] = _DERIVED
    dt_code: NDArray[np.str_] = _DERIVED
    quality: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    source: dict[str, NDArray[Any]] = field(default_factory=dict)
    attributes: dict[str, Any] = field(default_factory=dict)
    digest: str = ""

    def __post_init__(self) -> None:
        for name, text_of in (("pd_code", pd_text), ("dt_code", dt_text)):
            if getattr(self, name) is _DERIVED:
                written, rows = np.unique(self.gauss_code_chiral, return_inverse=True)
                texts = [text_of(GaussCode.parse(code)) for code in written.tolist()]
                object.__setattr__(self, name, np.array(texts, dtype=np.str_)[rows])
        for name, values in self.columns().items():
            if len(values) != len(self.qpos):
                raise InvalidFile(
                    f"column {name} has {len(values)} rows, qpos has {len(self.qpos)}"
                )
            values.setflags(write=False)

    def __len__(self) -> int:
        return len(self.qpos)

    @property
    def engine(self) -> str:
        """The engine that the provenance is replayed with, see `knotgym.rope.engines`."""
        return str(self.attributes.get("engine", MUJOCO))

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return all columns by their path in the file, such as "nx" and "source/steps"."""
        root = {column.name: getattr(self, column.name) for column in ROOT}
        grouped = {
            f"{group}/{name}": values
            for group in _GROUPS
            for name, values in getattr(self, group).items()
        }
        return {name: values for name, values in {**root, **grouped}.items() if values is not None}

    def with_columns(self, columns: Mapping[str, NDArray[Any]]) -> States:
        """Replace all columns; columns that aren't given are dropped."""
        return replace(self, **_fields_of(columns), digest="")

    def rows(self, nx: int, split: str) -> NDArray[np.int64]:
        """Return the indices of the rows with nx crossings in a split.

        "train-code" has the rows of "train" whose diagram isn't held out, "test-code" those of
        "test" whose diagram is. Held out are the diagrams that occur in test only and then those
        that are rarest in train, up to a quarter of the diagrams of the nx; train keeps at least
        one diagram. Loops and curls have a single diagram each and are in both.
        """
        base, by_code, _ = split.partition("-code")
        rows = np.flatnonzero((self.nx == nx) & (self.split == base))
        if not by_code or nx < 2:
            return rows
        train, test = (
            [diagram_form(GaussCode.parse(code)) for code in self.gauss_code[own].tolist()]
            for own in (self.rows(nx, "train"), self.rows(nx, "test"))
        )
        # diagrams of test in the order in which they are held out: absent from train first
        seen = Counter(train)
        rarest = sorted({*test}, key=lambda form: (seen[form], form.visits))
        wanted = math.ceil(len({*train, *test}) / 4)
        held = {
            form
            for rank, form in enumerate(rarest)
            if form not in train or (rank < wanted and {*train} - {*rarest[: rank + 1]})
        }
        own = train if base == "train" else test
        return rows[[(form in held) == (base == "test") for form in own]]

    def taken(self, rows: NDArray[np.integer]) -> States:
        """Select rows, in the order given."""
        return self.with_columns({name: values[rows] for name, values in self.columns().items()})


SHIPPED = {  # name -> file
    "readable": "states.h5",
    "random-walk": "random-walk.h5",
    "hard-unknots": "hard-unknots.h5",
}


def shipped(name: str = "readable") -> Path:
    """Return the path of a set of states that ships with the package.

    Args:
        name: "readable", curated so that the code can be read off the picture, or "random-walk", as
            random play reaches them without over-twisted ones, each with 17 loops and 40 states for
            each nx from 1 to 4; or "hard-unknots", unknots with 7, 10 and 11 crossings, of which
            those with 10 and 11 have neither kinks nor bigons.

    Raises:
        InvalidFile: there is no set of that name.
    """
    if name not in SHIPPED:
        raise InvalidFile(f"no shipped set of states {name!r}; there are {', '.join(SHIPPED)}")
    return Path(str(files("knotgym.states") / "curated" / SHIPPED[name]))


def ships(named: str | None) -> bool:
    """Whether a task's `states` names a shipped set; None means "readable"."""
    return named is None or named in SHIPPED


def minari_root() -> Path:
    """Return the root folder of Minari datasets: MINARI_DATASETS_PATH, else Minari's default."""
    return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")


def states_file(named: str | None) -> Path:
    """Resolve a task's `states` to a file.

    Args:
        named: the name of a shipped set (None for "readable"), the id of a Minari dataset that
            includes a state file, or the path of a state file or of the folder with `states.h5`.
    """
    if named is None or named in SHIPPED:
        return shipped(named or "readable")
    carried = minari_root() / named / "data" / "states.h5"
    is_id = not leads_out(named) and carried.is_file()
    return carried if is_id and not Path(named).is_file() else states_at(Path(named))


def states_at(path: Path) -> Path:
    """Return a path itself, or `states.h5` in it if it is a folder."""
    return path / "states.h5" if path.is_dir() else path


def leads_out(named: str | os.PathLike[str]) -> bool:
    """Whether a path is absolute or contains "..", and so may lead out of a folder."""
    return Path(named).is_absolute() or ".." in Path(named).parts


def demonstrations_id(nx: int, split: str = "train", knot: str = "0_1") -> str:
    """Return the id of the Minari dataset that demonstrates the states of an nx, split and knot.

    Demonstrations of loops (nx 0) are episodes of an unknot task, because nothing is tied.

    >>> demonstrations_id(3)
    'knotgym/tie-nx3/demonstrations-v0'
    >>> demonstrations_id(0, "test")
    'knotgym/unknot-nx0/demonstrations-test-v0'
    >>> demonstrations_id(3, knot="3_1")
    'knotgym/tie-nx3-3_1/demonstrations-v0'
    """
    name = "demonstrations" if split == "train" else f"demonstrations-{split}"
    knotted = "" if knot == "0_1" else f"-{knot}"
    return f"knotgym/{'tie' if nx else 'unknot'}-nx{nx}{knotted}/{name}-v0"


def write_states(path: str | os.PathLike[str], states: States) -> None:
    """Write a state file atomically."""
    if states.image is None:
        raise InvalidFile("a state file needs images, but these states were read without")
    with atomic_write(path) as temporary, new_hdf5(temporary) as file:
        file.attrs["format"], file.attrs["format_version"] = FORMAT, FORMAT_VERSION
        for name, value in states.attributes.items():
            file.attrs[name] = json.dumps(value) if isinstance(value, dict) else value
        file.attrs[DIGEST] = content_digest(states)
        for group in _GROUPS:  # even if empty
            file.create_group(group)
        for name, values in states.columns().items():
            written = _write(file, name, values)
            group, _, measure = name.partition("/")
            if group == "quality":
                written.attrs["unit"] = states.units[measure]


def read_states(path: str | os.PathLike[str], *, images: bool = True) -> States:
    """Read a state file.

    Args:
        path: path of the file.
        images: whether to read the pictures, which are most of the bytes.

    Raises:
        MissingFile: there is no such file.
        InvalidFile: the file is foreign, truncated or of an unknown format version.
    """
    with opened_hdf5(
        path, what="state file", format=FORMAT, versions=(FORMAT_VERSION,), error=InvalidFile
    ) as file:
        names = [column.name for column in ROOT if images or column.name != "image"]
        names += [f"{group}/{name}" for group in _GROUPS for name in members(file, group)]
        sizes: dict[str, int] = {}
        columns = {name: read_column(file, _whole(name), sizes) for name in names}
        return States(
            **_fields_of(columns),
            units={
                name.removeprefix("quality/"): read_attribute(
                    stored_column(file, _whole(name), sizes), Column("unit", "text", ())
                )
                for name in names
                if name.startswith("quality/")
            },
            attributes=_attributes(file),
            digest=read_attribute(file, Column(DIGEST, "text", ())) if DIGEST in file.attrs else "",
        )


def content_digest(states: States) -> str:
    """Hash all columns and their names (SHA-256, hexadecimal), however they are compressed."""
    whole = hashlib.sha256()
    for name, values in sorted(states.columns().items()):
        text = values.dtype.kind == "U"
        header = [name, "text" if text else values.dtype.str, values.shape]
        whole.update(json.dumps([*header, values.tolist()] if text else header).encode())
        whole.update(b"" if text else np.ascontiguousarray(values).tobytes())
    return whole.hexdigest()


def _whole(name: str) -> Column:
    """Return the schema of a column with its rows; unknown measures and provenance are allowed."""
    for column in COLUMNS:
        if column.name == name:
            return replace(column, shape=("rows", *(column.shape or ())))
    if name.startswith("quality/"):
        return Column(name, "float64", ("rows",))
    return Column(name, "any", None)


def _attributes(file: h5py.File) -> dict[str, Any]:
    """Read all attributes but format, version and digest; check that `config` is JSON."""
    found = {
        name: read_attribute(file, Column(name, "text" if name in ATTRIBUTES else "any", ()))
        for name in file.attrs
        if name not in ("format", "format_version", DIGEST)
    }
    json.loads(found.get("config", "{}"))
    return found


def merge_states(parts: Sequence[States], *, distinct: bool = False) -> States:
    """Merge the rows of several state files, stably sorted by nx.

    Args:
        parts: states of the same rope with the same measures, read with images.
        distinct: refuse states that are equal bit for bit.

    Raises:
        InvalidFile: the parts can't be combined, or states are equal although `distinct` is set.
    """
    if not parts:
        raise InvalidFile("nothing to merge: give at least one state file")
    parts = [_with_drawings(part, parts) for part in parts]
    first = parts[0]
    for other in parts[1:]:
        if other.attributes.get("rope") != first.attributes.get("rope"):
            raise InvalidFile(
                f"states to merge must have one rope model, got {first.attributes.get('rope')} and"
                f" {other.attributes.get('rope')}"
            )
        if other.engine != first.engine:
            raise InvalidFile(
                f"states to merge must be of one engine, got {first.engine} and {other.engine}"
            )
        if set(other.quality) != set(first.quality) or set(other.source) != set(first.source):
            raise InvalidFile("the files have different quality or source columns")
    order = merged_order(parts)
    columns = [_with_actions_padded(part, parts).columns() for part in parts]
    shared = [name for name in columns[0] if all(name in other for other in columns)]
    configs = [config for part in parts for config in _configs(part)]
    merged = first.with_columns(
        {name: np.concatenate([own[name] for own in columns])[order] for name in shared}
    )
    config = json.dumps(configs if len(configs) > 1 else configs[0])
    twice = repeated(merged.points) if distinct else []
    if twice:
        raise InvalidFile(
            f"{len(twice)} states occur twice, first in rows {twice[0][0]} and {twice[0][1]} of the"
            " merged file; merge sets that share no state"
        )
    return replace(merged, attributes={**first.attributes, "config": config})


def merged_order(parts: Sequence[States]) -> NDArray[np.int64]:
    """Return the row of the concatenated parts that each row of `merge_states` comes from."""
    return np.argsort(np.concatenate([part.nx for part in parts]), kind="stable")


def _with_actions_padded(part: States, parts: Sequence[States]) -> States:
    """Pad a part's actions with zeros to the longest of all parts."""
    if "actions" not in part.source:
        return part
    longest = max(other.source["actions"].shape[1] for other in parts)
    actions = part.source["actions"]
    padded = np.pad(actions, ((0, 0), (0, longest - actions.shape[1]), (0, 0)))
    return replace(part, source={**part.source, "actions": padded})


def _with_drawings(part: States, parts: Sequence[States]) -> States:
    """Add an empty `source/drawing` to a part if another part has that column."""
    if "drawing" in part.source or not any("drawing" in other.source for other in parts):
        return part
    return replace(part, source={**part.source, "drawing": np.full(len(part), "", dtype=np.str_)})


def _configs(part: States) -> list[Any]:
    config = json.loads(part.attributes.get("config", "{}"))
    return config if isinstance(config, list) else [config]


def _fields_of(columns: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Convert columns by name to the fields of `States`."""
    arrays: dict[str, Any] = {column.name: columns.get(column.name) for column in ROOT}
    for group in _GROUPS:
        arrays[group] = {
            name.removeprefix(f"{group}/"): values
            for name, values in columns.items()
            if name.startswith(f"{group}/")
        }
    return arrays


def _write(file: h5py.File, name: str, values: NDArray[Any]) -> h5py.Dataset:
    if values.dtype.kind == "U":
        return file.create_dataset(
            name, data=values.astype(object), dtype=h5py.string_dtype("utf-8"), **_COMPRESSED
        )
    chunks = (1, *values.shape[1:]) if name == "image" and len(values) else None
    options = _COMPRESSED if values.size else {}
    return file.create_dataset(name, data=values, chunks=chunks, **options)
