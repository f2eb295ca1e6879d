"""A journal: what is kept is there after any kill, and nothing but a journal of the run is read."""

import errno
import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common import InvalidFile, InvalidInput, KnotgymError
from knotgym.runs.journal import Journal

RUN = {"config": {"seed": 0}}
RESULT: dict[str, Any] = {
    "whole": np.arange(7, dtype=np.uint16),
    "text": np.array(["a", "über"]),
    "none": np.empty((0, 3)),
    "one": np.float64(2.5),
    "bits": np.array([[True], [False]]),
}


def written(path: Path, keys: int = 3) -> bytes:
    with Journal(path, RUN) as journal:
        for key in range(keys):
            journal[f"part {key}"] = {"key": np.full(1000, key), **RESULT}
    return path.read_bytes()


def test_results_come_back_as_they_were_and_read_only(tmp_path: Path) -> None:
    written(tmp_path / "j")
    with Journal(tmp_path / "j", RUN) as journal:
        assert list(journal) == ["part 0", "part 1", "part 2"]
        for name, array in RESULT.items():
            found = journal["part 1"][name]
            assert found.dtype == array.dtype and found.shape == array.shape
            np.testing.assert_array_equal(found, array)
        assert not journal["part 2"]["key"].flags.writeable
        assert journal["part 0"]["whole"].ctypes.data % 64 == 0


def test_a_journal_cut_anywhere_keeps_its_whole_records(tmp_path: Path) -> None:
    whole, rng = written(tmp_path / "j"), random.Random(2)
    for cut in [0, 1, 17, 18, 19, *(rng.randrange(len(whole)) for _ in range(40)), len(whole) - 1]:
        (tmp_path / "j").write_bytes(whole[:cut])
        with Journal(tmp_path / "j", RUN) as journal:
            left = list(journal)
            assert left == [f"part {key}" for key in range(len(left))]
            for key in range(len(left), 3):
                journal[f"part {key}"] = {"key": np.full(1000, key), **RESULT}
        assert (tmp_path / "j").read_bytes() == whole
    changed = bytearray(whole)
    changed[-10_000] ^= 1  # takes its record and those after it
    (tmp_path / "j").write_bytes(changed)
    with Journal(tmp_path / "j", RUN) as journal:
        assert "part 2" not in journal and "part 0" in journal


def test_the_last_result_of_a_key_counts(tmp_path: Path) -> None:
    with Journal(tmp_path / "j", RUN) as journal:
        journal["a"] = {"x": np.zeros(3)}
        journal["a"] = {"x": np.ones(5)}
        assert journal["a"]["x"].tolist() == [1] * 5
    with Journal(tmp_path / "j", RUN) as journal:
        assert journal["a"]["x"].tolist() == [1] * 5


def test_other_journals_are_only_read(tmp_path: Path) -> None:
    before = written(tmp_path / "other")
    (tmp_path / "other").chmod(0o400)
    with Journal(tmp_path / "j", RUN, [tmp_path / "other"]) as journal:
        journal["part 9"] = RESULT
        assert "part 1" in journal and journal["part 1"]["key"][0] == 1
    assert (tmp_path / "other").read_bytes() == before


def test_the_journal_of_another_run_is_refused_and_left(tmp_path: Path) -> None:
    before = written(tmp_path / "j")
    other = {"config": {"seed": 1}}
    with pytest.raises(InvalidInput, match="seed is 0 there and 1 here"):
        Journal(tmp_path / "j", other)
    with pytest.raises(InvalidInput, match="seed is 0 there and 1 here"):
        Journal(tmp_path / "new", other, [tmp_path / "j"])
    assert (tmp_path / "j").read_bytes() == before


@pytest.mark.parametrize("more", [-129, -128, -127, -1, 0, 1, 127, 128])
def test_a_result_with_too_long_names_is_refused_or_comes_back(more: int, tmp_path: Path) -> None:
    line = '[{"columns": [["", "|u1", []]], "key": "a"}, 64]'
    name = "x" * (2**20 + more - len(line))
    with Journal(tmp_path / "j", RUN) as journal:
        try:
            journal["a"] = {name: np.array(3, np.uint8)}
        except InvalidInput:
            assert more > -128
        is_kept = "a" in journal
    with Journal(tmp_path / "j", RUN) as journal:
        assert ("a" in journal) == is_kept


def test_a_result_that_never_reaches_the_disk_is_not_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")  # which network disks say only here

    with Journal(tmp_path / "j", RUN) as journal, monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="quota"):
            journal["a"] = RESULT
        assert "a" not in journal


def test_objects_are_not_kept(tmp_path: Path) -> None:
    with Journal(tmp_path / "j", RUN) as journal, pytest.raises(InvalidInput, match="not objects"):
        journal["a"] = {"x": np.array([object()])}


def record(head: str, size: int = 0, content: bytes = b"") -> bytes:
    from zlib import crc32

    line = f"[{head}, {size}]".encode()
    return b"%08x %s\n" % (crc32(content, crc32(line)), line) + content


@pytest.mark.parametrize(
    "content",
    [
        b"hello\n",
        b"\x89HDF\r\n\x1a\n",
        b"knotgym journal 1\n" + record("{}"),
        b"knotgym journal 1\n" + record('{"run": 3}'),
        b"knotgym journal 1\nnonsense\n",
        b"knotgym journal 1\n" + record("5"),
        *(
            b"knotgym journal 1\n"
            + record('{"run": {"config": {"seed": 0}}}')
            + record(head, 64, bytes(64))
            for head in (
                "{}",
                '{"key": 3, "columns": [["x", "<f8", [8]]]}',
                '{"key": "a", "columns": [["x", "|O", [8]]]}',
                '{"key": "a", "columns": [["x", "<f8", [80]]]}',
                '{"key": "a", "columns": [["x", "<f8", [-8]]]}',
                '{"key": "a", "columns": [["x", "f8,O", [8]]]}',
                '{"key": "a", "columns": [["x", "<f8", [0, 15292150460684697]], ["", "<f8", [8]]]}',
                '{"key": "a", "columns": 5}',
            )
        ),
    ],
)  # fmt: skip
def test_what_no_run_writes_is_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "j").write_bytes(content)
    with pytest.raises((InvalidFile, InvalidInput)) as caught:
        Journal(tmp_path / "j", RUN)
    assert "\n" not in str(caught.value)
    assert (tmp_path / "j").read_bytes() == content


@pytest.mark.parametrize("kind", ["a link", "a pipe", "a folder"])
def test_a_path_that_is_no_file_is_one_line(kind: str, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    if kind == "a link":
        (tmp_path / "j").symlink_to(tmp_path / "mine")
    elif kind == "a pipe":
        os.mkfifo(tmp_path / "j")
    else:
        (tmp_path / "j").mkdir()
    with pytest.raises(KnotgymError, match="should be a file; remove it"):
        Journal(tmp_path / "j", RUN)
    assert (tmp_path / "mine").read_text() == "mine"
