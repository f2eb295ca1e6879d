"""A journal keeps the results of a run by key: a folder with one file of NumPy's for each result.

    run.json      identity of the run: what determines its output
    KEY.npy       a result, its key percent-encoded
    checkpoint    what a training keeps instead of results

A file is written beside and renamed, so it is there whole or not at all, whenever the process is
killed or the disk is full. It holds one record whose fields are the result's arrays, so that they
can be mapped into memory by one map, which keeps a file open, and after it the CRC-32 of all that.

Reading executes nothing and follows no links. A file that isn't whole, by its checksum or sizes,
counts as missing: the run computes that result again.
"""

import fcntl
import io
import json
import mmap
import os
import stat
import zlib
from collections import ChainMap
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any
from urllib.parse import quote, unquote

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidFile, InvalidInput, Occupied, differences, read_json, remove

Result = Mapping[str, NDArray[Any]]

CHECKPOINT = "checkpoint"
LEFT = "an interrupted run left its work in {}: --resume continues it, --restart deletes it"
_HEAD = {"format": "knotgym journal", "format_version": 3}
_RUN, _PART, _SUFFIX = "run.json", ".part", ".npy"
_KINDS = "biufUS"  # kinds of dtypes; objects would have to be unpickled
_MAPPED = 1 << 18  # bytes; smaller files are read, larger ones mapped
_LONGEST, _SUM = 1 << 16, 4  # bytes of a record's header, NumPy's most, and of its checksum


class Journal(ChainMap[str, Result]):
    """Results by key: those of one folder, which grows, and of others, which are only read.

    It is a context manager that closes itself. Results are read-only. It holds the lock of its
    folder, and nobody else may remove anything in it.

    Args:
        path: the folder; created if it doesn't exist. Only one process may write to it at a time.
        run: everything that determines the results, as JSON.
        others: journals of the same run, such as those of its shards.
        resume: keep what `path` holds.
        restart: forget what `path` holds; without either, work that is there is refused.

    Raises:
        Occupied: another process writes to `path`, it can't be locked, or it holds work.
        InvalidFile: a folder isn't a journal.
        InvalidInput: a folder is the journal of another run.
    """

    def __init__(
        self,
        path: str | Path,
        run: Mapping[str, Any],
        others: Iterable[str | Path] = (),
        *,
        resume: bool = True,
        restart: bool = False,
    ) -> None:
        self.path, self._run = Path(path), json.loads(json.dumps(run))
        super().__init__({}, {})  # those of this folder, and of the others
        with suppress(FileExistsError):  # a link or a file is refused below
            self.path.mkdir(parents=True, exist_ok=True)
        try:
            self._lock = _opened(self.path / _RUN, os.O_RDWR | os.O_CREAT, "r+b")
        except FileNotFoundError:
            raise Occupied(f"another run has just finished with {self.path}") from None
        try:
            _lock(self._lock, self.path, fcntl.LOCK_EX)
            if not self.is_held:  # the run that had locked it has removed it
                raise Occupied(f"another run has just finished with {self.path}")
            if not self.is_empty and not (resume or restart):
                raise Occupied(LEFT.format(self.path))
            for left in () if resume else _work(self.path):
                left.unlink()
            (self.path / _PART).unlink(missing_ok=True)
            for other in others:
                self.maps[1].update(self._read(Path(other)))
            if self.is_empty:  # then it doesn't matter which run has begun here
                self._lock.truncate(0)
                self._lock.write(json.dumps({**_HEAD, "run": self._run}).encode())
                self._lock.flush()
            self.maps[0].update(self._read(self.path))
        except BaseException as error:
            # where another process has the lock, nothing is ours to remove
            is_ours = not isinstance(error.__cause__, BlockingIOError) and self.is_held
            if is_ours and self.is_empty:
                remove(self.path)
            self._lock.close()
            raise

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.close()  # results stay mapped

    def __setitem__(self, key: str, result: Result) -> None:
        """Add a result, or replace that of the same key.

        Raises:
            InvalidInput: it has other columns than numbers and text.
        """
        arrays = {name: np.asarray(array, order="C") for name, array in result.items()}
        if wrong := [name for name, array in arrays.items() if array.dtype.kind not in _KINDS]:
            raise InvalidInput(f"a journal keeps numbers and text, not objects: {wrong[0]}")
        part, target = self.path / _PART, self._path_of(key)
        with _opened(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, "wb") as file:
            _write(file, arrays)
            file.flush()
            os.fsync(file.fileno())
        part.replace(target)
        whole = _read(target, check=False)
        if whole is None:
            raise InvalidFile(f"{target} was changed while it was written")
        self.maps[0][key] = whole

    def __delitem__(self, key: str) -> None:
        """Forget a result of this folder; one that isn't there is none."""
        self._path_of(key).unlink(missing_ok=True)
        self.maps[0].pop(key, None)

    @property
    def is_empty(self) -> bool:
        """Whether the folder itself has neither results nor a checkpoint."""
        return not _work(self.path)

    @property
    def is_held(self) -> bool:
        """Whether the folder is still at its path; False after it was removed or replaced."""
        try:
            there = os.stat(self.path / _RUN, follow_symlinks=False)
            return os.path.samestat(there, os.fstat(self._lock.fileno()))
        except (OSError, ValueError):
            return False

    def _path_of(self, key: str) -> Path:
        return self.path / f"{quote(key, safe=' ,:')}{_SUFFIX}"

    def _read(self, path: Path) -> dict[str, Result]:
        """Return the results of a folder, after a check that they are of this run."""
        try:
            head = read_json(path / _RUN)
            there = head.pop("run")
        except (OSError, ValueError, AttributeError, KeyError, TypeError) as error:
            raise InvalidFile(f"{path} isn't a journal of a run, or it is damaged") from error
        if head != _HEAD:
            raise InvalidFile(f"{path} has {head!r:.80}; this version reads {_HEAD}")
        if there != self._run:
            unlike = "; ".join(list(differences(there, self._run))[:3])
            raise InvalidInput(
                f"{path} belongs to a different run: {unlike[:500]}; give the same"
                " options again, or --restart to delete an interrupted run"
            )
        files = (file for file in _work(path) if file.name != CHECKPOINT)
        read = {unquote(file.name.removesuffix(_SUFFIX)): _read(file) for file in files}
        return {key: result for key, result in read.items() if result is not None}


