"""The one engine on a disk without locks, under a clock that jumps, and with its folder gone."""

import errno
import fcntl
import itertools
import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from knotgym.common.atomic_files import atomic_write
from knotgym.common.errors import InvalidInput, Occupied
from knotgym.runs import engine
from knotgym.runs.engine import CHECKPOINT, Batch, Recipe
from knotgym.runs.progress import Progress, Status
from knotgym.runs.run_options import RunOptions
from knotgym.runs.staging import staging_folder

COUNT = 4
QUIET = RunOptions(workers=1, quiet=True)
RESUMED = RunOptions(workers=1, quiet=True, resume=True)


def squared(number: int) -> int:
    return number * number


class Squares(Recipe):
    """A recipe of squares, saved after each."""

    engine = "mujoco"
    done: list[int]

    def request(self) -> dict[str, Any]:
        return {"config": {"count": COUNT}, "source": "squares"}

    def begin(self) -> None:
        self.done = []

    def load(self, folder: Path) -> bool:
        if not (folder / "done.json").is_file():
            return False
        self.done = json.loads((folder / "done.json").read_text())
        return True

    def batches(self, folder: Path) -> Iterator[Batch]:
        while len(self.done) < COUNT:
            yield Batch(squared, [len(self.done)], lambda _, square: self.done.append(square))
            yield CHECKPOINT

    def save(self, folder: Path) -> None:
        with atomic_write(folder / "done.json") as temporary:
            temporary.write_text(json.dumps(self.done))

    def status(self) -> Status:
        return Status(len(self.done), COUNT, "squares", {})

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        folder.mkdir(parents=True)
        (folder / "squares.json").write_text(json.dumps(self.done))
        return folder

    def summary(self) -> str:
        return f"{len(self.done)} squares"


def made(out: Path, options: RunOptions = QUIET, recipe: Squares | None = None) -> str:
    return (engine.run(recipe or Squares(), out, options) / "squares.json").read_text()


def lockless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no file be locked, as on a network disk whose server has no locks."""

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)


def test_a_disk_without_locks_is_one_line_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        lockless(patch)
        with pytest.raises(
            Occupied, match=r"its file system has no locks \(No locks available\): choose"
        ):
            made(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_what_was_done_stays_where_locks_are_gone_for_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken(tmp_path / "a", monkeypatch)
    with monkeypatch.context() as patch:
        lockless(patch)
        with pytest.raises(Occupied):
            made(tmp_path / "a", RESUMED)
    assert (staging_folder(tmp_path / "a") / "done.json").is_file()
    assert made(tmp_path / "a", RESUMED) == "[0, 1, 4, 9]"


def test_a_clock_that_jumps_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jumps = itertools.cycle([1e9, -1e9, 0.0, 5e9, 3.0])
    for name in ("time", "monotonic", "perf_counter"):
        monkeypatch.setattr(time, name, lambda: next(jumps))
    with Progress(quiet=False, clock=lambda: next(jumps)) as progress:
        out = engine.run(Squares(), tmp_path / "a", QUIET, progress)
    assert (out / "squares.json").read_text() == "[0, 1, 4, 9]"


def broken(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that ended after two squares."""
    saved = Squares.save

    def stop(self: Squares, folder: Path) -> None:
        saved(self, folder)
        if len(self.done) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Squares, "save", stop)
        made(out)


def test_a_folder_removed_under_a_run_ends_it_and_the_next_makes_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "a"

    def remove(self: Squares, folder: Path) -> None:
        shutil.rmtree(folder)
        (folder / "done.json").write_text("")

    with monkeypatch.context() as patch, pytest.raises(FileNotFoundError):
        patch.setattr(Squares, "save", remove)
        made(out)
    assert list(tmp_path.iterdir()) == []
    assert made(out, RESUMED) == "[0, 1, 4, 9]"


@pytest.mark.parametrize("harm", ["another", "damaged", "missing", "a pipe"])
def test_what_does_not_say_what_it_is_of_is_not_gone_on_with(
    harm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken(tmp_path / "a", monkeypatch)
    request = staging_folder(tmp_path / "a") / engine.REQUEST
    text = request.read_text()
    request.unlink()
    if harm == "a pipe":
        os.mkfifo(request)
    elif harm != "missing":
        request.write_text(text.replace("squares", "cubes") if harm == "another" else text[:-9])
    with pytest.raises(InvalidInput, match="--restart"):
        made(tmp_path / "a", RESUMED)
    with pytest.raises(Occupied, match="--resume continues it, --restart deletes it"):
        made(tmp_path / "a")
    assert made(tmp_path / "a", replace(QUIET, restart=True)) == "[0, 1, 4, 9]"


def test_a_run_that_was_killed_at_once_leaves_nothing_in_the_way(tmp_path: Path) -> None:
    (staging_folder(tmp_path / "a") / ".part-request.json-x").mkdir(parents=True)
    (staging_folder(tmp_path / "a") / "lock").touch()
    assert made(tmp_path / "a", RESUMED) == "[0, 1, 4, 9]"


@pytest.mark.parametrize("kind", ["a link", "a pipe", "a folder"])
def test_a_lock_that_is_no_file_is_one_line_and_nothing_is_touched(
    kind: str, tmp_path: Path
) -> None:
    (tmp_path / "other").write_text("mine")
    lock = staging_folder(tmp_path / "a") / "lock"
    lock.parent.mkdir()
    if kind == "a link":
        lock.symlink_to(tmp_path / "other")
    elif kind == "a pipe":
        os.mkfifo(lock)
    else:
        lock.mkdir()
    with pytest.raises(Occupied, match="lock should be a file; remove it"):
        made(tmp_path / "a")
    assert (tmp_path / "other").read_text() == "mine"
