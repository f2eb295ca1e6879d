"""A journal keeps the results of a run by key, in one file that only grows.

    knotgym journal 1
    CRC [{"run": {...}}, 0]                        identity of the run: what determines its output
    CRC [{"key": "...", "columns": [...]}, size]   one record for each result,
    <size bytes>                                   followed by its columns

CRC is the CRC-32 of the rest of the record. A line is filled up with spaces so that the bytes after
it begin at a multiple of 64; so does each column, and columns can be mapped into memory. A process
that is killed leaves at most a torn last record, which the next writer cuts off. Reading a journal
executes nothing, and a file that isn't a journal is refused.
"""

import fcntl
import json
import mmap
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from math import prod
from pathlib import Path
from typing import IO, Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidFile, InvalidInput, Occupied, differences, printable

Result = Mapping[str, NDArray[Any]]

_MAGIC = b"knotgym journal 1\n"
_LONGEST = 1 << 20  # bytes of a record's line
_MOST = 1 << 48  # bytes of a column
_ALIGNED = 64
_KINDS = "biufUS"  # kinds of dtypes; objects would have to be unpickled


class _Column(NamedTuple):
    path: Path
    at: int  # first byte in the file
    end: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]


class Journal:
    """Results by key: those of one file, which grows, and of others, which are only read.

    It is a context manager that closes itself. Results are mapped from the files, read-only.

    Args:
        path: the file; created if it doesn't exist. Only one process may write to it at a time.
        run: everything that determines the results, as JSON.
        others: journals of the same run, such as those of its shards.
        fresh: forget what `path` holds.

    Raises:
        Occupied: another process writes to `path`, or it can't be locked.
        InvalidFile: a file isn't a journal, or was changed.
        InvalidInput: a file is the journal of another run.
    """

    def __init__(
        self,
        path: str | Path,
        run: Mapping[str, Any],
        others: Iterable[str | Path] = (),
        *,
        fresh: bool = False,
    ) -> None:
        self.path, self._run = Path(path), json.loads(json.dumps(run))
        self._results: dict[str, dict[str, _Column]] = {}
        self._own = 0  # results in the file itself
        self._maps: dict[Path, NDArray[np.uint8]] = {}
        for other in map(Path, others):
            with _opened(other, os.O_RDONLY, "rb") as file:
                self._index(other, file)
        self._file = _opened(self.path, os.O_RDWR | os.O_CREAT, "r+b")
        try:
            _lock(self._file, self.path, fcntl.LOCK_EX)
            if not self.is_held:  # the run that had locked it has removed it
                raise Occupied(f"another run has just finished with {self.path}")
            end = 0 if fresh else self._index(self.path, self._file)
            self._file.truncate(end)
            self._file.seek(end)
            if not end:
                self._file.write(_MAGIC)
            if end <= len(_MAGIC):
                self._append({"run": self._run})
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __contains__(self, key: str) -> bool:
        return key in self._results

    def __iter__(self) -> Iterator[str]:
        """Iterate over the keys."""
        return iter(self._results)

    def __len__(self) -> int:
        return len(self._results)

    def __getitem__(self, key: str) -> Result:
        """Return a result; its arrays are mapped from the file and read-only."""
        return {name: self._mapped(column) for name, column in self._results[key].items()}

    def __setitem__(self, key: str, result: Result) -> None:
        """Add a result, or replace that of the same key.

        It is in the file as a whole or not at all, whenever the process is killed.

        Raises:
            InvalidInput: it has other columns than numbers and text, or too many.
        """
        arrays = {name: np.asarray(array) for name, array in result.items()}
        described = [[name, one.dtype.str, list(one.shape)] for name, one in arrays.items()]
        try:
            columns, size = _columns(described, self.path, 0)
        except (TypeError, ValueError) as error:
            raise InvalidInput(f"a journal keeps numbers and text, not objects: {error}") from error
        at = self._append({"key": key, "columns": described}, [*arrays.values()], size)
        self._results[key] = {
            name: one._replace(at=one.at + at, end=one.end + at) for name, one in columns.items()
        }
        self._own += 1

    @property
    def is_empty(self) -> bool:
        """Whether the file itself has no results yet."""
        return not self._own

    @property
    def is_held(self) -> bool:
        """Whether the file is still at its path; False after it was removed or replaced."""
        try:
            return os.path.samestat(os.stat(self.path), os.fstat(self._file.fileno()))
        except OSError:
            return False

    def close(self) -> None:
        """Let other processes write; results stay mapped."""
        self._file.close()

    def _mapped(self, column: _Column) -> NDArray[Any]:
        if column.at == column.end:
            return np.empty(column.shape, column.dtype)
        mapped = self._maps.get(column.path)
        if mapped is None or len(mapped) < column.end:  # the file has grown
            mapped = self._maps[column.path] = np.asarray(np.memmap(column.path, np.uint8, "r"))
        return mapped[column.at : column.end].view(column.dtype).reshape(column.shape)

    def _append(
        self, head: dict[str, Any], arrays: Iterable[NDArray[Any]] = (), size: int = 0
    ) -> int:
        """Write a record; return where its columns begin."""
        text = json.dumps([head, size], sort_keys=True).encode()
        if len(text) > _LONGEST - 2 * _ALIGNED:
            raise InvalidInput("a result has too many columns for a journal")
        begin = self._file.tell() + 10  # the CRC, a space and the line feed take 10 bytes
        line = text.ljust(_padded(begin + len(text)) - begin)
        contents = [memoryview(line), *(piece for one in arrays for piece in _bytes(one))]
        check = 0
        for content in contents:
            check = crc32(content, check)
        self._file.write(b"%08x %s\n" % (check, line))
        at = self._file.tell()
        for content in contents[1:]:
            self._file.write(content)
        self._file.flush()
        os.fsync(self._file.fileno())
        return at

    def _index(self, path: Path, file: IO[bytes]) -> int:
        """Find the records of a file; return where the last whole one ends."""
        own, total = path == self.path, os.fstat(file.fileno()).st_size
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if total else b""
        if data[: len(_MAGIC)] != _MAGIC:
            if own and _MAGIC.startswith(data[: len(_MAGIC)]):
                return 0
            raise InvalidFile(f"{path} isn't a journal of a run")
        end, is_first = len(_MAGIC), True
        while at := data.find(b"\n", end, end + _LONGEST) + 1:
            line, left = data[end : at - 1], memoryview(data)[at:]
            head, size = _parsed(line, left)
            if head is None:
                break
            if is_first:
                self._require_same(path, head.get("run"))
            else:
                try:
                    columns, filled = _columns(head["columns"], path, at)
                    if filled != size or not isinstance(head["key"], str):
                        raise ValueError(head["key"])
                except (KeyError, TypeError, ValueError, SyntaxError) as error:
                    raise InvalidFile(
                        f"{path} has a record that no run of knotgym writes"
                    ) from error
                self._results[head["key"]] = columns
                self._own += own
            end, is_first = at + size, False
        if is_first and (at or not own):
            raise InvalidFile(f"{path} is damaged, it doesn't say which run it belongs to")
        return end

    def _require_same(self, path: Path, there: Any) -> None:
        if there != self._run:
            found = "; ".join(list(differences(there, self._run))[:3])
            raise InvalidInput(
                f"{path} belongs to a different run: {printable(found[:500])}; give the same"
                " options again, or --restart to delete an interrupted run"
            )


