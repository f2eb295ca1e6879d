"""Files that appear whole or not at all."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`; what is written there takes its name at the end, or vanishes with an error.

    Works for a file and for a folder (make it at the yielded path). A kill in between leaves only a `.part-` name. An
    existing target is replaced; a folder is replaced by renaming, the old one aside first.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    room = Path(tempfile.mkdtemp(prefix=f".part-{target.name}-", dir=target.parent))
    part = room / target.name
    try:
        yield part
        _sync(part)
        if target.is_dir() and part.exists():
            target.rename(room / "replaced")
        part.replace(target)
    finally:
        shutil.rmtree(room, ignore_errors=True)


def sha256(path: str | os.PathLike[str]) -> str:
    """Hexadecimal SHA-256 of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    """Make sure that the bytes are on the disk before the name points at them."""
    for file in [path, *path.rglob("*")] if path.is_dir() else [path]:
        if file.is_file():
            with open(file, "rb+") as handle:
                os.fsync(handle.fileno())
