"""Run work on a Dask cluster; imported only for `--executor dask`.

Workers read and write the files of a run themselves, so they must see its folder under the same
path: start them anywhere on one shared file system, with the same version of knotgym. Set
PYTHONSAFEPATH=1 unless every module in the folder where they start may be imported. When a worker
dies, Dask repeats its pieces on other workers, with the same bytes.
"""

import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from typing import Any, NamedTuple

import mujoco

import knotgym
from knotgym.common.errors import Failed, InvalidInput, install_command
from knotgym.runs.pools import AHEAD, Promise, ordered

CONNECT = 10.0  # seconds to wait for the scheduler
WAIT = 60.0  # seconds to wait for a first worker, and for a new one when all are gone

_GONE = "the scheduler is gone; --resume continues from there, with any executor"

# Simulations are cached per process, and two threads of a worker must not share them.
_one_at_a_time = threading.Lock()


class _Awaited(NamedTuple):
    """A future that raises Failed when the cluster is gone."""

    client: Any
    future: Any

    def result(self) -> Any:
        from distributed import KilledWorker
        from distributed.comm import CommClosedError

        alone_since: float | None = None
        while True:
            done = self.future.done()
            try:
                return self.future.result(timeout=None if done else 2.0)
            except KilledWorker as error:
                raise Failed(
                    "several workers of the cluster died on the same piece of work; --resume"
                    " continues from there"
                ) from error
            except TimeoutError:
                if done:  # the work itself raised it
                    raise
            except (CommClosedError, CancelledError) as error:
                raise Failed(_GONE) from error
            with _answering():
                alone = not self.client.nthreads()
            alone_since = (alone_since or time.monotonic()) if alone else None
            if alone_since is not None and time.monotonic() - alone_since > WAIT:
                raise Failed(
                    f"the cluster has had no worker for {WAIT:.0f} s; --resume continues from there"
                )


class Cluster:
    """A pool of Dask workers."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._about = knotgym.__version__, mujoco.__version__

    def map(self, function: Callable[[Any], Any], work: Iterable[Any], /) -> Iterable[Any]:
        folder = os.getcwd()

        def submit(piece: Any) -> Promise:
            with _answering():
                arguments = function, piece, folder, self._about
                future = self._client.submit(_call, *arguments, pure=False)
            return _Awaited(self._client, future)

        with _answering():
            workers = len(self._client.nthreads())
        return ordered(submit, work, AHEAD * max(1, workers))


@contextmanager
def cluster(scheduler: str) -> Iterator[Cluster]:
    """Connect to the cluster whose scheduler is at this address, with workers of one thread
    each.
    """
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise InvalidInput(
            "--executor dask needs Dask distributed, which isn't installed; install it with:"
            f" {install_command('dask')}"
        ) from error
    except AttributeError as error:
        # distributed takes any module `snappy` for the compressor of that name
        raise InvalidInput(
            "Dask distributed can't be imported where SnapPy is installed, which has a module of"
            " the same name as a compressor that Dask looks for: use an environment without SnapPy"
        ) from error
    for name in ("distributed", *logging.root.manager.loggerDict):
        if name.startswith(("distributed", "tornado")):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)  # errors are raised instead
    try:
        client = Client(scheduler, timeout=CONNECT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InvalidInput(
            f"no Dask scheduler answers at {scheduler}: start one with `dask scheduler`, or check"
            " the address"
        ) from error
    try:
        try:
            client.wait_for_workers(1, timeout=WAIT)
        except TimeoutError as error:
            raise InvalidInput(
                f"the cluster at {scheduler} has no worker: start some with `dask worker"
                f" {scheduler} --nthreads 1`"
            ) from error
        threads = client.nthreads()
        if max(threads.values()) > 1:
            raise InvalidInput(
                f"a worker at {scheduler} has {max(threads.values())} threads, but must have one:"
                f" start workers with `dask worker {scheduler} --nthreads 1 --nworkers CORES`"
            )
        yield Cluster(client)
    finally:
        client.close(timeout=2.0)


@contextmanager
def _answering() -> Iterator[None]:
    """Turn a failed call of the scheduler into Failed."""
    try:
        yield
    except (OSError, TypeError, CancelledError) as error:  # TypeError: the client has given up
        raise Failed(_GONE) from error


def _call(function: Callable[[Any], Any], piece: Any, folder: str, about: tuple[str, str]) -> Any:
    """Run a piece of work on a worker, in the working directory of the run."""
    import cv2

    here = knotgym.__version__, mujoco.__version__
    if here != about:
        raise InvalidInput(
            f"a worker has knotgym {here[0]} and MuJoCo {here[1]}, but the run has {about[0]} and"
            f" {about[1]}: results could differ"
        )
    with _one_at_a_time:
        if os.getcwd() != folder:
            sys.path[:] = filter(None, sys.path)  # "" would import from the run's folder
            os.chdir(folder)  # paths may be relative to the run's folder
        cv2.setNumThreads(1)
        return function(piece)
