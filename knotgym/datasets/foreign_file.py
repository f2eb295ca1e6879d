"""Check in another process that libhdf5 can read a file.

Some corrupted files make the library crash or loop forever, which no check in Python can prevent.
Reading the whole file elsewhere first turns that into an error message.
"""

from collections.abc import Iterable
from concurrent.futures import BrokenExecutor, Executor
from pathlib import Path

import h5py

from knotgym.common import InvalidFile, require_stored_here

_LIMIT = 60.0  # seconds
_SLOWEST = 5_000_000  # bytes per second; a file adds the time that reading it at this rate takes


def try_files(paths: Iterable[Path], pool: Executor) -> None:
    """Read files completely in a process of a pool; skip those that aren't HDF5.

    Raises:
        InvalidFile: a file makes the library crash or hang.
    """
    for path in paths:
        if not path.is_file() or not _is_hdf5(path):
            continue
        limit = _LIMIT + path.stat().st_size / _SLOWEST
        try:
            pool.submit(_read_whole, path).result(limit)
        except BrokenExecutor as error:
            raise InvalidFile(f"{path} makes the HDF5 library crash; don't open it") from error
        except TimeoutError:
            raise InvalidFile(
                f"{path} makes the HDF5 library hang: not read in {limit:.0f} s; don't open it"
            ) from None


def _is_hdf5(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(8) == b"\x89HDF\r\n\x1a\n"


def _read_whole(path: Path) -> None:
    """Read everything stored in a file but its links; ignore errors that Python can catch."""

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        try:
            dict(item.attrs)
            if isinstance(item, h5py.Dataset):
                require_stored_here(item, name)
                for part in item.iter_chunks() if item.chunks else ((),):
                    item[part]
        except Exception:  # the file's reader reports these; only a crash matters here
            return

    try:
        with h5py.File(path, "r", locking=False) as file:
            dict(file.attrs)
            file.visititems(look)
    except Exception:  # as above
        return
