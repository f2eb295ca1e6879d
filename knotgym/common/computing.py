"""What makes computing fast: decorators of compiled functions, and rows divided among threads.

A `kernel` is called from Python; its machine code is kept for all processes of this user (`_Kept`).
Numba makes wrappers of each function through which Python and C could call it. A function that only
compiled code calls is `inner`, without them: a tenth of the compilation is saved, and no bit of a
result differs. Called from Python such functions crash, so tests call `njit(function.py_func)`. A
function that is called in one place is `inlined`: it is compiled faster as part of its caller,
unless it is long, when Numba's analysis takes more than LLVM saves.
`python benchmarks/compiled.py COMMAND` lists what a command compiles.

`Threads` are for NumPy, and compiled code that releases the interpreter's lock. A row's result must
not depend on the rows beside it; then the number of threads changes nothing.
"""

import atexit
import gc
import hashlib
import inspect
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread
from types import FunctionType
from typing import Any, ClassVar
from weakref import finalize

import numba
import numpy as np
from numba import extending, njit
from numba.core import event
from numba.core.caching import CacheImpl
from numba.core.dispatcher import Dispatcher
from numba.misc.appdirs import AppDirs

from knotgym.common.counts import Counts
from knotgym.common.errors import InvalidInput

if numba.config.DISABLE_JIT:
    raise InvalidInput("NUMBA_DISABLE_JIT is set, and kernels must be compiled: unset it")

_CGROUPS = Path("/sys/fs/cgroup")
_MEANT = Dispatcher, type(extending.intrinsic(lambda context: None))
_CONSTANTS = int, float, tuple, np.generic, np.ndarray


