"""Executors: results in the order of the work, little of it under way, and the same bytes on a
cluster whose workers die.
"""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from knotgym.common.errors import InvalidInput
from knotgym.control.policy_config import PolicyConfig
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect import collect
from knotgym.generate.episodes.collect_config import CollectConfig
from knotgym.generate.images.image_recipe import make_images
from knotgym.generate.images.images_config import ImagesConfig
from knotgym.runs.run_options import RunOptions

from ..cli.test_generate_command import bytes_of, said
from ..small_job import SECONDS, WANTED, knotgym, typed
from .test_kills import COLLECT, made

with_dask = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None, reason="Dask distributed isn't installed"
)
with_arrow = pytest.mark.skipif(
    importlib.util.find_spec("pyarrow") is None, reason="pyarrow isn't installed"
)


def on(scheduler: str) -> RunOptions:
    return RunOptions(executor="dask", scheduler=scheduler, quiet=True)


Begin = Callable[[], "subprocess.Popen[bytes]"]


@contextmanager
def cluster(
    room: Path, workers: int, *options: str
) -> Iterator[tuple[str, list["subprocess.Popen[bytes]"], Begin]]:
    """A scheduler and its workers, each a process of its own: the address, the workers, and what
    starts another.
    """
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    file = room / "scheduler.json"
    command = [
        sys.executable,
        "-m",
        "distributed.cli.dask_scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--no-dashboard",
    ]
    processes = [subprocess.Popen([*command, "--scheduler-file", str(file)], **quiet, cwd=room)]

    def begin() -> "subprocess.Popen[bytes]":
        words = [
            "--scheduler-file",
            str(file),
            "--nthreads",
            "1",
            "--no-nanny",
            "--no-dashboard",
            "--host",
            "127.0.0.1",
            *options,
        ]
        processes.append(
            subprocess.Popen(
                [sys.executable, "-m", "distributed.cli.dask_worker", *words], **quiet, cwd=room
            )
        )
        return processes[-1]

    try:
        began = [begin() for _ in range(workers)]
        until = time.monotonic() + SECONDS
        while not file.is_file() and time.monotonic() < until:
            time.sleep(0.05)
        address = str(json.loads(file.read_text())["address"])
        yield address, began, begin
    finally:
        for process in processes:
            process.kill()
            process.wait()


def generated(
    out: Path,
    scheduler: str,
    killed: "subprocess.Popen[bytes]",
    after: Callable[[], object] = lambda: None,
) -> None:
    """The small main job on a cluster, one of whose workers is killed after the first cycle."""
    run = subprocess.Popen(
        typed(
            "generate",
            *WANTED,
            "--executor",
            "dask",
            "--scheduler",
            scheduler,
            "--out",
            out,
            "--quiet",
        )
    )
    until = time.monotonic() + 2 * SECONDS
    while (
        not (out.parent / f".{out.name}.partial" / "run.json").exists()
        and run.poll() is None
        and time.monotonic() < until
    ):
        time.sleep(0.02)
    assert run.poll() is None
    os.kill(killed.pid, signal.SIGKILL)
    after()
    assert run.wait(timeout=4 * SECONDS) == 0


def test_processes_leave_an_interruption_to_their_parent_from_their_first_moment_on() -> None:
    words = [sys.executable, "-c", f"from {__name__} import _print_interruptible as told; told()"]
    assert (
        subprocess.run(words, capture_output=True, text=True, timeout=SECONDS).stdout
        == "[False, False, True]\n"
    )


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("mpi", "", 0), "--executor takes local or dask, got 'mpi'"),
        (("local", "tcp://a:1", 0), "--scheduler tcp://a:1 is for --executor dask"),
        (("dask", "", 0), "--executor dask needs the address"),
        (("dask", "tcp://a:1", 2), "--workers 2 is for --executor local"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    options: tuple[str, str, int], problem: str
) -> None:
    kind, scheduler, workers = options
    with pytest.raises(InvalidInput, match=problem):
        RunOptions(executor=kind, scheduler=scheduler, workers=workers)