def has_work(path: Path) -> bool:
    """Whether a journal is there and has results or a checkpoint.

    Raises:
        Occupied: another process writes to it.
        InvalidFile: it isn't a journal.
    """
    try:
        file = _opened(path / _RUN, os.O_RDONLY, "rb")
    except (FileNotFoundError, NotADirectoryError):
        return False
    with file:
        _lock(file, path, fcntl.LOCK_SH)
        return bool(_work(path))


def _work(path: Path) -> list[Path]:
    return sorted(file for file in path.iterdir() if file.name.endswith((_SUFFIX, CHECKPOINT)))


def _lock(file: IO[bytes], path: Path, kind: int) -> None:
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise Occupied(f"another run is writing to {path} now") from error
    except OSError as error:
        raise Occupied(f"{path} can't be locked ({error.strerror}); use another --out") from error


def _opened(path: Path, flags: int, mode: str) -> IO[bytes]:
    """Open a regular file in a folder that is no link; pipes don't block."""
    folder = path.parent
    wrong = InvalidFile(f"{folder} should be the folder of a journal; remove it")
    if folder.is_symlink() or path.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise wrong
    descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise wrong
    return open(descriptor, mode)


def _write(file: IO[bytes], arrays: Result) -> None:
    """Write arrays as the fields of one record, and the checksum of that."""
    fields = [(name, array.dtype, array.shape) for name, array in arrays.items()]
    record, whole = np.zeros((), np.dtype(fields, align=True)), io.BytesIO()
    for name, array in arrays.items():
        record[name] = array
    np.lib.format.write_array(whole, record, (1, 0), allow_pickle=False)
    file.write(whole.getvalue() + zlib.crc32(whole.getvalue()).to_bytes(_SUM, "little"))


def _read(path: Path, check: bool = True) -> Result | None:
    """Return the arrays of a result, read-only; None if it isn't whole.

    Args:
        path: the file.
        check: whether to compare the checksum, which reads all of it.
    """
    try:
        with _opened(path, os.O_RDONLY, "rb") as file:
            if os.fstat(file.fileno()).st_size > _MAPPED:
                data: Any = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            else:
                data = file.read()
        stored = int.from_bytes(data[-_SUM:], "little")
        if check and zlib.crc32(memoryview(data)[:-_SUM]) != stored:
            return None
        head = io.BytesIO(data[:_LONGEST])
        is_known = np.lib.format.read_magic(head) == (1, 0)
        shape, _, dtype = np.lib.format.read_array_header_1_0(head, _LONGEST)
        if not is_known or dtype.names is None or dtype.hasobject:
            return None
        record = np.ndarray(shape, dtype, data, head.tell())
        return {name: record[name] for name in dtype.names}
    except OSError as error:
        if error.errno is not None:
            raise
        return None
    except Exception:  # there is no end to what foreign bytes make NumPy raise
        return None
