"""Whether the HDF5 library lives through a file, tried in a process of its own.

Some damage makes the library itself crash, or read for ever; no check in Python sees that coming.
So the whole file is read once where that costs nothing but a line of error.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import h5py

from knotgym.errors import KnotgymError
from knotgym.hdf5_files import require_stored_here

LIMIT = 60.0  # seconds, and one more for each SLOWEST bytes
SLOWEST = 5_000_000


class HarmfulFile(KnotgymError, OSError):
    """A file that the HDF5 library doesn't live through."""


def try_files(paths: Iterable[Path], limit: float = LIMIT) -> None:
    """Read files as a whole, in one process of its own; those that aren't HDF5 are left alone.

    Args:
        paths: of any files.
        limit: seconds, to which come some for their size.

    Raises:
        HarmfulFile: one makes the library crash or hang.
    """
    tried = [path for path in paths if path.is_file() and _is_hdf5(path)]
    if not tried:
        return
    limit += sum(path.stat().st_size for path in tried) / SLOWEST
    # -P: nothing is imported from the current folder, which may be one that was downloaded
    words = [sys.executable, "-P", "-m", __name__, *(str(path.absolute()) for path in tried)]
    try:
        ended = subprocess.run(
            words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=limit, check=False
        )
    except subprocess.TimeoutExpired as late:
        raise HarmfulFile(
            f"{_at(tried, late.stdout)} makes the HDF5 library hang: not read in {limit:.0f} s;"
            " don't open it"
        ) from None
    if ended.returncode < 0:
        raise HarmfulFile(
            f"{_at(tried, ended.stdout)} makes the HDF5 library crash (signal"
            f" {-ended.returncode}); don't open it"
        )


def _at(tried: Sequence[Path], said: bytes | None) -> Path:
    """The file that was being read: a line is said of each that was begun."""
    return tried[max(0, (said or b"").count(b"\n") - 1)]


def _is_hdf5(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(8) == b"\x89HDF\r\n\x1a\n"


def read_whole(path: str) -> None:
    """Read all that is stored in a file, links aside; what can't be read is left to its reader."""

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        try:
            dict(item.attrs)
            if isinstance(item, h5py.Dataset):
                require_stored_here(item, name)
                if item.chunks is None:
                    item[()]
                else:
                    for part in item.iter_chunks():
                        item[part]
        except Exception:  # a reader says what is wrong; here only a crash counts
            return

    with h5py.File(path, "r") as file:
        dict(file.attrs)
        file.visititems(look)


if __name__ == "__main__":
    for one in sys.argv[1:]:
        print("begun", flush=True)
        try:
            read_whole(one)
        except Exception:  # as above
            continue
