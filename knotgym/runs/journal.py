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
import math
import os
import stat
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import differences
from knotgym.common.errors import InvalidFile, InvalidInput, Occupied, printable

Result = Mapping[str, NDArray[Any]]

_MAGIC = b"knotgym journal 1\n"
_LONGEST = 1 << 20  # bytes of a record's line
_ALIGNED = 64
_KINDS = "biufUS"  # kinds of dtypes; objects would have to be unpickled
_MOST = 1 << 48  # bytes of a column
_BLOCK = 1 << 24  # bytes read at a time


class _Record(NamedTuple):
    path: Path
    at: int  # where the first column begins in the file
    columns: list[Any]  # (name, dtype, shape) of each


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
        self._records: dict[str, _Record] = {}
        self._maps: dict[Path, NDArray[np.uint8]] = {}
        for other in map(Path, others):
            with _opened(other, os.O_RDONLY, "rb") as file:
                self._index(other, file)
        self._file = _opened(self.path, os.O_RDWR | os.O_CREAT, "r+b")
        try:
            _lock(self._file, self.path, fcntl.LOCK_EX)
            if not self.is_held:  # the run that had locked it has removed it
                raise Occupied(f"another run has just finished with {self.path}")
            if fresh:
                self._file.truncate(0)
            self._file.truncate(self._index(self.path, self._file))
            self._file.seek(0, os.SEEK_END)
            if not self._file.tell():
                self._file.write(_MAGIC)
                self._append({"run": self._run})
            elif self._file.tell() == len(_MAGIC):
                self._append({"run": self._run})
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __contains__(self, key: str) -> bool:
        return key in self._records

    def __iter__(self) -> Iterator[str]:
        """Iterate over the keys, in the order in which they were kept."""
        return iter(self._records)

    def __len__(self) -> int:
        return len(self._records)

    def __getitem__(self, key: str) -> Result:
        """Return a result; its arrays are mapped from the file and read-only."""
        path, at, columns = self._records[key]
        size = sum(_padded(_size(column)) for column in columns)
        mapped = self._maps.get(path)
        if size and (mapped is None or len(mapped) < at + size):
            mapped = self._maps[path] = np.asarray(np.memmap(path, np.uint8, "r"))
        result: dict[str, NDArray[Any]] = {}
        for name, dtype, shape in columns:
            size = _size((name, dtype, shape))
            if mapped is None or not size:
                result[name] = np.empty(shape, dtype)
            else:
                result[name] = mapped[at : at + size].view(dtype).reshape(shape)
            at += _padded(size)
        return result

    def keep(self, key: str, result: Result) -> None:
        """Add a result, or replace that of the same key.

        It is in the file as a whole or not at all, whenever the process is killed.
        """
        arrays = {name: np.asarray(array) for name, array in result.items()}
        if refused := [name for name, one in arrays.items() if one.dtype.kind not in _KINDS]:
            raise InvalidInput(f"a journal keeps numbers and text, not objects: {refused[0]}")
        columns = [[name, one.dtype.str, list(one.shape)] for name, one in arrays.items()]
        at = self._append({"key": key, "columns": columns}, *arrays.values())
        self._records.pop(key, None)
        self._records[key] = _Record(self.path, at, columns)

    @property
    def is_empty(self) -> bool:
        """Whether the file itself has no results yet."""
        return not any(record.path == self.path for record in self._records.values())

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

    def _append(self, head: dict[str, Any], *arrays: NDArray[Any]) -> int:
        """Write a record; return where its columns begin."""
        contents = [_bytes(array) for array in arrays]
        text = json.dumps([head, sum(map(len, contents))], sort_keys=True).encode()
        begin = self._file.tell()
        if len(text) > _LONGEST - 2 * _ALIGNED:
            raise InvalidInput(f"a result has too many columns for a journal: {len(arrays)}")
        line = text.ljust(_padded(begin + 9 + len(text) + 1) - begin - 10)  # 9: CRC, 1: newline
        check = crc32(line)
        for content in contents:
            check = crc32(content, check)
        self._file.write(b"%08x %s\n" % (check, line))
        at = self._file.tell()
        for content in contents:
            self._file.write(content)
        self._file.flush()
        os.fsync(self._file.fileno())
        return at

    def _index(self, path: Path, file: IO[bytes]) -> int:
        """Find the records of a file; return where the last whole one ends."""
        own, total = path == self.path, os.fstat(file.fileno()).st_size
        begun = file.read(len(_MAGIC))
        if begun != _MAGIC:
            if own and _MAGIC.startswith(begun):
                return 0
            raise InvalidFile(f"{path} isn't a journal of a run")
        end, named = len(_MAGIC), False
        while line := file.readline(_LONGEST):
            at = end + len(line)
            record = _parsed(line, total - at)
            if record is not None:
                head, size, check = record
                check ^= _checksum(file, size, line[9:-1])
            if record is None or check:
                break
            if not named:
                self._require_same(path, head.get("run"))
            elif not _is_result(head, size):
                raise InvalidFile(f"{path} has a record that no run of knotgym writes")
            else:
                self._records.pop(head["key"], None)
                self._records[head["key"]] = _Record(path, at, head["columns"])
            end, named = at + size, True
        if not named and (not own or line.endswith(b"\n")):
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
        begun = file.read(len(_MAGIC))
        if not _MAGIC.startswith(begun):
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
    """Open a regular file of this user; links aren't followed and pipes don't block."""
    try:
        descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    except OSError as error:
        if path.is_symlink() or path.is_dir():
            raise Occupied(f"{path} should be a file; remove it") from error
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise Occupied(f"{path} should be a file; remove it")
    return open(descriptor, mode)


def _parsed(line: bytes, left: int) -> tuple[dict[str, Any], int, int] | None:
    """Parse a record's line: its head, the bytes that follow and its CRC; None if it is torn."""
    try:
        head, size = json.loads(line[9:])
        check = int(line[:8], 16)
    except (ValueError, TypeError, RecursionError):
        return None
    whole = line.endswith(b"\n") and isinstance(head, dict) and type(size) is int
    return (head, size, check) if whole and 0 <= size <= left else None


def _checksum(file: IO[bytes], size: int, line: bytes) -> int:
    check = crc32(line)
    while size and (block := file.read(min(size, _BLOCK))):
        check, size = crc32(block, check), size - len(block)
    return check


def _is_result(head: dict[str, Any], size: int) -> bool:
    """Whether a record describes arrays that fill its bytes."""
    try:
        columns = head["columns"]
        return (
            isinstance(head["key"], str)
            and all(_is_column(*column) for column in columns)
            and size == sum(_padded(_size(column)) for column in columns)
        )
    except (KeyError, TypeError, ValueError, SyntaxError):
        return False


def _is_column(name: Any, dtype: Any, shape: Any) -> bool:
    if not (isinstance(name, str) and isinstance(dtype, str) and len(dtype) < 16):
        raise TypeError(name)
    kind = np.dtype(dtype)
    if kind.kind not in _KINDS or any(type(n) is not int or n < 0 for n in shape):
        raise TypeError(dtype)
    return kind.itemsize * math.prod(n or 1 for n in shape) < _MOST and len(shape) < 32


def _size(column: Any) -> int:
    return np.dtype(column[1]).itemsize * math.prod(column[2])


def _padded(size: int) -> int:
    return -(-size // _ALIGNED) * _ALIGNED


def _bytes(array: NDArray[Any]) -> memoryview:
    """Return the bytes of an array, filled up to a multiple of 64."""
    padded = np.zeros(_padded(array.nbytes), np.uint8)
    if array.nbytes:
        padded[: array.nbytes] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    return padded.data
