"""Run work on a Dask cluster; imported only for run.scheduler=....

Workers read the files of a run themselves, so they must see its folder under the same path: start
them anywhere on one shared file system, with the same version of knotgym, and PYTHONSAFEPATH=1
unless every module in the folder where they start may be imported. When a worker dies, Dask repeats
its calls on other workers, with the same bytes.
"""

import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager
from typing import Any

from knotgym.common import Failed, InvalidInput, MissingExtra
from knotgym.runs.identities import versions

TIMEOUT = 10.0  # seconds to wait for the scheduler, and for a first worker

# Simulations are cached per process, and two threads of a worker must not share them.
_one_at_a_time = threading.Lock()


class _Cluster(Executor):
    """Dask's own executor; calls are made in the folder of the run, by the same version."""

    def __init__(self, executor: Executor, workers: int) -> None:
        self._executor, self.workers = executor, workers
        self._run = os.getcwd(), versions()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        return self._executor.submit(_call, *self._run, fn, args, kwargs)


@contextmanager
def cluster(scheduler: str) -> Iterator[Executor]:
    """Connect to the cluster whose scheduler is at this address.

    Raises:
        MissingExtra: Dask distributed isn't installed.
        InvalidInput: the cluster can't be used.
        Failed: the cluster is gone, or several workers died on the same call.
    """
    try:
        from distributed import Client, KilledWorker
        from distributed.comm import CommClosedError
    except ModuleNotFoundError as error:
        raise MissingExtra("Dask distributed", "dask", "run.scheduler") from error
    except AttributeError as error:
        # distributed takes any module `snappy` for the compressor of that name
        raise InvalidInput(
            "Dask distributed can't be imported where SnapPy is installed, which has a module of"
            " the same name as a compressor that Dask looks for: use an environment without SnapPy"
        ) from error
    try:
        client = Client(scheduler, timeout=TIMEOUT, set_as_default=False)
        client.wait_for_workers(1, timeout=TIMEOUT)
    except (OSError, ValueError) as error:
        raise InvalidInput(
            f"no Dask scheduler with workers answers at {scheduler}: check the address, or start"
            " `dask scheduler` and `dask worker`"
        ) from error
    try:
        yield _Cluster(client.get_executor(pure=False), len(client.nthreads()))
    except KilledWorker as error:
        raise Failed(
            "several workers of the cluster died on the same work; --resume continues from there"
        ) from error
    except (CommClosedError, CancelledError) as error:
        raise Failed(
            "the scheduler is gone; --resume continues from there, with any executor"
        ) from error
    finally:
        client.close(timeout=2.0)


def _call(
    folder: str, run: dict[str, str], fn: Callable[..., Any], args: Any, kwargs: dict[str, Any]
) -> Any:
    """Make a call on a worker, in the working directory of the run."""
    import cv2

    if versions() != run:
        raise InvalidInput(
            f"a worker of the cluster has other versions than the run, {versions()} and {run}:"
            " results could differ"
        )
    with _one_at_a_time:
        if os.getcwd() != folder:
            sys.path[:] = filter(None, sys.path)  # "" would import from the run's folder
            os.chdir(folder)  # paths may be relative to the run's folder
        cv2.setNumThreads(1)
        return fn(*args, **kwargs)
