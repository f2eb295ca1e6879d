"""Staging folders: one process at a time works in a hidden folder beside its output.

The folder, its lock and everything in it must belong to this user, and none of them may be a link.
Otherwise anyone who can write beside the output could make a run empty or fill another folder.
"""

import fcntl
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from knotgym.common.atomic_files import remove, require_own, require_own_tree
from knotgym.common.errors import Occupied
from knotgym.runs.run_options import Existing


def staging_folder(out: Path) -> Path:
    """Return the folder `.NAME.partial` beside `out`, which holds a run until it is finished."""
    return out.parent / f".{out.name}.partial"


@contextmanager
def staging(out: Path, existing: Existing) -> Iterator[Path]:
    """Lock the staging folder of `out` during the block; the caller removes it afterwards.

    Raises Occupied if another process holds it, or it has the work of an interrupted run and
    `existing` says neither resume nor restart.
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
    """Raise Occupied if an interrupted run left work, unless `existing` says what to do with it."""
    if os.path.lexists(staging_folder(out)):
        with lock_folder(staging_folder(out)):
            _require_no_work(out, existing)


def _require_no_work(out: Path, existing: Existing) -> None:
    if has_work(staging_folder(out)) and not (existing.resume or existing.restart):
        raise Occupied(
            f"an interrupted run of {out} left its work: --resume continues it, --restart deletes"
            " it"
        )


def may_be_finished(out: Path, existing: Existing) -> bool:
    """Whether `out` may be the finished output of the run to resume, not one it should replace."""
    begun_to_overwrite = existing.overwrite and has_work(staging_folder(out))
    return existing.resume and not begun_to_overwrite


def has_work(partial: Path) -> bool:
    """Whether a staging folder has work to resume, more than a lock and partial files."""
    return partial.is_dir() and any(
        path.name != "lock" and not path.name.startswith(".part-") for path in partial.iterdir()
    )


def discard(out: Path) -> None:
    """Remove the staging folder of `out`, if there is one that no other process holds."""
    if os.path.lexists(staging_folder(out)):
        with lock_folder(staging_folder(out)):
            shutil.rmtree(staging_folder(out))


@contextmanager
def lock_folder(partial: Path) -> Iterator[None]:
    """Lock a folder during the block, and create it if needed.

    The system releases the lock when the process ends, so locks can't become stale.

    Raises:
        Occupied: another process holds it, the file system has no locks, or the folder or anything
            in it is a link or belongs to another user.
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
                f"{partial.name[1:-8]} can't be locked, because its file system has no locks"
                f" ({error.strerror}): choose an --out on another"
            ) from error
        if not is_held(partial, os.fstat(lock.fileno())):
            # that run has removed the folder
            raise Occupied(f"another run has just finished {partial.name[1:-8]}")
        require_own_tree(partial)
        yield


def is_held(partial: Path, lock: os.stat_result) -> bool:
    """Whether the folder still has the lock file that was locked; False after it was removed."""
    try:
        return os.path.samestat(os.stat(partial / "lock"), lock)
    except OSError:
        return False


def _opened(path: Path) -> IO[bytes]:
    """Open a lock file, created if needed, without following a link or blocking on anything
    else.
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
