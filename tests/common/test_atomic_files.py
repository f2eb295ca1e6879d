"""Files appear complete or not at all."""

import os
import signal
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest

from knotgym.common.atomic_files import atomic_write, remove, require_output, sha256
from knotgym.common.configurations import read_json
from knotgym.common.errors import KnotgymError, Occupied


class Interrupted(Exception):
    """Any error that stops a writer."""


@pytest.mark.parametrize("text", [None, "old"])
def test_an_error_leaves_what_was_there(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "a.txt").write_text(text)
    with pytest.raises(Interrupted), atomic_write(tmp_path / "a.txt") as part:
        part.write_text("half")
        raise Interrupted
    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "a.txt"):
        pass  # nothing is written
    assert [path.read_text() for path in tmp_path.iterdir()] == [text] * (text is not None)


def test_a_kill_leaves_nothing_under_the_final_name(tmp_path: Path) -> None:
    writer = f"""
import time
from knotgym.common.atomic_files import atomic_write
with atomic_write({str(tmp_path / "a.txt")!r}) as temporary:
    temporary.write_text("half")
    print("written", flush=True)
    time.sleep(60)
"""
    process = subprocess.Popen([sys.executable, "-c", writer], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "written\n"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert [path.name[:6] for path in tmp_path.iterdir()] == [".part-"]


def test_two_writers_of_one_name_leave_one_of_the_two(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "a.txt") as one, atomic_write(tmp_path / "a.txt") as other:
        one.write_text("one")
        other.write_text("other")
    assert [path.read_text() for path in tmp_path.iterdir()] in (["one"], ["other"])


def test_what_is_no_file_has_no_checksum(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(KnotgymError, match="isn't a regular file|no file at"):
            sha256(path)


def test_an_output_is_replaced_whole_and_only_if_asked(tmp_path: Path) -> None:
    for folder in (True, False):
        target = tmp_path / str(folder)
        for text in ("old", "kept", "new"):
            refused = pytest.raises(Occupied) if text == "kept" else nullcontext()
            with refused, atomic_write(target, overwrite=text == "new") as part:
                if folder:
                    (part / "data" / text).mkdir(parents=True)
                (part / "data" / text / "a.txt" if folder else part).write_text(text)
        assert (target / "data/new/a.txt" if folder else target).read_text() == "new"
    assert [path.name for path in (tmp_path / "True/data").iterdir()] == ["new"]
    (listed,) = read_json(tmp_path / "True/manifest.json")["files"]
    assert listed == "data/new/a.txt"
    assert len(list(tmp_path.iterdir())) == 2


def test_what_another_process_made_meanwhile_is_kept(tmp_path: Path) -> None:
    with pytest.raises(Occupied), atomic_write(tmp_path / "a", overwrite=False) as part:
        part.mkdir()
        (tmp_path / "a").mkdir()
    assert (tmp_path / "a").is_dir()


def test_an_exchange_that_was_killed_is_put_back(tmp_path: Path) -> None:
    (tmp_path / ".replaced-set").mkdir()
    (tmp_path / ".replaced-set" / "manifest.json").write_text("old")
    with pytest.raises(Occupied):
        require_output(tmp_path / "set", folder=True, reads=[])
    assert (tmp_path / "set" / "manifest.json").read_text() == "old"


def test_what_a_killed_removal_left_goes_with_the_next(tmp_path: Path) -> None:
    for name in ("left", "set"):
        (tmp_path / name).mkdir()
    (tmp_path / "left").rename(tmp_path / ".removed-set-abcd1234")
    remove(tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


def make(kind: str, target: Path) -> None:
    if kind == "pipe":
        os.mkfifo(target)
    elif kind == "file":
        target.touch()
    else:
        (target / kind).mkdir(parents=True)
        if kind == "thesis":  # a folder of the user's, with an output of ours among others
            (target / "states.h5").touch()
            (target / "manifest.json").write_text('{"files": {"states.h5": ""}}')


@pytest.mark.parametrize(
    ("kind", "folder", "message"),
    [
        ("pipe", False, "device or a pipe"),
        ("file", True, "never replaces a file"),
        ("unrelated", False, "never replaces a folder"),
        ("", False, "never replaces a folder"),
        ("unrelated", True, "no manifest.json in it lists unrelated"),
        ("thesis", True, "isn't replaced, because .* lists thesis"),
    ],
)
def test_only_an_output_is_replaced(tmp_path: Path, kind: str, folder: bool, message: str) -> None:
    out = tmp_path / "out" if kind else Path()  # as `--out ''` gives it
    if kind:
        make(kind, out)
    with pytest.raises(Occupied, match=message):
        require_output(out, folder=folder, overwrite=True, reads=[])


@pytest.mark.parametrize("source", [".", "out", "out/part.h5", "linked"])
def test_an_output_is_apart_from_its_sources(tmp_path: Path, source: str) -> None:
    (tmp_path / "linked").symlink_to(tmp_path / "out")
    with pytest.raises(Occupied, match="is, contains or is in its source"):
        require_output(tmp_path / "out", folder=True, reads=[tmp_path / source])
