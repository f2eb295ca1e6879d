"""Files of the staging folder with units of walks, from which a killed run is resumed."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import NamedTuple, get_args, get_origin, get_type_hints
from zipfile import BadZipFile

import numpy as np

from knotgym.common.atomic_files import atomic_write
from knotgym.common.errors import KnotgymError
from knotgym.common.hdf5_files import require_regular
from knotgym.generate.images.walks import Frames, Unit, make_walks

# dtype of each array of Frames, little-endian: NDArray is ndarray[shape, dtype[scalar type]]
_DTYPES = {
    name: np.dtype(get_args(get_args(hint)[1])[0]).str
    for name, hint in get_type_hints(Frames).items()
    if get_origin(hint) is np.ndarray
}
# errors of NumPy and zipfile for a file that isn't a complete archive
_FOREIGN = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    EOFError,
    MemoryError,
    RuntimeError,  # of zipfile; NotImplementedError is one
    BadZipFile,
    struct.error,
    zlib.error,
)


class SpoiltUnit(KnotgymError, ValueError):
    """The file doesn't contain a unit of walks, or is corrupted."""


class UnitFile(NamedTuple):
    """A unit of walks and its file."""

    path: Path
    unit: Unit


def walked(work: UnitFile) -> Path:
    """Make a unit's walks and write them to its file, unless an intact one exists."""
    try:
        load_frames(work.path)  # the file has checksums
    except (SpoiltUnit, OSError):
        frames = make_walks(work.unit)
        with atomic_write(work.path) as temporary, open(temporary, "wb") as file:
            np.savez(file, **{**vars(frames), "dropped": np.array(json.dumps(frames.dropped))})
    return work.path


def load_frames(path: Path) -> Frames:
    """Read a file of `walked`; raise SpoiltUnit if it is truncated, corrupted or of another
    kind.
    """
    require_regular(path, "walks", SpoiltUnit)
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in _DTYPES}
            dropped = json.loads(str(file["dropped"]))
        if {name: own.dtype.str for name, own in arrays.items()} != _DTYPES:
            raise SpoiltUnit("its columns are of other types")
        return Frames(**arrays, dropped={str(name): int(n) for name, n in dropped.items()})
    except _FOREIGN as error:
        raise SpoiltUnit(f"{path} holds no walks of a run: {error}") from error
