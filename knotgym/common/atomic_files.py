"""Atomic writing of files and folders, without replacing anything unless asked to.

`require_output` checks an output path before the work, and `move_into_place` gives the finished
output its name. Both look at the path itself (lstat): a symbolic link counts as existing, whatever
it points to, and it is the link that gets replaced, never its target.
"""

import errno
import glob
import hashlib
import json
import os
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from itertools import permutations
from pathlib import Path
from typing import Any

from knotgym.common.configurations import read_json
from knotgym.common.errors import InvalidFile, InvalidInput, KnotgymError, MissingFile, Occupied

_MANIFEST = "manifest.json"  # lists the files of a folder, by which an output of ours is known
# what a rename meets where another process was faster
_TAKEN = errno.EEXIST, errno.ENOTEMPTY, errno.EISDIR, errno.ENOTDIR, errno.ENOENT


def require_output(
    path: str | os.PathLike[str],
    *,
    folder: bool,
    overwrite: bool = False,
    reads: Iterable[str | os.PathLike[str]],
) -> None:
    """Check, before hours of work, that an output can be written and replaces nothing unasked.

    Only a regular file, a link, an empty folder or a folder all of whose files its manifest lists
    is ever replaced, and neither a file nor a folder replaces the other.

    Args:
        path: path of the output.
        folder: whether it will be a folder.
        overwrite: whether it may replace an older output.
        reads: files and folders that it is made from; it may not be, contain or lie in one.

    Raises:
        Occupied: something exists at `path` that may not be replaced, or is read.
        InvalidInput: the path can't be written.
    """
    target = Path(path)
    for source in reads:
        # a link at the end of the path is replaced itself, so it is where it lies
        made_from, wanted = Path(source).resolve(), target.parent.resolve() / target.name
        if wanted.is_relative_to(made_from) or made_from.is_relative_to(wanted):
            raise Occupied(f"{path} is, contains or is in its source {source}; choose another")
    _put_back(target)
    _require_free(target, folder, overwrite)
    _require_writable(target)


def require_apart(*outputs: Path | None) -> None:
    """Raise Occupied if two of a command's outputs are one, or one lies in another."""
    wanted = [(path, path.parent.resolve() / path.name) for path in outputs if path is not None]
    for (one, place), (other, other_place) in permutations(wanted, 2):
        if place.is_relative_to(other_place):
            raise Occupied(f"{one} and {other} are two outputs of one command; name them apart")


def _require_free(target: Path, folder: bool, overwrite: bool) -> None:
    if not os.path.lexists(target):
        return
    if not overwrite:
        raise Occupied(f"{target} exists already; --overwrite replaces it, or choose another --out")
    if not target.exists():  # a broken link
        return
    why = ""
    if target.is_dir() != folder:
        there, wanted = ("file", "folder") if folder else ("folder", "file")
        why = f"is a {there}, and a {wanted} never replaces a {there}"
    elif not folder and not target.is_file():
        why = "is a device or a pipe, which is never replaced"
    elif folder and Path.cwd().is_relative_to(target.resolve()):
        why = "contains the current folder"
    elif folder and (foreign := _foreign(target)):
        why = f"isn't replaced, because no manifest.json in it lists {foreign}"
    if why:
        raise Occupied(f"{target} {why}; choose another --out")


def _foreign(folder: Path) -> str:
    """Return the name of an entry of a folder that its manifest doesn't list, or ""."""
    try:
        names = [_MANIFEST, *read_json(folder / _MANIFEST)["files"]]
    except (OSError, ValueError, KeyError, TypeError):
        names = []
    listed = {folder / name for name in names}
    for path in sorted(folder.rglob("*")):
        holds = path.is_dir() and not path.is_symlink() and any(path.iterdir())
        if path not in listed and not holds:
            return path.relative_to(folder).parts[0]
    return ""