@cache
def _machine_code() -> Path:
    """Return the folder of kept machine code: NUMBA_CACHE_DIR, or one in the user's cache folder.

    Numba unpickles what lies there, so it must be this user's, and no other's to write. If there is
    none, the package's folder will do, or a temporary one that is deleted when the process ends.
    """
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(given)
    name = f"kernels-numba-{numba.__version__}-{sys.implementation.cache_tag}"
    for parent in (AppDirs("knotgym", False).user_cache_dir, Path(__file__).parent / "__pycache__"):
        with suppress(OSError):
            folder = Path(parent, name)
            folder.parent.mkdir(parents=True, exist_ok=True)
            folder.mkdir(0o700, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            status = folder.stat()
            if os.name == "nt" or (status.st_uid == os.geteuid() and not status.st_mode & 0o022):
                return folder
    folder = Path(tempfile.mkdtemp(prefix="knotgym-numba-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)  # worker processes inherit it
    return folder


def _sources(module: Any, seen: set[str]) -> Iterator[str]:
    """Yield what a module's kernels are made from: its source and constants, and those of modules
    whose compiled functions and named tuples it imports.
    """
    seen.add(module.__name__)
    yield inspect.getsource(module)
    for name, value in sorted(vars(module).items()):
        home = str(getattr(value, "__module__", ""))
        if isinstance(value, _MEANT) or (isinstance(value, type) and issubclass(value, tuple)):
            if home in sys.modules and home.startswith("knotgym.") and home not in seen:
                yield from _sources(sys.modules[home], seen)
        elif isinstance(value, _CONSTANTS) and not name.startswith("__"):
            text = value.tobytes() if isinstance(value, np.ndarray) else value
            yield re.sub(" at 0x[0-9a-f]+", "", f"{name} = {text!r}")


class _Kept:
    """Where numba keeps the machine code of a kernel: by what it was made from, not by its path.

    So a checkout and an installed package share it, and a changed callee compiles its callers
    again. Numba's own stamp is of the one file.
    """

    def __init__(self, function: FunctionType, file: str) -> None:
        self._py_file = file  # numba's warnings name it
        self._name = function.__qualname__
        options = re.findall("^[a-z]+ = njit.*", inspect.getsource(sys.modules[__name__]), re.M)
        parts = *options, *_sources(sys.modules[function.__module__], set())
        self._stamp = hashlib.sha256("\n".join(parts).encode()).hexdigest()

    @classmethod
    def from_function(cls, function: FunctionType, file: str) -> "_Kept | None":
        ours = function.__module__.partition(".")[0] in ("knotgym", "pyknotid")
        return cls(function, file) if ours else None

    def get_cache_path(self) -> str:
        return str(_machine_code() / f"{self._name}-{self._stamp[:32]}")

    def ensure_cache_path(self) -> None:
        os.makedirs(self.get_cache_path(), exist_ok=True)

    def get_source_stamp(self) -> str:
        return self._stamp

    def get_disambiguator(self) -> str:
        return self._stamp[:8]


CacheImpl._locator_classes.insert(0, _Kept)  # in every release of numba that pyproject.toml allows

# 1 / 0 is infinite and 0 / 0 NaN, as in NumPy: no branches are compiled that raise an exception
kernel = njit(cache=True, nogil=True, error_model="numpy")
inner = njit(nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
inlined = njit(nogil=True, inline="always", no_cpython_wrapper=True, no_cfunc_wrapper=True)


class _Compilation(event.Listener):
    """Count functions that are being compiled, and look for garbage rarely meanwhile.

    That saves a tenth of the time: Numba allocates so much that a collection of everything, which
    takes 0.2 s, comes every second.
    """

    def __init__(self) -> None:
        self._usual: list[tuple[int, int, int]] = []  # of the functions that are being compiled

    def on_start(self, event: Any) -> None:
        Counts.add(Counts.compiling, 1)
        self._usual.append(gc.get_threshold())
        if self._usual[0][0]:  # 0: no collections
            gc.set_threshold(max(10_000, self._usual[0][0]), 50, 50)

    def on_end(self, event: Any) -> None:
        Counts.add(Counts.compiling, -1)
        gc.set_threshold(*self._usual.pop())


event.register("numba:compile", _Compilation())


class Threads:
    """A pool of threads, which start when they are first needed; the caller's works as well.

    With 16 threads, a call of `concurrent.futures` takes 0.2 to 0.4 ms of the interpreter's lock; a
    step of 1,024 ropes, which has four such calls, takes 8 ms.

    Attributes:
        count: how many were asked for; 0 for one on every core, see `cores`.
    """

    FEW: ClassVar = 16  # ropes that are worth a call of their own, to be read or drawn

    def __init__(self, count: int = 1) -> None:
        self.count = count
        self._most = count or self.cores()
        self._tasks = SimpleQueue[Any]()
        self._workers = 0

    @staticmethod
    def cores() -> int:
        """Return how many cores this process may use: by its affinity and its container's quota.

        A container's quota is in `cpu.max` of its control group (version 2) or of one above that,
        microseconds that may be used in a period. Of a fraction of a core the whole is counted.
        """
        affine = hasattr(os, "sched_getaffinity")
        counts = [len(os.sched_getaffinity(0)) if affine else os.cpu_count() or 1]
        with suppress(OSError, ValueError):
            named = Path("/proc/self/cgroup").read_text().partition("0::/")[2].partition("\n")[0]
            for group in (_CGROUPS / named, *(_CGROUPS / named).parents):
                with suppress(OSError, ValueError):  # "max 100000" is no limit
                    quota, period = map(int, (group / "cpu.max").read_text().split())
                    counts.append(max(1, -(-quota // period)))
                if group == _CGROUPS:
                    break
        return min(counts)

    def spread(
        self,
        work: Callable[[slice], Any],
        rows: int,
        unit: int = 1,
        meanwhile: Callable[[], None] | None = None,
        most: int | None = None,
    ) -> list[Any]:
        """Call `work` with consecutive slices of `rows` rows, about as many on each thread.

        Args:
            work: called with a slice, on any thread.
            rows: how many there are; none if 0.
            unit: parts are whole multiples of it, but for the last.
            meanwhile: called on this thread while the others work; it must not touch their rows.
            most: rows of a slice, where they take unequal times or much memory; a multiple of unit.

        Returns:
            What the calls return, in the order of the rows.
        """
        size = min(-(-rows // (self._most * unit)) * unit, most or rows)
        parts = [slice(first, first + size) for first in range(0, rows, size or 1)]
        workers, results = min(self._most, len(parts)) - 1, [None] * len(parts)
        begun, done, errors = SimpleQueue[None](), SimpleQueue[None](), dict[int, BaseException]()

        def _do(number: int) -> None:
            begun.put(None)
            try:
                results[number] = work(parts[number])
            except BaseException as error:  # raised below
                errors[number] = error
            done.put(None)

        while self._workers < workers:
            Thread(target=_serve, args=(self._tasks,), daemon=True).start()
            finalize(self, self._tasks.put, None)  # which ends it
            self._workers += 1
        for number in range(1, len(parts)):
            self._tasks.put(partial(_do, number))
        try:
            if meanwhile is not None:
                # To begin, a thread needs the interpreter's lock, which code in Python hands over
                # only every 5 ms.
                for _ in range(workers):
                    begun.get()
                meanwhile()
        finally:
            calls = [partial(_do, 0)] if parts else []
            while calls:
                calls.pop()()
                with suppress(Empty):
                    calls.append(self._tasks.get_nowait())
            for _ in parts:
                done.get()
        if errors:
            raise errors[min(errors)]
        return results


def _serve(tasks: SimpleQueue[Any]) -> None:
    """Do tasks until one is None."""
    while (task := tasks.get()) is not None:
        task()
        del task  # holds arrays
