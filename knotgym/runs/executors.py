"""Executors: this process, processes of this machine, or a Dask cluster.

Each is a `concurrent.futures.Executor` with an attribute `workers`. A call depends on its arguments
alone, so the choice of executor doesn't change a byte of the output.
"""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker
from typing import Any

from knotgym.common import cores

# Python's resource tracker warns when it cleans up after a killed run, which is expected.
_IGNORED_WARNING = "ignore:resource_tracker:UserWarning"

_SAFE_PATH = "PYTHONSAFEPATH"


class InProcess(Executor):
    """Execute calls in this process, when they are submitted."""

    workers = 1

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future

    def map(self, fn: Callable[..., Any], *iterables: Iterable[Any], **_: Any) -> Iterator[Any]:
        """Execute each call when its result is asked for."""
        return map(fn, *iterables)


class _Processes(ProcessPoolExecutor):
    """Processes of this machine, which leave interrupts to this one and end with it."""

    def __init__(self, workers: int) -> None:
        super().__init__(workers, mp_context=_context(), initializer=_serve)
        self.workers = workers

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        with _uninterrupted(), _safe_path():  # this may start a process
            return super().submit(fn, *args, **kwargs)

    def end(self) -> None:
        """End the processes without waiting for their work."""
        for process in list((getattr(self, "_processes", None) or {}).values()):
            process.terminate()
        self.shutdown(wait=False, cancel_futures=True)


@contextmanager
def executor(workers: int, scheduler: str = "") -> Iterator[Executor]:
    """Open an executor of `workers` processes, 0 for one per core; 1 uses this process.

    With the address of a Dask scheduler its cluster is used instead. On an error the processes end
    without waiting for their work.

    Raises:
        InvalidInput: the cluster can't be used.
        Failed: the cluster or its workers are gone.
    """
    if scheduler:
        from knotgym.runs.dask_executor import cluster

        with cluster(scheduler) as remote:
            yield remote
        return
    count = workers or cores()
    if count == 1:
        yield InProcess()
        return
    pool = _Processes(count)
    try:
        yield pool
        pool.shutdown()
    except BaseException:
        pool.end()
        raise


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Delay SIGINT and SIGTERM until the block ends.

    Otherwise a process that is just starting would print a traceback of its own.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[tuple[int, Any]] = []
    handlers = {
        number: signal.signal(number, lambda *arguments: received.append(arguments))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler or signal.SIG_DFL)
        if received:
            signal.raise_signal(received[0][0])


def _context() -> multiprocessing.context.BaseContext:
    """Return the start method: a fork server, which has none of this process's threads and memory.

    Workers leave SIGINT to their parent. It is blocked while the server starts, and the server and
    its workers inherit that, so that no worker is interrupted before it can ignore the signal.
    """
    with _uninterrupted(), _safe_path():
        # Start the tracker first: if the server started it, that would unblock the signals here.
        sys.warnoptions.append(_IGNORED_WARNING)  # child processes inherit warning options
        try:
            resource_tracker.ensure_running()
        finally:
            sys.warnoptions.remove(_IGNORED_WARNING)
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
    return multiprocessing.get_context("forkserver")


@contextmanager
def _safe_path() -> Iterator[None]:
    """Keep Python processes started in this block from importing from the current folder.

    Multiprocessing starts them with `python -c`, which puts that folder first on the path.
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
