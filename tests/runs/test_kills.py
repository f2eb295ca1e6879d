"""What can go wrong while a run writes: each goes on or says in one line what happened, and
--resume completes to the same bytes.

Kills of the main job and of a collection are in test_main_job and test_collect, those of a
cluster's workers in test_executors.
"""

import contextlib
import functools
import importlib.util
import itertools
import os
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from knotgym.generate.episodes import collect as collecting
from knotgym.runs import engine

from ..cli.test_generate_command import bytes_of, held, said
from ..small_job import SECONDS, WANTED, knotgym, typed, wait_for_file
from .test_engine import lockless

with_arrow = pytest.mark.skipif(
    importlib.util.find_spec("pyarrow") is None, reason="pyarrow isn't installed"
)

# command, words, the folder below --out, the files whose bytes are compared
GENERATE = ("generate", *WANTED)
COLLECT = (
    "collect",
    "--task",
    "unknot",
    "--nx",
    1,
    "--policy",
    "random",
    "--horizon",
    3,
    "--episodes",
    16,
    "--id",
    "knotgym/unknot-nx1/random-v0",
)
IMAGES = ("images", "--nx", "0,1", "--count", 12)
COMMANDS = [
    pytest.param(("generate", "--nx", 0, "--count", 1), id="generate"),
    pytest.param(COLLECT, id="collect"),
    pytest.param(IMAGES, id="images", marks=with_arrow),
]
# Where a whole run or a process has to follow, one kind stands for all, and the others are slow.
RESUMABLE = [
    pytest.param(GENERATE, id="generate", marks=pytest.mark.slow),
    pytest.param(COLLECT, id="collect"),
    pytest.param(IMAGES, id="images", marks=[with_arrow, pytest.mark.slow]),
]
RESUMED = "continues from the last checkpoint"

Unbroken = Callable[[tuple[object, ...]], dict[str, str]]


def made(folder: Path) -> dict[str, str]:
    """SHA-256 of every finished file but the report of a collection, which tells how long planning
    took.
    """
    return {
        name: digest
        for name, digest in bytes_of(folder).items()
        if ".partial/" not in name and not name.endswith("collection.json")
    }


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory, curated: Path) -> Unbroken:
    """What a command leaves when nothing goes wrong, made when it is first asked for."""

    @functools.cache
    def left(command: tuple[object, ...]) -> dict[str, str]:
        if command == GENERATE:
            return made(curated)
        folder = tmp_path_factory.mktemp("unbroken") / "a"
        assert knotgym(*command, "--workers", 1, "--quiet", "--out", folder) == 0
        return made(folder)

    return left


