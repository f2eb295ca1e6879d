"""Runs that can be killed and resumed: one process at a time works in a hidden folder beside what
it makes.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from knotgym.errors import KnotgymError


class Occupied(KnotgymError, ValueError):
    """The folder cannot be written to now."""


def staging_folder(out: Path) -> Path:
    """The folder `.NAME.partial` beside `out`, in which everything stands until `out` is
    finished.
    """
    return out.parent / f".{out.name}.partial"


@contextmanager
def staging(out: Path, resume: bool) -> Iterator[Path]:
    """Hold the partial folder of `out`, emptied unless an earlier run's work is to be resumed.

    The folder stays until the caller removes it.

    Raises:
        Occupied: another process holds it.
    """
    partial = staging_folder(out)
    with lock_folder(partial):
        for path in [] if resume else partial.iterdir():
            if path.name != "lock":
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        yield partial


@contextmanager
def lock_folder(partial: Path) -> Iterator[None]:
    """Hold a folder, as it is; the lock goes with the process, however it ends, so that none is
    ever stale.

    Raises:
        Occupied: another process holds it, or its disk knows no locks.
    """
    new = not partial.exists()
    partial.mkdir(parents=True, exist_ok=True)
    with _opened(partial / "lock") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise Occupied(f"another run is writing {partial.name[1:-8]} now") from error
        except OSError as error:
            if new:
                shutil.rmtree(partial)
            raise Occupied(
                f"{partial.name[1:-8]} can't be kept from other runs, for its disk has no locks"
                f" ({error.strerror}): choose an --out on another"
            ) from error
        if not is_held(partial, os.fstat(lock.fileno())):
            # and taken the folder away
            raise Occupied(f"another run has just finished {partial.name[1:-8]}")
        yield


def is_held(partial: Path, lock: os.stat_result) -> bool:
    """Whether the folder's lock is still the one that was taken: not so once it was removed."""
    try:
        return os.path.samestat(os.stat(partial / "lock"), lock)
    except OSError:
        return False


def _opened(path: Path) -> IO[bytes]:
    """A file to lock, made if it isn't there; what others may have put in its place isn't touched.

    Raises:
        Occupied: it is a link or no file.
    """
    wanted = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        lock = os.open(path, wanted, 0o666)
    except OSError as error:
        if path.is_symlink() or path.is_dir():
            raise Occupied(f"{path} should be a file; remove it") from error
        raise
    if not stat.S_ISREG(os.fstat(lock).st_mode):
        os.close(lock)
        raise Occupied(f"{path} should be a file; remove it")
    return open(lock, "rb")
