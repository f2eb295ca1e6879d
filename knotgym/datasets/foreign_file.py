"""Check in a subprocess that libhdf5 can read a file.

Some corrupted files make the library crash or loop forever, which no check in Python can prevent.
Reading the whole file in a subprocess first turns that into an error message.
"""

import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import h5py

from knotgym.common.errors import InvalidFile
from knotgym.common.tables import require_stored_here

_LIMIT = 60.0  # seconds
_SLOWEST = 5_000_000  # bytes per second; a file adds the time that reading it at this rate takes


def try_files(paths: Iterable[Path]) -> None:
    """Read files completely in one subprocess; skip those that aren't HDF5.

    Raises:
        InvalidFile: a file makes the library crash or hang.
    """
    tried = [path for path in paths if path.is_file() and _is_hdf5(path)]
    if not tried:
        return
    limit = _LIMIT + sum(path.stat().st_size for path in tried) / _SLOWEST
    # -P: import nothing from the current folder, which may have been downloaded
    words = [sys.executable, "-P", "-m", __name__, *(str(path.absolute()) for path in tried)]
    try:
        ended = subprocess.run(
            words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=limit, check=False
        )
    except subprocess.TimeoutExpired as late:
        raise InvalidFile(
            f"{_at(tried, late.stdout)} makes the HDF5 library hang: not read in {limit:.0f} s;"
            " don't open it"
        ) from None
    if ended.returncode < 0:
        raise InvalidFile(
            f"{_at(tried, ended.stdout)} makes the HDF5 library crash (signal"
            f" {-ended.returncode}); don't open it"
        )


def _at(tried: Sequence[Path], output: bytes | None) -> Path:
    """Return the file that was being read: the subprocess prints a line when it opens one."""
    return tried[max(0, (output or b"").count(b"\n") - 1)]


def _is_hdf5(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(8) == b"\x89HDF\r\n\x1a\n"


def _read_whole(path: str) -> None:
    """Read everything stored in a file but its links; ignore errors that Python can catch."""

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
        except Exception:  # the file's reader reports these; only a crash matters here
            return

    with h5py.File(path, "r", locking=False) as file:
        dict(file.attrs)
        file.visititems(look)


if __name__ == "__main__":
    for one in sys.argv[1:]:
        print("begun", flush=True)
        try:
            _read_whole(one)
        except Exception:  # as above
            continue
