"""Runs that can be killed and resumed: one process at a time works in a hidden folder beside what
it makes.
"""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
    with open(partial / "lock", "w") as lock:
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
        if not (partial / "lock").is_file() or not os.path.samestat(
            os.stat(partial / "lock"), os.fstat(lock.fileno())
        ):
            # and taken the folder away
            raise Occupied(f"another run has just finished {partial.name[1:-8]}")
        yield
