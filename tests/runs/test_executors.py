"""Executors: Dask clusters, which lose workers or all."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pytest_types import Patch

from knotgym.common import Failed, InvalidInput
from knotgym.runs.journal import Journal
from knotgym.runs.run_options import RunOptions

from ..scripts import ROOT
from ..small_job import SECONDS
from .recipes import RECIPES, content

pytest.importorskip("distributed")


def on(scheduler: str) -> RunOptions:
    return RunOptions(scheduler=scheduler, quiet=True)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense://x", "tcp://127.0.0.1:port"])
def test_a_silent_scheduler_is_one_line(address: str, tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("knotgym.runs.executors.TIMEOUT", 1.0)
    with pytest.raises(InvalidInput, match="no Dask scheduler with workers answers at"):
        RECIPES["toy"](tmp_path / "a", on(address))


class Cluster:
    """A scheduler and its workers, each a process of its own."""

    def __init__(self, room: Path) -> None:
        self.file, self.processes = room / "scheduler.json", list["subprocess.Popen[bytes]"]()
        self._begin("scheduler", "--port", "0")

    def worker(self, *options: str) -> "subprocess.Popen[bytes]":
        return self._begin("worker", "--nthreads", "1", "--no-nanny", *options)

    def address(self) -> str:
        until = time.monotonic() + SECONDS
        while not self.file.is_file() and time.monotonic() < until:
            time.sleep(0.05)
        return str(json.loads(self.file.read_text())["address"])

    def _begin(self, kind: str, *options: str) -> "subprocess.Popen[bytes]":
        words = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--host", "127.0.0.1"]
        words += ["--no-dashboard", "--scheduler-file", str(self.file), *options]
        quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        # workers import the recipes by name
        path = {**os.environ, "PYTHONPATH": str(ROOT)}
        self.processes.append(subprocess.Popen(words, **quiet, cwd=self.file.parent, env=path))
        return self.processes[-1]


@contextmanager
def cluster(room: Path) -> Iterator[Cluster]:
    one = Cluster(room)
    try:
        yield one
    finally:
        for process in one.processes:
            process.kill()
            process.wait()


@pytest.mark.parametrize("name", ["toy", "images"])
def test_a_lost_worker_changes_no_byte(name: str, tmp_path: Path, monkeypatch: Patch) -> None:
    def kill_one(self: Journal, *arguments: Any) -> None:
        kept(self, *arguments)
        began[0].kill()

    kept, here = Journal.__setitem__, RECIPES[name](tmp_path / "here" / name, RunOptions(workers=1))
    with cluster(tmp_path) as dask, monkeypatch.context() as patch:
        began = [dask.worker(), dask.worker()]
        patch.setattr(Journal, "__setitem__", kill_one)
        there = RECIPES[name](tmp_path / "there" / name, on(dask.address()))
    assert content(there) == content(here)


def test_a_dead_scheduler_is_one_line_the_run_goes_on(tmp_path: Path, monkeypatch: Patch) -> None:
    def kill_all(self: Journal, *arguments: Any) -> None:
        kept(self, *arguments)
        for process in dask.processes:
            process.kill()

    kept = Journal.__setitem__
    with cluster(tmp_path) as dask, monkeypatch.context() as patch:
        dask.worker()
        patch.setattr(Journal, "__setitem__", kill_all)
        with pytest.raises(Failed, match="the scheduler is gone; --resume goes on"):
            RECIPES["toy"](tmp_path / "a", on(dask.address()))
    RECIPES["toy"](tmp_path / "a", RunOptions(workers=1, resume=True))


def test_a_worker_of_another_version_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "other.py").write_text("import knotgym\nknotgym.__version__ = '0.0.9'\n")
    with cluster(tmp_path) as dask:
        dask.worker("--preload", str(tmp_path / "other.py"))
        with pytest.raises(InvalidInput, match="a worker of the cluster has other versions"):
            RECIPES["toy"](tmp_path / "a", on(dask.address()))
