"""Files and folders that appear whole or not at all, and that replace nothing unasked.

An output is checked by `require_output` before the work and moved to its name by `move_into_place`
after it. Both look at the name itself (lstat): a link is something that exists, whatever it points
to, and it is the link that is replaced, never its target.
"""

from __future__ import annotations

import errno
import hashlib
import io
import os
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

from knotgym.errors import KnotgymError


class Unwritable(KnotgymError, OSError):
    """Nothing can be written at a path."""


class Occupied(KnotgymError, ValueError):
    """Something is in the way of what a command would write."""


def require_output(path: str | os.PathLike[str], *, folder: bool, overwrite: bool = False) -> None:
    """Refuse, before hours of work, an output that can't be written or would replace something.

    Args:
        path: of the output.
        folder: whether it will be a folder, else a file. Neither ever replaces the other.
        overwrite: whether the user asked to replace what exists there.

    Raises:
        Occupied: something exists at `path`, and `overwrite` wasn't asked for or is of no use.
        Unwritable: nothing can be written there.
    """
    _require_free(Path(path), folder, overwrite)
    require_writable(path)


def _require_free(target: Path, folder: bool, overwrite: bool) -> None:
    if not os.path.lexists(target):
        return
    if not overwrite:
        raise Occupied(f"{target} exists already; --overwrite replaces it, or choose another --out")
    if target.exists() and target.is_dir() != folder:  # a link stands for what it points to
        there, asked = ("file", "folder") if folder else ("folder", "file")
        raise Occupied(
            f"{target} is a {there}, and a {asked} is to be written, which never replaces a"
            f" {there}; choose another --out"
        )
    if folder and Path.cwd().is_relative_to(target.resolve()):
        raise Occupied(f"{target} holds the current folder; choose another --out")


def require_writable(path: str | os.PathLike[str]) -> None:
    """Try, before hours of work, whether `path` could be written at the end; leaves no trace.

    Raises:
        Unwritable: it couldn't.
    """
    target, folder = Path(path), None
    try:
        folder = next(parent for parent in target.absolute().parents if parent.exists())
        missing = set(target.absolute().relative_to(folder).parts) - {".."}
        with tempfile.TemporaryDirectory(prefix=".part-", dir=folder) as staged:
            for name in missing:  # one that is too long shows here
                (Path(staged) / name).mkdir(exist_ok=True)
    except OSError as error:
        where = f", {folder}" if folder else ""
        raise Unwritable(f"{target} can't be written: {error.strerror}{where}") from error


@contextmanager
def atomic_write(path: str | os.PathLike[str], *, overwrite: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `path`; what is written there takes its name at the end.

    With an error it vanishes. Works for a file and for a folder (make it at the yielded path). A
    kill in between leaves only a `.part-` name.

    Raises:
        Occupied: as `move_into_place`.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    staged = Path(tempfile.mkdtemp(prefix=f".part-{target.name[:32]}-", dir=target.parent))
    part = staged / target.name
    try:
        yield part
        _sync(part)
        move_into_place(part, target, overwrite=overwrite)
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def move_into_place(part: Path, target: Path, *, overwrite: bool) -> None:
    """Give a finished file or folder its name, on the same disk.

    Without `overwrite` nothing is replaced, not even what another process puts there in the
    meantime. With it, what was there goes only once the new one has its name.

    Raises:
        Occupied: something exists at `target` that isn't to be replaced by this.
    """
    is_folder = stat.S_ISDIR(part.lstat().st_mode)  # raises where nothing was written
    _require_free(target, is_folder, overwrite)
    try:
        if not is_folder:
            # renaming a file fails where a folder is
            (os.replace if overwrite else _rename_new)(part, target)
        elif os.path.lexists(target):
            _exchange(part, target)
        else:
            part.rename(target)  # fails where a file, a link or a folder with something in it is
    except OSError as error:
        if error.errno not in (errno.EEXIST, errno.ENOTEMPTY, errno.EISDIR, errno.ENOTDIR):
            raise
        raise Occupied(f"{target} was made by another process meanwhile, and stays") from error


def _exchange(part: Path, target: Path) -> None:
    """Put a folder where another one, or a link, is; the old one stays if that fails."""
    aside = Path(tempfile.mkdtemp(prefix=f".part-{target.name[:32]}-", dir=target.parent))
    old = target.rename(aside / "replaced")
    try:
        part.rename(target)
    except OSError:
        old.rename(target)
        aside.rmdir()
        raise
    shutil.rmtree(aside, ignore_errors=True)


def _rename_new(part: Path, target: Path) -> None:
    """Rename a file to a name that is free: unlike rename, a hard link never replaces anything."""
    try:
        os.link(part, target)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS):
            raise
        os.close(os.open(target, os.O_CREAT | os.O_EXCL))  # a disk without hard links
        part.replace(target)
    else:
        part.unlink()


