"""Runs that can be killed and resumed: one process at a time works in a hidden folder beside what
it makes.

The folder, its lock and all in it must belong to this user, and none of them may be a link: whoever
may write beside the output could otherwise have another folder emptied or written to.
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

from knotgym.atomic_files import Occupied, remove, require_own, require_own_tree
from knotgym.runs.run_options import Existing


def staging_folder(out: Path) -> Path:
    """The folder `.NAME.partial` beside `out`, in which everything stands until `out` is
    finished.
    """
    return out.parent / f".{out.name}.partial"


@contextmanager
def staging(out: Path, existing: Existing) -> Iterator[Path]:
    """Hold the staging folder of `out`; it stays until the caller removes it.

    Raises:
        Occupied: another process holds it, or an interrupted run left work there that is neither
            to be resumed nor to be thrown away.
    """
    partial = staging_folder(out)
    with lock_folder(partial):
        _require_no_work(out, existing)
        if not existing.resume:
            for path in partial.iterdir():
                if path.name != "lock":
                    remove(path)
        yield partial


def require_no_interrupted_run(out: Path, existing: Existing) -> None:
    """Refuse to begin where an interrupted run left work, unless it was said what becomes of it.

    Raises:
        Occupied: there is such work, or another process is at it now.
    """
    if os.path.lexists(staging_folder(out)):
        with lock_folder(staging_folder(out)):
            _require_no_work(out, existing)


def _require_no_work(out: Path, existing: Existing) -> None:
    if has_work(staging_folder(out)) and not (existing.resume or existing.restart):
        raise Occupied(
            f"an interrupted run of {out} left its work: --resume goes on from it, --restart throws"
            " it away"
        )


def may_be_finished(out: Path, existing: Existing) -> bool:
    """Whether a resumed run may find its own result at `out`: not if it was begun to replace it."""
    begun_to_overwrite = existing.overwrite and has_work(staging_folder(out))
    return existing.resume and not begun_to_overwrite


def has_work(partial: Path) -> bool:
    """Whether an interrupted run left anything to go on from: one that was killed at once left no
    more than its lock, and parts of files.
    """
    return partial.is_dir() and any(
        path.name != "lock" and not path.name.startswith(".part-") for path in partial.iterdir()
    )


def discard(out: Path) -> None:
    """Remove the staging folder of `out`, if there is one and no run is at it.

    Raises:
        Occupied: another process holds it.
    """
    if os.path.lexists(staging_folder(out)):
        with lock_folder(staging_folder(out)):
            shutil.rmtree(staging_folder(out))


@contextmanager
def lock_folder(partial: Path) -> Iterator[None]:
    """Hold a folder, as it is; the lock goes with the process, however it ends, so that none is
    ever stale.

    Raises:
        Occupied: another process holds it, its disk knows no locks, or it, or anything in it, is a
            link or another user's.
    """
    require_own(partial)
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
        require_own_tree(partial)
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
