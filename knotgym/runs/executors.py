"""Executors: this process, processes of this machine, or a Dask cluster; and what compiles first.

Each is a `concurrent.futures.Executor` with an attribute `workers`; those of this machine also have
`ended`, see `common.Counts`. A call depends on its arguments alone, so the choice of executor
doesn't change a byte of the output.

Workers of a cluster read the files of a run themselves, so they must see its folder under the same
path: start them anywhere on one shared file system, with the same version of knotgym, and
PYTHONSAFEPATH=1 unless every module in the folder where they start may be imported. When a worker
dies, Dask repeats its calls on other workers, with the same bytes.

Kernels are compiled before a run, so that its processes don't all wait for the same ones.
"""

import errno
import gc
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker
from multiprocessing.util import Finalize
from typing import Any

from knotgym import drawing, quality, rendering, topology
from knotgym.common import (
    Counts,
    Failed,
    InvalidInput,
    MissingExtra,
    Threads,
    differences,
    plugins,
    use_plugins,
)
from knotgym.rope import CHAIN, MUJOCO, Rope, compiling, simulation
from knotgym.runs.identities import versions
from knotgym.runs.progress import Progress

# Python's resource tracker warns when it cleans up after a killed run, which is expected.
_IGNORED_WARNING = "ignore:resource_tracker:UserWarning"

_SAFE_PATH = "PYTHONSAFEPATH"

TIMEOUT = 10.0  # seconds to wait for the scheduler, and for a first worker
# Simulations are cached per process, and two threads of a worker must not share them.
_one_at_a_time = threading.Lock()
_PICTURES, _DRAWINGS, _MEASURES = "pictures", "drawings", "measures"


class InProcess(Executor):
    """Execute calls in this process, when they are submitted."""

    workers = 1
    ended = Counts.ended

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
        context = _context()
        self.workers, self.ended = workers, context.Value("d", 0)
        self.seconds = context.Value("d", 0)  # of CPU, of workers that have ended
        Counts.compiling = context.Value("q", 0)
        shared = self.ended, Counts.compiling, self.seconds, [*plugins()]
        super().__init__(workers, mp_context=context, initializer=_serve, initargs=shared)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        with _starting():  # this may start a process
            try:
                return super().submit(fn, *args, **kwargs)
            except OSError as error:
                if error.errno not in (None, errno.EPIPE):
                    raise
                # this worker died as it started, or one before it and the queue is closed by now
                raise BrokenProcessPool(*error.args) from error


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
        with _cluster(scheduler) as remote:
            yield remote
        return
    count = workers or Threads.cores()
    if count == 1:
        yield InProcess()
        return
    pool = _Processes(count)
    try:
        yield pool
        pool.shutdown()
        Counts.worker_seconds += pool.seconds.value
    except BaseException:
        for process in list((getattr(pool, "_processes", None) or {}).values()):
            process.terminate()
        pool.shutdown(wait=False, cancel_futures=True)
        raise


@contextmanager
def _starting() -> Iterator[None]:
    """Start Python processes in the block.

    SIGINT and SIGTERM are delayed until it ends: a process that is just starting would print a
    traceback of its own. And no process imports from the current folder, which multiprocessing's
    `python -c` would put first on the path.
    """
    received: list[tuple[int, Any]] = []
    is_main = threading.current_thread() is threading.main_thread()
    handlers = {
        number: signal.signal(number, lambda *arguments: received.append(arguments))
        for number in ((signal.SIGINT, signal.SIGTERM) if is_main else ())
    }
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        del os.environ[_SAFE_PATH]
        if before is not None:
            os.environ[_SAFE_PATH] = before
        for number, handler in handlers.items():
            signal.signal(number, handler or signal.SIG_DFL)
        if received:
            signal.raise_signal(received[0][0])


def _context() -> multiprocessing.context.BaseContext:
    """Return the start method: a fork server, which has none of this process's threads and memory.

    Workers leave SIGINT to their parent. It is blocked while the server starts, and the server and
    its workers inherit that, so that no worker is interrupted before it can ignore the signal.
    """
    with _starting():
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


def _serve(ended: Any, compiling: Any, seconds: Any, names: list[str]) -> None:
    import cv2

    use_plugins(names)
    Counts.ended, Counts.compiling = ended, compiling
    # The shell's `time` doesn't see workers: they are children of the fork server.
    Finalize(None, _count_seconds, (seconds,), exitpriority=0)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _count_seconds(seconds: Any) -> None:
    with seconds.get_lock():
        seconds.value += time.process_time()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class _Cluster(Executor):
    """Dask's own executor; calls are made in the folder of the run, by the same version."""

    def __init__(self, executor: Executor, workers: int) -> None:
        self._executor, self.workers = executor, workers
        self._run = os.getcwd(), versions(), [*plugins()]

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        return self._executor.submit(_call, *self._run, fn, args, kwargs)