@pytest.mark.parametrize("command", ["generate", "collect", "images"])
def test_a_wrong_executor_is_one_line_and_writes_nothing(
    command: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert knotgym(command, "--set", "run.executor=mpi", "--out", tmp_path / "a") == 2
    assert (
        said(capfd) == ["knotgym: --executor takes local or dask, got 'mpi'"]
        and list(tmp_path.iterdir()) == []
    )


def test_without_dask_one_line_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert (
        knotgym(
            "generate",
            "--nx",
            0,
            "--count",
            1,
            "--executor",
            "dask",
            "--scheduler",
            "tcp://127.0.0.1:9",
            "--out",
            tmp_path / "a",
        )
        == 2
    )
    (line,) = said(capfd)
    assert "pip install '.[dask]'" in line


@with_dask
@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense://x", "tcp://127.0.0.1:port"])
def test_a_scheduler_that_does_not_answer_is_one_line(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    from knotgym.runs import dask_executor

    monkeypatch.setattr(dask_executor, "CONNECT", 1.0)
    assert (
        knotgym(
            "generate",
            "--nx",
            0,
            "--count",
            1,
            "--executor",
            "dask",
            "--scheduler",
            address,
            "--out",
            tmp_path / "a",
        )
        == 2
    )
    (line,) = said(capfd)
    assert f"no Dask scheduler answers at {address}" in line


@with_dask
def test_a_worker_of_several_threads_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with cluster(tmp_path, 1, "--nthreads", "2") as (scheduler, _, _):
        assert (
            knotgym(
                "generate",
                "--nx",
                0,
                "--count",
                1,
                "--executor",
                "dask",
                "--scheduler",
                scheduler,
                "--out",
                tmp_path / "a",
            )
            == 2
        )
    assert "has 2 threads" in said(capfd)[-1]


@with_dask
def test_a_cluster_that_loses_a_worker_makes_the_same_bytes(
    curated: Path, states_path: str, tmp_path: Path
) -> None:
    task = TaskConfig(task="unknot", nx=1, states=states_path, observation="state", horizon=4)
    config = CollectConfig(task=task, policy=PolicyConfig(policy="scripted"), episodes=6)
    with cluster(tmp_path, 2) as (scheduler, workers, _):
        generated(tmp_path / "nx0-1", scheduler, workers[0])
        there = collect(config, tmp_path / "there", on(scheduler))
    assert bytes_of(tmp_path / "nx0-1") == bytes_of(curated)
    here = collect(config, tmp_path / "here", RunOptions(workers=1, quiet=True))
    assert bytes_of(there / "data")["main_data.hdf5"] == bytes_of(here / "data")["main_data.hdf5"]


@with_dask
@with_arrow
@pytest.mark.slow
def test_pictures_come_out_the_same_on_a_cluster(tmp_path: Path) -> None:
    config = ImagesConfig(nx=(0, 1), count=12, pulls=4, stride=2, rows_per_file=5)
    with cluster(tmp_path, 2) as (scheduler, _, _):
        make_images(config, tmp_path / "there", on(scheduler))
    make_images(config, tmp_path / "here", RunOptions(workers=1, quiet=True))
    assert bytes_of(tmp_path / "there") == bytes_of(tmp_path / "here")


@with_dask
@pytest.mark.slow
def test_a_scheduler_that_dies_is_one_line_and_the_run_goes_on_elsewhere(
    curated: Path, tmp_path: Path
) -> None:
    out = tmp_path / "nx0-1"
    with cluster(tmp_path, 1) as (scheduler, _, _):
        words = typed(
            "generate",
            *WANTED,
            "--set",
            "run.executor=dask",
            "--set",
            f"run.scheduler={scheduler}",
            "--out",
            out,
        )
        run = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        while not (tmp_path / ".nx0-1.partial" / "run.json").exists() and run.poll() is None:
            time.sleep(0.02)
    error = run.communicate(timeout=SECONDS)[1]
    assert (
        run.returncode == 1
        and error
        == "knotgym: the scheduler is gone; --resume continues from there, with any executor\n"
    )
    assert knotgym("generate", *WANTED, "--workers", 1, "--out", out, "--resume", "--quiet") == 0
    assert bytes_of(out) == bytes_of(curated)


def spoilt(room: Path, done: str, after: int) -> Path:
    """What a worker loads at its start, so that it does this after some actions."""
    path = room / "spoilt.py"
    path.write_text(
        "import itertools, os, signal\n"
        "from knotgym.rope.mujoco_simulation import MujocoSimulation as Simulation\n"
        "def spoilt(*words, **more):\n"
        f"    if next(Simulation.taken) >= {after}:\n        {done}\n"
        "    return Simulation.whole(*words, **more)\n"
        "if not hasattr(Simulation, 'whole'):  # a worker loads it more than once\n"
        "    Simulation.whole, Simulation.taken = Simulation.step, itertools.count()\n"
        "    Simulation.step = spoilt\n"
    )
    return path


@with_dask
@pytest.mark.slow
@pytest.mark.parametrize(
    ("done", "line"),
    [
        ("raise MemoryError", "out of memory, here or in a worker; finished work is kept"),
        ("os.kill(os.getpid(), signal.SIGKILL)", "the cluster has had no worker for 2 s; --resume"),
    ],
    ids=["told", "killed by the system"],
)
def test_a_worker_out_of_memory_is_one_line_and_what_was_finished_is_kept(
    done: str,
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    from knotgym.runs import dask_executor

    words = (*COLLECT, "--quiet", "--out")
    assert knotgym(*words, tmp_path / "whole", "--workers", 1) == 0
    capfd.readouterr()
    preload = spoilt(tmp_path, done, after=8)  # in the second shard
    with cluster(tmp_path, 1, "--preload", str(preload)) as (scheduler, _, _):
        dask = ("--set", "run.executor=dask", "--set", f"run.scheduler={scheduler}")
        wait_for_a_worker(scheduler)
        monkeypatch.setattr(dask_executor, "WAIT", 2.0)
        assert knotgym(*words, tmp_path / "a", *dask) == 1
    (said_,) = said(capfd)
    assert said_.startswith(f"knotgym: {line}")
    assert list((tmp_path / "a").rglob("episodes-*.json"))
    assert knotgym(*words, tmp_path / "a", "--workers", 1, "--resume") == 0
    assert made(tmp_path / "a") == made(tmp_path / "whole")


def wait_for_a_worker(scheduler: str) -> None:
    from distributed import Client

    with Client(scheduler, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=SECONDS)


@with_dask
@pytest.mark.slow
def test_a_worker_of_another_version_is_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.py"
    other.write_text("import knotgym\nknotgym.__version__ = '0.0.9'\n")
    with cluster(tmp_path, 1, "--preload", str(other)) as (scheduler, _, _):
        dask = ("--set", "run.executor=dask", "--set", f"run.scheduler={scheduler}")
        assert knotgym(*COLLECT, *dask, "--quiet", "--out", tmp_path / "a") == 2
    (line,) = said(capfd)
    assert line.startswith("knotgym: a worker has knotgym 0.0.9 and MuJoCo ")
    assert made(tmp_path / "a") == {}


@with_dask
@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2, 4])
def test_any_number_of_workers_makes_the_same_bytes_with_one_killed_and_another_come(
    workers: int, curated: Path, tmp_path: Path
) -> None:
    with cluster(tmp_path, workers) as (scheduler, began, begin):
        generated(tmp_path / "nx0-1", scheduler, began[0], begin)
    assert bytes_of(tmp_path / "nx0-1") == bytes_of(curated)
