"""Opening HDF5 files of ours: one check of format and version, and one line of error.

Every file we write names its `format` and `format_version` in its attributes. A reader says which
versions it knows; a foreign, torn or newer file is refused with the reader's own error.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import h5py

from knotgym.errors import KnotgymError, MissingFile, one_line

# whatever h5py, and what reads its arrays, says to foreign bytes
_FOREIGN = (OSError, KeyError, IndexError, RuntimeError, TypeError, ValueError, AttributeError)


@contextmanager
def opened_hdf5(
    path: str | os.PathLike[str],
    *,
    what: str,
    format: str,
    versions: Sequence[int],
    error: type[KnotgymError],
) -> Iterator[h5py.File]:
    """Open a file for reading, checked; what goes wrong while it is read is the caller's error too.

    Args:
        path: of the file.
        what: it should be, as "state file".
        format, versions: that can be read.
        error: raised for a file that isn't whole, or of another format or version.

    Raises:
        MissingFile: there is none.
    """
    if not Path(path).is_file():
        raise MissingFile(f"no {what} at {path}")
    with foreign_bytes_as(error, f"{path} isn't a whole {what}"), h5py.File(path, "r") as file:
        check_format(file, format=format, versions=versions, error=error)
        yield file


@contextmanager
def foreign_bytes_as(error: type[KnotgymError], complaint: str) -> Iterator[None]:
    """Turn what reading foreign or torn bytes raises into `error`, one line after `complaint`."""
    try:
        yield
    except error:
        raise
    except _FOREIGN as trouble:
        raise error(f"{complaint}: {one_line(trouble)}") from trouble


def check_format(
    file: h5py.File, *, format: str, versions: Sequence[int], error: type[KnotgymError]
) -> int:
    """The version of an open file; raises `error` unless it is one of `versions` of the format."""
    name, version = file.attrs.get("format", "none"), file.attrs.get("format_version", "none")
    if name != format or version not in versions:
        raise error(
            f"{file.filename} has format {name!r} version {version}; this version reads {format!r}"
            f" version {' or '.join(map(str, versions))}"
        )
    return int(version)


def hdf5_format(path: str | os.PathLike[str]) -> str | None:
    """The format an HDF5 file says it has; None if it says nothing or isn't one."""
    try:
        with h5py.File(path, "r") as file:
            return None if "format" not in file.attrs else str(file.attrs["format"])
    except OSError:
        return None