@contextmanager
def _cluster(scheduler: str) -> Iterator[Executor]:
    """Connect to the cluster whose scheduler is at this address.

    Raises:
        MissingExtra: Dask distributed isn't installed.
        InvalidInput: the cluster can't be used.
        Failed: the cluster is gone, or several workers died on the same call.
    """
    try:
        distributed = MissingExtra.imported("distributed", "dask", "run.scheduler")
    except AttributeError as error:
        # distributed takes any module `snappy` for the compressor of that name
        raise InvalidInput(
            "Dask distributed can't be imported where SnapPy is installed, which has a module of"
            " the same name as a compressor that Dask looks for: use an environment without SnapPy"
        ) from error
    try:
        client = distributed.Client(scheduler, timeout=TIMEOUT, set_as_default=False)
        client.wait_for_workers(1, timeout=TIMEOUT)
    except (OSError, ValueError) as error:
        raise InvalidInput(f"no Dask scheduler with workers answers at {scheduler}") from error
    try:
        yield _Cluster(client.get_executor(pure=False), len(client.nthreads()))
    except distributed.KilledWorker as error:
        raise Failed("several workers died on the same work; --resume goes on there") from error
    except (distributed.comm.CommClosedError, CancelledError) as error:
        raise Failed("the scheduler is gone; --resume goes on, with any executor") from error
    finally:
        client.close(timeout=2.0)


def _call(
    folder: str,
    run: dict[str, str],
    names: list[str],
    fn: Callable[..., Any],
    args: Any,
    kwargs: dict[str, Any],
) -> Any:
    """Make a call on a worker, in the working directory of the run."""
    import cv2

    if versions() != run:
        differs = next(differences(run, versions()))
        raise InvalidInput(f"a worker of the cluster has other versions than the run: {differs}")
    with _one_at_a_time:
        if os.getcwd() != folder:
            sys.path[:] = filter(None, sys.path)  # "" would import from the run's folder
            os.chdir(folder)  # paths may be relative to the run's folder
        use_plugins(names)
        cv2.setNumThreads(1)
        return fn(*args, **kwargs)


def compile_first(
    progress: Progress,
    pool: Executor | None = None,
    *,
    engine: str = MUJOCO,
    draws: bool = False,
    plan: Callable[[], None] | None = None,
) -> None:
    """Compile an engine's kernels, if they aren't; beside them, those that paint pictures.

    Both take about as long, so two processes of the pool compile them. In this process alone,
    which is the default, pictures wait until one is painted. A run that draws states also needs
    the kernels that draw and measure them, and one that plans in the chain engine those that
    `plan`, a function of a module, uses; otherwise each of its workers would compile them. States
    are drawn before anything is planned, so `plan` may still be under way on return.
    """
    engines = [engine] if plan is None else [*dict.fromkeys([CHAIN, engine])]
    if waiting := compiling(*engines):
        progress.stage(waiting[0], lasts=waiting[1])
        pool = pool or InProcess()
        # longest first; what several need is in the cache when the second comes to it
        longest, *others = engines
        if not isinstance(pool, InProcess):
            parts = [_DRAWINGS, _PICTURES, _MEASURES] if draws else [_PICTURES]
            others = [*parts, *others]
        first = pool.submit(_compile, longest)
        later = [pool.submit(_compile, name) for name in others]
        first.result()
        if plan is not None:
            planned = pool.submit(plan)  # moves ropes in the engine that is compiled by now
            later += [] if draws else [planned]
        for compiled in later:
            compiled.result()


def _compile(kernels: str) -> None:
    import numpy as np

    gc.disable()  # it finds nothing meanwhile, and takes a twentieth of the time
    rope, rng = Rope(), np.random.default_rng(0)
    if kernels == _PICTURES:
        rendering.draw(rope.loop())
    elif kernels == _DRAWINGS:
        drawing.drawn_curve(topology.GaussCode.parse("1+,1-"), rng, rope)
    elif kernels == _MEASURES:
        t = np.linspace(0, 2 * np.pi, 200, endpoint=False)
        eight = np.stack([0.3 * np.sin(t), 0.15 * np.sin(2 * t), 0.01 * np.cos(t)], axis=1)
        points = rope.from_curve(eight)
        quality.measure(points)
        quality.noise_survival(points, 0.015, rng, draws=2)
        topology.pyknotid_code(points)
        rope.qpos(points)
    else:
        first = simulation(kernels)
        first.step([0], [[0.0, 0.0, 0.0]])
        topology.label(first.points[0])
    gc.enable()