@contextlib.contextmanager
def mounted(folder: Path, megabytes: float) -> Iterator[None]:
    """A small disk of its own at a folder; skips where this user may not mount one."""
    folder.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={int(1024 * megabytes)}k", "tmpfs", str(folder)],
        capture_output=True,
    ).returncode:
        pytest.skip("no disk can be mounted here")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def remounted(folder: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", str(folder)], check=True)


@pytest.mark.slow  # a limit on files is met in the same place, below
@pytest.mark.parametrize("command", RESUMABLE)
def test_a_full_disk_is_one_line_and_room_makes_it_go_on(
    command: tuple[object, ...],
    unbroken: Unbroken,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    disk = tmp_path / "disk"
    with mounted(disk, 0.25):
        out = disk / "a"
        assert knotgym(*command, "--workers", 1, "--quiet", "--out", out) == 1
        (line,) = said(capfd)
        assert line.startswith("knotgym: No space left on device")
        assert [
            path
            for path in disk.rglob("*")
            if path.is_dir()
            and (path / "data").is_dir()
            and not any(".partial" in part for part in path.parts)
        ] == []
        remounted(disk, "size=128m")
        assert knotgym(*command, "--workers", 1, "--quiet", "--out", out, "--resume") == 0
        assert made(out) == unbroken(command)


@pytest.mark.parametrize("command", RESUMABLE)
def test_a_limit_on_files_is_one_line(
    command: tuple[object, ...],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        assert knotgym(*command, "--workers", 1, "--quiet", "--out", tmp_path / "a") == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    (line,) = said(capfd)
    assert line.startswith("knotgym: File too large") and made(tmp_path / "a") == {}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_read_only_target_is_one_line(
    command: tuple[object, ...], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with mounted(tmp_path / "disk", 8):
        remounted(tmp_path / "disk", "ro")
        assert knotgym(*command, "--workers", 1, "--quiet", "--out", tmp_path / "disk" / "a") == 2
    (line,) = said(capfd)
    assert "disk/a" in line and "can't be written: Read-only file system" in line


@pytest.mark.parametrize("command", COMMANDS)
def test_a_second_run_is_refused(
    command: tuple[object, ...], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = final_folder(command, tmp_path)
    with held(folder.parent / f".{folder.name}.partial"):
        assert knotgym(*command, "--workers", 1, "--quiet", "--out", tmp_path / "a") == 2
    assert said(capfd) == [f"knotgym: another run is writing {folder.name} now"]


@pytest.mark.slow  # every run that was killed leaves one, and is resumed below
@pytest.mark.parametrize("command", RESUMABLE)
def test_a_stale_lock_is_not_in_the_way(
    command: tuple[object, ...], unbroken: Unbroken, tmp_path: Path
) -> None:
    folder = final_folder(command, tmp_path)
    with held(folder.parent / f".{folder.name}.partial"):
        pass
    lock = folder.parent / f".{folder.name}.partial" / "lock"
    assert lock.is_file()  # left by a process that is gone
    assert knotgym(*command, "--workers", 1, "--quiet", "--out", tmp_path / "a") == 0
    assert made(tmp_path / "a") == unbroken(command)


def final_folder(command: tuple[object, ...], room: Path) -> Path:
    """Where a command with --out room / "a" puts what it made; what holds the folder is there."""
    folder = room / "a"
    if command[0] == "collect":
        folder = folder / "knotgym" / "unknot-nx1" / "random-v0"
    folder.parent.mkdir(parents=True, exist_ok=True)
    return folder


def children(process: int) -> list[int]:
    """The processes that descend from one, the youngest last."""
    own = [
        int(word) for word in Path(f"/proc/{process}/task/{process}/children").read_text().split()
    ]
    return own + [below for child in own for below in children(child)]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")
def test_a_worker_that_dies_is_one_line_and_the_rest_is_kept(
    unbroken: Unbroken, tmp_path: Path
) -> None:
    words = typed(*COLLECT, "--workers", 2, "--quiet", "--out", tmp_path / "a")
    broken = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_for_file(broken, tmp_path, "episodes-*.json")
    os.kill(children(broken.pid)[-1], signal.SIGKILL)
    error = broken.communicate(timeout=SECONDS)[1]
    assert (
        broken.returncode == 1
        and error == f"knotgym: a worker died, perhaps out of memory; --resume {RESUMED}\n"
    )
    assert knotgym(*COLLECT, "--workers", 1, "--quiet", "--out", tmp_path / "a", "--resume") == 0
    assert made(tmp_path / "a") == unbroken(COLLECT)


@pytest.mark.thorough
def test_nothing_is_said_of_what_a_kill_left_behind(killed_run: tuple[Path, str]) -> None:
    said_by_all = killed_run[1]  # Python's resource tracker ends later, and would warn
    assert "resource_tracker" not in said_by_all and "Warning" not in said_by_all


@pytest.mark.slow  # a run that is asked once is in cli/test_generate_command
@pytest.mark.parametrize("command", RESUMABLE)
def test_asked_to_stop_twice_it_says_so_once(command: tuple[object, ...], tmp_path: Path) -> None:
    words = typed(*command, "--workers", 2, "--quiet", "--out", tmp_path / "a")
    stopped = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    wait_for_file(stopped, tmp_path, "lock")
    for _ in range(2):
        os.killpg(stopped.pid, signal.SIGINT)
        time.sleep(0.01)
    error = stopped.communicate(timeout=SECONDS)[1]
    assert (
        stopped.returncode == 130
        and error == f"knotgym: interrupted; no partial output is left, --resume {RESUMED}\n"
    )


def spoil(path: Path) -> None:
    """Change a byte in the middle of a file."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)


def stopped(*_: object) -> None:
    """What stands for a run's last step: it is interrupted there."""
    raise KeyboardInterrupt


@pytest.mark.slow  # tests/generate/test_unit_files.py spoils them too
def test_spoilt_shards_of_a_collection_are_made_anew(
    unbroken: Unbroken, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(collecting.EpisodeRecipe, "finish", stopped)
        assert knotgym(*COLLECT, "--workers", 1, "--quiet", "--out", tmp_path / "a") == 130
    assert made(tmp_path / "a") == {}
    first, second = (
        next(tmp_path.rglob(f"episodes-00000{k}.{kind}")) for k, kind in ((0, "h5"), (1, "json"))
    )
    spoil(first)
    second.write_text("{")
    assert knotgym(*COLLECT, "--workers", 1, "--quiet", "--out", tmp_path / "a", "--resume") == 0
    assert made(tmp_path / "a") == unbroken(COLLECT)


# What the engine's own tests say of the one engine (test_engine), here of each of the kinds.


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_disk_without_locks_is_one_line(
    command: tuple[object, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    folder = final_folder(command, tmp_path)
    lockless(monkeypatch)
    assert knotgym(*command, "--workers", 1, "--quiet", "--out", tmp_path / "a") == 2
    (line,) = said(capfd)
    assert f"{folder.name} can't be locked, because its file system has no locks" in line
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.slow
@pytest.mark.parametrize("command", RESUMABLE)
def test_a_clock_that_jumps_changes_no_byte(
    command: tuple[object, ...],
    unbroken: Unbroken,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    expected = unbroken(command)
    jumps = itertools.cycle([1e9, -1e9, 0.0, 5e9, 3.0])
    for name in ("time", "perf_counter"):
        monkeypatch.setattr(time, name, lambda: next(jumps))
    assert knotgym(*command, "--workers", 1, "--quiet", "--out", tmp_path / "a") == 0
    assert made(tmp_path / "a") == expected


@pytest.mark.slow
@pytest.mark.parametrize("command", RESUMABLE)
def test_a_folder_removed_under_a_run_is_one_line_and_the_next_makes_the_same(
    command: tuple[object, ...],
    unbroken: Unbroken,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    folder = final_folder(command, tmp_path)
    followed = engine.Batch.follow

    def removing(batch: engine.Batch, pool: Any) -> Iterator[None]:
        for done in followed(batch, pool):
            shutil.rmtree(folder.parent / f".{folder.name}.partial", ignore_errors=True)
            yield done

    with monkeypatch.context() as patch:
        patch.setattr(engine.Batch, "follow", removing)
        assert knotgym(*command, "--workers", 1, "--quiet", "--out", tmp_path / "a") in (1, 2)
    (line,) = said(capfd)
    assert line.startswith("knotgym: ") and made(tmp_path / "a") == {}
    assert knotgym(*command, "--workers", 1, "--quiet", "--out", tmp_path / "a", "--resume") == 0
    assert made(tmp_path / "a") == unbroken(command)
