"""Where work runs: in this process, in processes of this machine, or on a Dask cluster.

Results come in the order of the work, whatever the engine, and only so much of it is under way at a
time that memory stays flat. A piece of work is a function of its argument alone, so the engine
doesn't change a byte of what is made.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker
from typing import Any

from knotgym.runs.pools import AHEAD, InvalidEngine, Pool, Promise, ordered

ENGINES = ("local", "dask")
# when a run is killed, Python's tracker clears up what it left, of which nobody needs to hear
_UNTOLD = "ignore:resource_tracker:UserWarning"

_SAFE_PATH = "PYTHONSAFEPATH"


class InProcess:
    """Work done here, one piece after the other."""

    def map(self, function: Callable[[Any], Any], work: Iterable[Any], /) -> Iterable[Any]:
        return map(function, work)


class Processes:
    """Work done by the processes of an executor."""

    def __init__(self, executor: ProcessPoolExecutor, count: int) -> None:
        self._executor, self._count = executor, count

    def map(self, function: Callable[[Any], Any], work: Iterable[Any], /) -> Iterable[Any]:
        def submit(piece: Any) -> Promise:
            with uninterrupted(), _safe_path():  # a process may have to begin for it
                return self._executor.submit(function, piece)

        return ordered(submit, work, AHEAD * self._count)


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def scheduler_of(engine: str, scheduler: str, workers: int) -> str:
    """What the options --engine, --scheduler and --workers say: the address of a cluster's
    scheduler, "" for this machine.

    Raises:
        InvalidEngine: they don't go together.
    """
    if engine not in ENGINES:
        raise InvalidEngine(f"engine must be {' or '.join(ENGINES)}, got {engine!r}")
    if engine == "local" and scheduler:
        raise InvalidEngine(f"--scheduler {scheduler} is for --engine dask")
    if engine == "dask" and not scheduler:
        raise InvalidEngine(
            "--engine dask needs the address of a scheduler, such as --scheduler"
            " tcp://127.0.0.1:8786"
        )
    if engine == "dask" and workers:
        raise InvalidEngine(
            f"--workers {workers} is for --engine local; a cluster has the workers that were"
            " started for it"
        )
    return scheduler


@contextmanager
def executor(workers: int, scheduler: str = "") -> Iterator[Pool]:
    """A pool of `workers` processes, 0 for one a core; 1 works in this process. With a scheduler's
    address, its cluster.

    Raises:
        InvalidEngine: the cluster can't be used.
        LostWorkers: it is gone, or its workers are.
    """
    if scheduler:
        from knotgym.runs.dask_executor import cluster

        with cluster(scheduler) as distant:
            yield distant
        return
    count = workers or cores()
    if count == 1:
        yield InProcess()
        return
    pool = ProcessPoolExecutor(count, mp_context=_context(), initializer=_serve)
    try:
        yield Processes(pool, count)
        pool.shutdown()
    except BaseException:
        for process in list(getattr(pool, "_processes", {}).values()):
            process.terminate()
        pool.shutdown(wait=False, cancel_futures=True)
        raise


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C and SIGTERM back until the block ends: a process half begun would complain on its
    own.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, Any]] = []
    handlers = {
        number: signal.signal(number, lambda *said: came.append(said))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler or signal.SIG_DFL)
        if came:
            signal.raise_signal(came[0][0])


def _context() -> multiprocessing.context.BaseContext:
    """How processes begin: from a server that holds no copies of this process's threads and
    simulations.

    They leave Ctrl-C to their parent. The server, and all it starts, inherit that it is blocked, so
    none is interrupted before it can say so.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    with uninterrupted(), _safe_path():
        # else the server starts it, which unblocks the signals here
        sys.warnoptions.append(_UNTOLD)  # are handed to what is started
        try:
            resource_tracker.ensure_running()
        finally:
            sys.warnoptions.remove(_UNTOLD)
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
    return multiprocessing.get_context("forkserver")


@contextmanager
def _safe_path() -> Iterator[None]:
    """Let the Python processes that begin in this block import nothing from the current folder.

    Multiprocessing begins them by `python -c`, which puts that folder first on the path.
    """
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_SAFE_PATH]
        else:
            os.environ[_SAFE_PATH] = before


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