def remove(path: Path) -> None:
    """Remove a file, a folder with all in it, or a link; never what a link points to."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def require_own(path: Path, error: type[KnotgymError] = Occupied) -> None:
    """Refuse a file or folder of ours that another may have planted: a link, or another user's.

    What doesn't exist is all right. A folder's contents aren't looked at, see `require_own_tree`.
    """
    try:
        found = os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return
    if stat.S_ISLNK(found.st_mode):
        raise error(f"{path} is a link, and is never followed; remove it")
    if found.st_uid != os.geteuid():
        raise error(f"{path} belongs to another user; remove it")


def require_own_tree(folder: Path) -> None:
    """As `require_own`, of a folder and all in it."""
    require_own(folder)
    for inside, folders, files in os.walk(folder):
        for name in (*folders, *files):
            require_own(Path(inside) / name)


class LinkedFile(KnotgymError, ValueError):
    """A link where a dataset's own file should be."""


def require_no_links(root: Path, files: Iterable[Path]) -> None:
    """Refuse files of a folder that are reached by links in it.

    In a folder from elsewhere such a link could have a private file of the user's copied to where
    it is published. The folder itself may be a link: the user named it.

    Raises:
        LinkedFile: a file, or a folder between it and `root`, is a link.
    """
    for file in files:
        for step in (file, *file.parents):
            if step == root:
                break
            if step.is_symlink():
                raise LinkedFile(
                    f"{step} is a link, and only a dataset's own files are copied; put the file"
                    " itself there"
                )


def copy_file(source: Path, target: Path) -> None:
    """Copy a regular file's bytes; never what a link points to.

    Raises:
        OSError: `source` is a link or no regular file.
    """
    with open(os.open(source, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "no regular file", str(source))
        with open(target, "wb") as copy:
            shutil.copyfileobj(file, copy)


@contextmanager
def new_hdf5(path: str | os.PathLike[str], **options: Any) -> Iterator[h5py.File]:
    """Yield a new HDF5 file; `options` as of h5py.File.

    HDF5 can't fail to write: on a full disk it neither closes the file nor stays in one piece. So
    it never hears of that; what there is no room for goes nowhere, and the trouble is raised here
    once the file is closed.
    """
    with open(path, "w+b", buffering=0) as target:
        sink = _Sink(target)
        try:
            with h5py.File(sink, "w", **options) as file:
                yield file
        finally:
            trouble = sink.trouble
            if trouble is not None:
                raise OSError(trouble.errno, trouble.strerror, str(path)) from trouble


class _Sink:
    """A file as h5py wants it, whose writing never fails; the first trouble is kept."""

    def __init__(self, file: io.FileIO) -> None:
        self._file, self._at = file, 0
        self.trouble: OSError | None = None

    def write(self, data: Any) -> int:
        view = memoryview(data)
        try:
            done = 0
            while self.trouble is None and done < len(view):
                done += os.pwrite(self._file.fileno(), view[done:], self._at + done)
        except OSError as error:
            self.trouble = error
        self._at += len(view)
        return len(view)

    def read(self, size: int) -> bytes:
        data = bytearray(size)
        self.readinto(data)
        return bytes(data)

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer)
        present = os.pread(self._file.fileno(), len(view), self._at)
        view[:] = present.ljust(len(view), b"\0")  # what went nowhere reads as nothing
        self._at += len(view)
        return len(view)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + (0, self._at, os.fstat(self._file.fileno()).st_size)[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def truncate(self, size: int) -> int:
        if self.trouble is None:
            os.ftruncate(self._file.fileno(), size)
        return size

    def flush(self) -> None:
        """Nothing is held back."""


def sha256(path: str | os.PathLike[str]) -> str:
    """Hexadecimal SHA-256 of a file's bytes.

    Raises:
        OSError: there is none, or it is no regular file: a pipe or a device may never end.
    """
    if not Path(path).is_file() and Path(path).exists():
        raise OSError(f"{path} is no regular file")
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    """Make sure that the bytes are on the disk before the name points at them."""
    for file in [path, *path.rglob("*")] if path.is_dir() else [path]:
        if file.is_file():
            with open(file, "rb+") as handle:
                os.fsync(handle.fileno())
