"""A command that fails or is stopped: one line, nothing half-written, and --resume goes on."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from knotgym.runs.executors import executor

from ..scripts import ROOT
from ..small_job import SECONDS, knotgym, typed, wait_for_file

COLLECT = (
    *("collect", "--task", "unknot", "--nx", 1, "--policy", "random"),
    *("--engine", "chain", "--observation", "state", "--episodes", 128, "--id", "a-v0", "--quiet"),
)


@contextmanager
def mounted(folder: Path) -> Iterator[None]:
    """A read-only disk of its own at a folder; skips where this user may not mount one."""
    folder.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "ro,size=1m", "tmpfs", str(folder)]
    if subprocess.run(words, capture_output=True).returncode:
        pytest.skip("no disk can be mounted here")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_read_only_target_is_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with mounted(tmp_path / "disk"):
        assert knotgym(*COLLECT, "--workers", 1, "--out", tmp_path / "disk" / "b") == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "can't be written: Read-only file system" in line


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")
def test_a_worker_that_dies_is_one_line_and_the_rest_is_kept(tmp_path: Path) -> None:
    words = typed(*COLLECT, "--workers", 2, "--out", tmp_path)
    broken = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    workers = list[int]()
    while broken.poll() is None and not workers:
        time.sleep(0.01)
        workers = [own for child in children(broken.pid) for own in children(child)]
    os.kill(workers[-1], signal.SIGKILL)
    error = broken.communicate(timeout=SECONDS)[1]
    assert broken.returncode == 1 and error.startswith("knotgym: a worker died or memory ran out")
    assert error.count("\n") == 1
    assert knotgym(*COLLECT, "--workers", 1, "--out", tmp_path, "--resume") == 0


@pytest.mark.thorough
def test_a_worker_that_dies_while_another_starts_breaks_the_pool() -> None:
    with pytest.raises(BrokenExecutor), executor(2) as pool:
        pool.submit(time.sleep, 1)
        vars(pool)["_call_queue"]._reader.close()  # as the pool does once it finds a worker dead
        pool.submit(time.sleep, 1)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("send", "asked"), [(os.kill, [signal.SIGTERM]), (os.killpg, [signal.SIGINT] * 2)]
)
def test_asked_to_stop_it_says_so_once_and_leaves_its_work_at_most(
    send: Callable[[int, int], None], asked: list[int], tmp_path: Path
) -> None:
    words = typed(*COLLECT, "--workers", 2, "--out", tmp_path)
    stopped = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    wait_for_file(stopped, tmp_path, "run.json")
    for one in asked:
        send(stopped.pid, one)
        time.sleep(0.01)
    error = stopped.communicate(timeout=SECONDS)[1]
    assert stopped.returncode == 130 and error.count("\n") == 1
    assert error.startswith("knotgym: interrupted before all output ")
    assert "--resume to go on, or with --restart" in error
    assert all(path.name.startswith(".") for path in tmp_path.iterdir())


def _interruptible(_: int) -> bool:
    """Whether a Ctrl-C would reach this process."""
    return signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def _print_interruptible() -> None:
    with executor(2) as pool:
        print(json.dumps([*pool.map(_interruptible, range(2)), _interruptible(0)]))


@pytest.mark.slow
def test_processes_leave_an_interruption_to_their_parent_from_their_first_moment_on() -> None:
    words = [sys.executable, "-c", f"from {__name__} import _print_interruptible as told; told()"]
    told = subprocess.run(words, capture_output=True, text=True, timeout=SECONDS, cwd=ROOT).stdout
    assert json.loads(told) == [False, False, True]


def children(process: int) -> list[int]:
    """The processes that one has started."""
    with suppress(FileNotFoundError):  # it has ended
        return [*map(int, Path(f"/proc/{process}/task/{process}/children").read_text().split())]
    return []
