"""Where work runs: in this process or in processes of this machine. Results come in the order of the work, whatever the engine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any, Protocol


class Pool(Protocol):
    """Something that maps a function over work."""

    def map(self, function: Callable[[Any], Any], work: Iterable[Any], /) -> Iterable[Any]: ...


class InProcess:
    """Work done here, one piece after the other."""

    def map(self, function: Callable[[Any], Any], work: Iterable[Any], /) -> Iterable[Any]:
        return map(function, work)


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def engine(workers: int) -> Iterator[Pool]:
    """A pool of `workers` processes, 0 for one a core; 1 works in this process."""
    count = workers or cores()
    if count == 1:
        yield InProcess()
        return
    # forkserver: no copies of this process's threads and simulations; workers leave Ctrl-C to their parent, and end when it is killed
    context = multiprocessing.get_context("forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn")
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_serve)
    try:
        yield pool
        pool.shutdown()
    except BaseException:
        for process in list(getattr(pool, "_processes", {}).values()):
            process.terminate()
        pool.shutdown(wait=False, cancel_futures=True)
        raise


def _serve() -> None:
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
