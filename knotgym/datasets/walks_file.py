"""`walks.h5`: the walks that the configurations in a table of pictures come from.

It holds the start states of the walks and the steps of every walk that a row uses, so that each
configuration can be reproduced without the archive.

    /       attributes: format, format_version, rope, engine
    state   float64 (s, nstate)     the engine's states that walks start from
    number  int64 (w,)              number of the walk, as rows refer to it
    start   int64 (w,)              row of `state` that the walk starts from
    beads   int16 (w, T)            bead pulled in each step
    forces  float32 (w, T, 3)       its force / the largest force; shorter walks end with zeros
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write, new_hdf5
from knotgym.common.errors import InvalidFile
from knotgym.common.hdf5_files import Column, opened_hdf5, read_attribute, read_column
from knotgym.rope.engines import ENGINES, MUJOCO, simulation_of
from knotgym.rope.model import Array, RopeConfig

FORMAT = "knotgym-walks"
FORMAT_VERSION = 1

_COLUMNS = (
    Column("state", "float64", ("states", None), finite=True),
    Column("number", "int64", ("walks",)),
    Column("start", "int64", ("walks",), least=0),
    Column("beads", "int16", ("walks", "steps"), least=0),
    Column("forces", "float32", ("walks", "steps", 3), finite=True),
)
_COMPRESSED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}


class MadeWalks(Protocol):
    """Walks with their columns in the file; `start` may index other states than the file's."""

    @property
    def number(self) -> NDArray[np.int64]: ...
    @property
    def start(self) -> NDArray[np.int64]: ...
    @property
    def beads(self) -> NDArray[np.int16]: ...
    @property
    def forces(self) -> NDArray[np.float32]: ...


@dataclass(frozen=True, eq=False)
class Walks:
    """The columns of the file; the module's docstring has shapes and units."""

    state: Array
    number: NDArray[np.int64]
    start: NDArray[np.int64]
    beads: NDArray[np.int16]
    forces: NDArray[np.float32]
    engine: str = MUJOCO


def walks_of(
    states: Array, made: Sequence[MadeWalks], used: set[int], engine: str = MUJOCO
) -> Walks:
    """Select the walks that are used, and the states that they start from.

    `states`, float64 (n, nstate), are those that `start` indexes; `used` numbers the walks to keep,
    at least one.
    """
    kept = [(piece, np.flatnonzero(np.isin(piece.number, [*used]))) for piece in made]
    kept = [(piece, rows) for piece, rows in kept if len(rows)]
    # states shared by several walks are stored once
    shared, start = np.unique(
        np.concatenate([piece.start[rows] for piece, rows in kept]), return_inverse=True
    )
    return Walks(
        state=states[shared],
        number=np.concatenate([piece.number[rows] for piece, rows in kept]),
        start=start.astype(np.int64),
        beads=_padded([piece.beads[rows] for piece, rows in kept]),
        forces=_padded([piece.forces[rows] for piece, rows in kept]),
        engine=engine,
    )


def joined_walks(pieces: Sequence[Walks]) -> Walks:
    """Concatenate the walks of several files of one engine; their numbers must differ."""
    firsts = np.cumsum([0, *(len(piece.state) for piece in pieces[:-1])])
    starts = [piece.start + first for piece, first in zip(pieces, firsts, strict=True)]
    return Walks(
        state=np.concatenate([piece.state for piece in pieces]),
        number=np.concatenate([piece.number for piece in pieces]),
        start=np.concatenate(starts),
        beads=_padded([piece.beads for piece in pieces]),
        forces=_padded([piece.forces for piece in pieces]),
        engine=pieces[0].engine,
    )


def write_walks(path: str | os.PathLike[str], walks: Walks) -> None:
    """Write the file atomically."""
    with atomic_write(path) as temporary, new_hdf5(temporary) as file:
        file.attrs["format"], file.attrs["format_version"] = FORMAT, FORMAT_VERSION
        file.attrs["rope"], file.attrs["engine"] = RopeConfig().fingerprint, walks.engine
        for column in _COLUMNS:
            options = {} if column.name in ("number", "start") else _COMPRESSED
            file.create_dataset(column.name, data=getattr(walks, column.name), **options)


def read_walks(path: str | os.PathLike[str]) -> Walks:
    """Read the file; raise InvalidFile if it is foreign, truncated or of another rope model."""
    with opened_hdf5(
        path, what="file of walks", format=FORMAT, versions=(FORMAT_VERSION,), error=InvalidFile
    ) as file:
        rope = read_attribute(file, Column("rope", "text", ()))
        if rope != RopeConfig().fingerprint:
            raise InvalidFile(
                f"{path} was generated with rope model {rope}, this version has"
                f" {RopeConfig().fingerprint}"
            )
        sizes: dict[str, int] = {}
        engine = str(read_attribute(file, Column("engine", "text", ())))
        if engine not in ENGINES:
            raise InvalidFile(f"{path}: no engine {engine!r}; there is {', '.join(ENGINES)}")
        columns = {column.name: read_column(file, column, sizes) for column in _COLUMNS}
        walks = Walks(**columns, engine=engine)
        if len(walks.start) and walks.start.max() >= len(walks.state):
            raise InvalidFile(
                f"{path}: a walk starts from state {walks.start.max()} of {len(walks.state)}"
            )
        return walks


def retrace(
    states: Array, beads: NDArray[np.int16], forces: NDArray[np.float32], engine: str = MUJOCO
) -> Array:
    """Replay walks; return the configuration before the first and after every step.

    `states` is float64 (w, nstate), the states that they start from; the result is float64
    (w, T + 1, beads, 3), metres.
    """
    simulation = simulation_of(len(states), RopeConfig(), engine)
    simulation.restore(states)
    largest = simulation.rope.config.max_force
    frames = [simulation.points.copy()]
    for step in range(beads.shape[1]):
        # the same arithmetic as when the walk was made, or the last bits would differ
        newtons = largest * forces[:, step].astype(np.float64)
        simulation.act(simulation.actions(beads[:, step], newtons))
        frames.append(simulation.points.copy())
    return np.stack(frames, axis=1)


def _padded(walks: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Concatenate walks (w, T, ...), padded to the longest T by steps of bead 0 without force.

    No row refers to the added steps.
    """
    longest = max(steps.shape[1] for steps in walks)
    whole = [(0, 0)] * (walks[0].ndim - 2)
    return np.concatenate(
        [np.pad(steps, [(0, 0), (0, longest - steps.shape[1]), *whole]) for steps in walks]
    )
