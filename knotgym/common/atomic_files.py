"""Atomic writing of files and folders, without replacing anything unless asked to.

`require_output` checks an output path before the work, and `move_into_place` gives the finished
output its name. Both look at the path itself (lstat): a symbolic link counts as existing, whatever
it points to, and it is the link that gets replaced, never its target.
"""

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

from knotgym.common.errors import InvalidFile, InvalidInput, KnotgymError, Occupied


def require_output(path: str | os.PathLike[str], *, folder: bool, overwrite: bool = False) -> None:
    """Check, before hours of work, that an output can be written and replaces nothing unasked.

    Neither a file nor a folder ever replaces the other.

    Raises:
        Occupied: something exists at `path` that may not be replaced.
        InvalidInput: the path can't be written.
    """
    _require_free(Path(path), folder, overwrite)
    require_writable(path)


def _require_free(target: Path, folder: bool, overwrite: bool) -> None:
    if not os.path.lexists(target):
        return
    if not overwrite:
        raise Occupied(f"{target} exists already; --overwrite replaces it, or choose another --out")
    if target.exists() and target.is_dir() != folder:  # follows a link
        found, wanted = ("file", "folder") if folder else ("folder", "file")
        raise Occupied(
            f"{target} is a {found}, and the output is a {wanted}, which never replaces a {found};"
            " choose another --out"
        )
    if folder and Path.cwd().is_relative_to(target.resolve()):
        raise Occupied(f"{target} contains the current folder; choose another --out")


def require_writable(path: str | os.PathLike[str]) -> None:
    """Check by a trial that leaves no trace that `path` can be written; raise InvalidInput
    otherwise.
    """
    target, folder = Path(path), None
    try:
        folder = next(parent for parent in target.absolute().parents if parent.exists())
        missing = set(target.absolute().relative_to(folder).parts) - {".."}
        with tempfile.TemporaryDirectory(prefix=".part-", dir=folder) as staged:
            for name in missing:  # fails for a name that is too long
                (Path(staged) / name).mkdir(exist_ok=True)
    except OSError as error:
        where = f", {folder}" if folder else ""
        raise InvalidInput(f"{target} can't be written: {error.strerror}{where}") from error


@contextmanager
def atomic_write(path: str | os.PathLike[str], *, overwrite: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `path`; what is written there is renamed to `path` at the end.

    Write a file there or make a folder. On an error it is removed; if the process is killed, only a
    folder named `.part-*` is left. Raises Occupied as `move_into_place` does.
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
    """Rename a finished file or folder to `target`, on the same file system.

    Without `overwrite` nothing is replaced, not even what another process has put there in the
    meantime: that raises Occupied. With it, the old output is removed only once the new one is in
    place.
    """
    is_folder = stat.S_ISDIR(part.lstat().st_mode)  # raises if nothing was written
    _require_free(target, is_folder, overwrite)
    try:
        if not is_folder:
            # fails if `target` is a folder
            (os.replace if overwrite else _rename_new)(part, target)
        elif os.path.lexists(target):
            _exchange(part, target)
        else:
            part.rename(target)  # fails if `target` is a file, a link or a folder with content
    except OSError as error:
        if error.errno not in (errno.EEXIST, errno.ENOTEMPTY, errno.EISDIR, errno.ENOTDIR):
            raise
        raise Occupied(f"{target} was made by another process in the meantime; kept it") from error


def _exchange(part: Path, target: Path) -> None:
    """Replace a folder or a link by a folder; restore the old one if that fails."""
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
    """Rename a file to a free name; unlike a rename, making a hard link never replaces anything."""
    try:
        os.link(part, target)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS):
            raise
        # a file system without hard links: reserve the name, then replace the empty file
        os.close(os.open(target, os.O_CREAT | os.O_EXCL))
        part.replace(target)
    else:
        part.unlink()