def list_files(folder: Path, facts: Mapping[str, Any] | None = None) -> None:
    """Write a folder's manifest: facts, and the SHA-256 of every other file in it."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    names = {path.relative_to(folder).as_posix(): path for path in paths}
    listed = {name: sha256(path) for name, path in names.items() if name != _MANIFEST}
    with atomic_write(folder / _MANIFEST) as part:
        content = json.dumps({**(facts or {}), "files": listed}, indent=1, sort_keys=True)
        part.write_text(content, encoding="utf-8")


def _require_writable(target: Path) -> None:
    try:
        folder = next(parent for parent in target.absolute().parents if parent.exists())
        longest = os.pathconf(folder, "PC_NAME_MAX")
        is_long = any(len(os.fsencode(part)) > longest for part in target.parts)
        if is_long or os.statvfs(folder).f_flag & os.ST_RDONLY:
            number = errno.ENAMETOOLONG if is_long else errno.EROFS
            raise OSError(number, os.strerror(number))
        if not (folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)):
            raise OSError(errno.EACCES, f"{folder} isn't a folder that you may write to")
    except OSError as error:
        raise InvalidInput(f"{target} can't be written: {error.strerror}") from error


@contextmanager
def atomic_write(
    path: str | os.PathLike[str], *names: str, overwrite: bool = True
) -> Iterator[Path]:
    """Yield a temporary path beside `path`; what is written there is renamed to `path` at the end.

    Write a file there or make a folder. With `names`, it is a folder, and its files of these names
    move into the folder `path`, one right after the other. On an error nothing does; if the process
    is killed, only a folder named `.part-*` is left. Raises Occupied as `move_into_place` does.
    """
    root, own = (Path(path), names) if names else (Path(path).parent, [Path(path).name])
    root.mkdir(parents=True, exist_ok=True)
    staged = Path(tempfile.mkdtemp(prefix=f".part-{Path(own[0]).name[:32]}-", dir=root))
    try:
        yield staged if names else staged / own[0]
        for file in staged.rglob("*"):
            if file.is_file():  # must be on the disk before it gets its name
                with open(file, "rb+") as handle:
                    os.fsync(handle.fileno())
        for name in own:
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            move_into_place(staged / name, root / name, overwrite=overwrite)
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def move_into_place(part: Path, target: Path, *, overwrite: bool) -> None:
    """Rename a finished file or folder to `target`, on the same file system.

    A folder without a manifest gets one, which lists its files, so that it is known as an output.

    Without `overwrite` nothing is replaced, not even what another process has put there in the
    meantime: that raises Occupied. With it, an old folder steps aside and is removed once the new
    one is in its place; `require_output` puts it back where a kill came between the two steps.
    """
    is_folder = stat.S_ISDIR(part.lstat().st_mode)  # raises if nothing was written
    if is_folder and not (part / _MANIFEST).exists():
        list_files(part)
    _require_free(target, is_folder, overwrite)
    try:
        if overwrite and is_folder and os.path.lexists(target):
            target.rename(_aside(target))
            part.rename(target)
            remove(_aside(target))
        elif overwrite or is_folder:
            os.rename(part, target)  # a folder never takes the place of a file or a full folder
        else:
            _rename_to_free(part, target)
    except OSError as error:
        if error.errno not in _TAKEN:
            raise
        raise Occupied(f"{target} was made by another process in the meantime; kept it") from error


def _rename_to_free(part: Path, target: Path) -> None:
    try:
        os.link(part, target)  # unlike a rename, it fails if there is a file
    except OSError as error:
        # a file system without links
        if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.ENOSYS):
            raise
        part.rename(target)
    else:
        part.unlink()


def _aside(target: Path) -> Path:
    return target.parent / f".replaced-{target.name}"


def _put_back(target: Path) -> None:
    """Finish a replacement that was interrupted."""
    aside = _aside(target)
    if os.path.lexists(aside):
        if os.path.lexists(target):
            remove(aside)
        else:
            aside.rename(target)


def remove(path: Path) -> None:
    """Remove a file, a folder with its contents, or a link, but never the target of a link.

    A folder is renamed first: it is gone at once, and nobody writes into what is being removed.
    """
    if path.is_dir() and not path.is_symlink():
        path.rename(tempfile.mkdtemp(prefix=_removed(path), dir=path.parent))
        sweep(path)
    else:
        path.unlink(missing_ok=True)


@cache
def code_sha256(folder: Path, *without: str) -> str:
    """Return the SHA-256 of a package's files, but of the rooms that are left out."""
    digest = hashlib.sha256()
    files = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*.*")}
    for name in sorted(files):
        left_out = {*Path(name).parts} & {*without, "__pycache__"}
        if not left_out and files[name].is_file():
            digest.update(f"{name}\0".encode() + files[name].read_bytes() + b"\0")
    return digest.hexdigest()


def sweep(path: Path) -> None:
    """Remove what a killed removal of a folder has left; another process may do it too."""
    for left in path.parent.glob(f"{glob.escape(_removed(path))}*"):
        shutil.rmtree(left, ignore_errors=True)


def _removed(path: Path) -> str:
    return f".removed-{path.name[:32]}-"


def require_own(path: Path, error: type[KnotgymError] = Occupied) -> None:
    """Raise `error` if a path exists and is a link or belongs to another user.

    Somebody else may have planted it in a shared folder.
    """
    try:
        status = os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return
    if stat.S_ISLNK(status.st_mode):
        raise error(f"{path} is a link, and is never followed here; remove it")
    if status.st_uid != os.geteuid():
        raise error(f"{path} belongs to another user; remove it")


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
                raise InvalidFile(f"{step} is a link, which is never copied; put its file there")


def require_regular(
    path: str | os.PathLike[str], what: str, error: type[KnotgymError] = InvalidFile
) -> None:
    """Raise MissingFile if a path doesn't exist or is a folder, `error` if it is no regular file.

    Reading a pipe or a device may never end.
    """
    if not Path(path).exists() or Path(path).is_dir():
        raise MissingFile(f"no {what} at {path}")
    if not Path(path).is_file():
        raise error(f"{path} isn't a regular file, so no {what} is read from it")


def sha256(path: str | os.PathLike[str]) -> str:
    """Return the hexadecimal SHA-256 of a regular file's bytes, see `require_regular`."""
    require_regular(path, "file")
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