def has_results(path: Path) -> bool:
    """Whether a journal is there and has results.

    Raises:
        Occupied: another process writes to it.
        InvalidFile: it isn't a journal.
    """
    try:
        file = _opened(path, os.O_RDONLY, "rb")
    except FileNotFoundError:
        return False
    with file:
        _lock(file, path, fcntl.LOCK_SH)
        if not _MAGIC.startswith(file.read(len(_MAGIC))):
            raise InvalidFile(f"{path} isn't a journal of a run")
        return bool(file.readline(_LONGEST) and file.read(1))


def _lock(file: IO[bytes], path: Path, kind: int) -> None:
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise Occupied(f"another run is writing to {path} now") from error
    except OSError as error:
        raise Occupied(
            f"{path} can't be locked, because its file system has no locks ({error.strerror}):"
            " choose an --out on another"
        ) from error


def _opened(path: Path, flags: int, mode: str) -> IO[bytes]:
    """Open a regular file; links aren't followed and pipes don't block."""
    wrong = Occupied(f"{path} should be a file; remove it")
    try:
        descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    except OSError as error:
        raise wrong if path.is_symlink() or path.is_dir() else error from None
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise wrong
    return open(descriptor, mode)


def _parsed(line: bytes, left: memoryview) -> tuple[dict[str, Any] | None, int]:
    """Return a record's head and the number of bytes that follow; None if they aren't whole."""
    try:
        head, size = json.loads(line[9:])
        check = int(line[:8], 16)
    except (ValueError, TypeError, RecursionError):
        return None, 0
    whole = isinstance(head, dict) and type(size) is int and 0 <= size <= len(left)
    return (head, size) if whole and crc32(left[:size], crc32(line[9:])) == check else (None, 0)


def _columns(described: Any, path: Path, at: int) -> tuple[dict[str, _Column], int]:
    """Return the columns that a record describes, and how many bytes they fill.

    Raises:
        InvalidFile, TypeError, ValueError: no such columns are kept.
    """
    columns, first = dict[str, _Column](), at
    for name, text, shape in described:
        if not isinstance(name, str) or not isinstance(text, str) or len(text) > 16:
            raise InvalidFile(f"{name!r} is no column")
        dtype, sizes = np.dtype(text), tuple(shape)
        if dtype.kind not in _KINDS or len(sizes) > 32:
            raise InvalidFile(f"{name} of type {text}")
        if any(type(n) is not int or n < 0 for n in sizes) or prod(n or 1 for n in sizes) > _MOST:
            raise InvalidFile(f"{name} of shape {sizes}")
        end = at + dtype.itemsize * prod(sizes)
        columns[name] = _Column(path, at, end, dtype, sizes)
        at += _padded(end - at)
    return columns, at - first


def _padded(size: int) -> int:
    return -(-size // _ALIGNED) * _ALIGNED


def _bytes(array: NDArray[Any]) -> tuple[memoryview, bytes]:
    """Return the bytes of an array, and those that fill them up to a multiple of 64."""
    flat = np.ascontiguousarray(array).reshape(-1)
    content = flat.view(np.uint8).data if array.nbytes else memoryview(b"")
    return content, bytes(_padded(array.nbytes) - array.nbytes)