def remove(path: Path) -> None:
    """Remove a file, a folder with its contents, or a link, but never the target of a link."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def require_own(path: Path, error: type[KnotgymError] = Occupied) -> None:
    """Raise `error` if a path exists and is a link or belongs to another user.

    Somebody else may have planted it in a shared folder. The contents of a folder aren't checked;
    see `require_own_tree`.
    """
    try:
        found = os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return
    if stat.S_ISLNK(found.st_mode):
        raise error(f"{path} is a link, and is never followed here; remove it")
    if found.st_uid != os.geteuid():
        raise error(f"{path} belongs to another user; remove it")


def require_own_tree(folder: Path) -> None:
    """Apply `require_own` to a folder and everything in it."""
    require_own(folder)
    for inside, folders, files in os.walk(folder):
        for name in (*folders, *files):
            require_own(Path(inside) / name)


def require_no_links(root: Path, files: Iterable[Path]) -> None:
    """Raise InvalidFile if files of a folder are reached by links inside it.

    In a downloaded folder, such a link could make a private file of the user part of what is copied
    and published. The folder itself may be a link, because the user named it.
    """
    for file in files:
        for step in (file, *file.parents):
            if step == root:
                break
            if step.is_symlink():
                raise InvalidFile(
                    f"{step} is a link, and only a dataset's own files are copied; replace it by"
                    " the file itself"
                )


def copy_file(source: Path, target: Path) -> None:
    """Copy the bytes of a regular file; raise OSError for a link or anything else."""
    with open(os.open(source, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(source))
        with open(target, "wb") as copy:
            shutil.copyfileobj(file, copy)


def link_or_copy(source: str | os.PathLike[str], target: Path) -> None:
    """Hard-link a file, or copy it where the disk has no hard links.

    A hard link stores the bytes once. It is safe because our files are only ever replaced, never
    modified in place. Symbolic links are resolved first, because hard links don't follow them.
    """
    try:
        os.link(os.path.realpath(source), target)
    except OSError:  # another disk, or one without links
        shutil.copyfile(source, target)


@contextmanager
def new_hdf5(path: str | os.PathLike[str], **options: Any) -> Iterator[h5py.File]:
    """Yield a new HDF5 file; `options` are passed to h5py.File.

    The HDF5 library can't handle a failed write: on a full disk it can't close the file, and may
    crash. So failures are hidden from it: data that doesn't fit is dropped, and the error is raised
    here once the file is closed.

    Raises:
        OSError: something could not be written.
    """
    with open(path, "w+b", buffering=0) as target:
        sink = _Sink(target)
        try:
            with h5py.File(sink, "w", **options) as file:
                yield file
        finally:
            failure = sink.failure
            if failure is not None:
                raise OSError(failure.errno, failure.strerror, str(path)) from failure


class _Sink:
    """A file object for h5py whose writes never fail; `failure` is the first error."""

    def __init__(self, file: io.FileIO) -> None:
        self._file, self._at = file, 0
        self.failure: OSError | None = None

    def write(self, data: Any) -> int:
        view = memoryview(data)
        try:
            done = 0
            while self.failure is None and done < len(view):
                done += os.pwrite(self._file.fileno(), view[done:], self._at + done)
        except OSError as error:
            self.failure = error
        self._at += len(view)
        return len(view)

    def read(self, size: int) -> bytes:
        data = bytearray(size)
        self.readinto(data)
        return bytes(data)

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer)
        present = os.pread(self._file.fileno(), len(view), self._at)
        view[:] = present.ljust(len(view), b"\0")  # dropped data reads as zeros
        self._at += len(view)
        return len(view)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + (0, self._at, os.fstat(self._file.fileno()).st_size)[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def truncate(self, size: int) -> int:
        if self.failure is None:
            os.ftruncate(self._file.fileno(), size)
        return size

    def flush(self) -> None:
        """Do nothing: writes aren't buffered."""


def sha256(path: str | os.PathLike[str]) -> str:
    """Return the hexadecimal SHA-256 of a regular file's bytes; a pipe or device may never end."""
    if not Path(path).is_file() and Path(path).exists():
        raise OSError(f"{path} isn't a regular file")
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    """Flush a file, or all files of a folder, to disk, so that the rename can't come first."""
    for file in [path, *path.rglob("*")] if path.is_dir() else [path]:
        if file.is_file():
            with open(file, "rb+") as handle:
                os.fsync(handle.fileno())
