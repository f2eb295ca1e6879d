"""What makes computing fast: decorators of compiled functions, and rows divided among threads.

Numba makes wrappers of each function through which Python and C could call it. A function that only
compiled code calls is `inner`, without them: a tenth of the compilation is saved, and no bit of a
result differs. Called from Python such functions crash, so tests call `njit(function.py_func)`. A
function that is called in one place is `inlined`: it is compiled faster as part of its caller,
unless it is long, when Numba's analysis takes more than LLVM saves.
`python benchmarks/compiled.py COMMAND` lists what a command compiles.

`Threads` are for NumPy, and compiled code that releases the interpreter's lock. A row's result must
not depend on the rows beside it; then the number of threads changes nothing.
"""

import gc
import os
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any, ClassVar
from weakref import finalize

from numba import njit
from numba.core import event

_CGROUPS = Path("/sys/fs/cgroup")

# 1 / 0 is infinite and 0 / 0 NaN, as in NumPy: no branches are compiled that raise an exception
inner = njit(nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
inlined = njit(nogil=True, inline="always", no_cpython_wrapper=True, no_cfunc_wrapper=True)


class _FewCollections(event.Listener):
    """Look for garbage rarely while a function is compiled: that is a tenth of the time.

    Numba allocates so much that a collection of everything, which takes 0.2 s, comes every second.
    """

    def __init__(self) -> None:
        self._usual: list[tuple[int, int, int]] = []  # of the functions that are being compiled

    def on_start(self, event: Any) -> None:
        self._usual.append(gc.get_threshold())
        if self._usual[0][0]:  # 0: no collections
            gc.set_threshold(max(10_000, self._usual[0][0]), 50, 50)

    def on_end(self, event: Any) -> None:
        gc.set_threshold(*self._usual.pop())


event.register("numba:compile", _FewCollections())


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
        found = [len(os.sched_getaffinity(0)) if affine else os.cpu_count() or 1]
        with suppress(OSError, ValueError):
            own = Path("/proc/self/cgroup").read_text().partition("0::/")[2].partition("\n")[0]
            for group in (_CGROUPS / own, *(_CGROUPS / own).parents):
                with suppress(OSError, ValueError):  # "max 100000" is no limit
                    quota, period = map(int, (group / "cpu.max").read_text().split())
                    found.append(max(1, -(-quota // period)))
                if group == _CGROUPS:
                    break
        return min(found)

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
            own = [partial(_do, 0)] if parts else []
            while own:
                own.pop()()
                with suppress(Empty):
                    own.append(self._tasks.get_nowait())
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
