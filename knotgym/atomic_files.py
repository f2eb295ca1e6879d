"""Files that appear whole or not at all."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py

from knotgym.errors import KnotgymError


class Unwritable(KnotgymError, OSError):
    """Nothing can be written at a path."""


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
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`; what is written there takes its name at the end.

    With an error it vanishes.

    Works for a file and for a folder (make it at the yielded path). A kill in between leaves only a
    `.part-` name. An existing target is replaced; a folder is replaced by renaming, the old one
    aside first.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    staged = Path(tempfile.mkdtemp(prefix=f".part-{target.name[:32]}-", dir=target.parent))
    part = staged / target.name
    try:
        yield part
        _sync(part)
        if target.is_dir() and part.exists():
            target.rename(staged / "replaced")
        part.replace(target)
    finally:
        shutil.rmtree(staged, ignore_errors=True)


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
