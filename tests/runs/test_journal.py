"""A journal: what is kept is there after any kill, and nothing but a journal of the run is read."""

import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common import InvalidFile, InvalidInput, KnotgymError, Occupied
from knotgym.runs.journal import Journal

from ..small_job import full_disk

RUN = {"config": {"seed": 0}}
RESULT: dict[str, Any] = {
    "whole": np.arange(7, dtype=np.uint16),
    "steps/text": np.array(["a", "über"]),
    "none": np.empty((0, 3)),
    "one": np.float64(2.5),
    "bits": np.array([[True], [False]]),
    "turned": np.arange(6.0).reshape(2, 3).T,
    "file": np.arange(100_000, dtype=np.float32).reshape(100, 10, 100),
}


def written(path: Path, keys: int = 3) -> dict[str, bytes]:
    with Journal(path, RUN) as journal:
        for key in range(keys):
            journal[f"part {key}"] = {"key": np.full(1000, key), **RESULT}
    return content(path)


def content(path: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in path.iterdir()}


def test_results_come_back_as_they_were_and_read_only(tmp_path: Path) -> None:
    written(tmp_path / "j")
    with Journal(tmp_path / "j", RUN) as journal:
        assert list(journal) == ["part 0", "part 1", "part 2"]
        assert list(journal["part 1"]) == ["key", *RESULT]
        for name, array in RESULT.items():
            found = journal["part 1"][name]
            assert found.dtype == array.dtype and found.shape == array.shape
            np.testing.assert_array_equal(found, array)
            assert not found.flags.writeable and found.flags.aligned
        journal["new"] = {"x": np.arange(3.0)}
        assert not journal["new"]["x"].flags.writeable
    record = np.load(tmp_path / "j/part 1.npy")  # a plain file of NumPy's
    np.testing.assert_array_equal(record["file"], RESULT["file"])


def test_any_key_is_kept_inside_the_folder(tmp_path: Path) -> None:
    keys = ["../out", ".part", "run.json", "a/b", "request 1 0:0f", "%2F", "über", "", "checkpoint"]
    with Journal(tmp_path / "j", RUN) as journal:
        for number, key in enumerate(keys):
            journal[key] = {"x": np.array(number)}
    with Journal(tmp_path / "j", RUN) as journal:
        assert {key: int(journal[key]["x"]) for key in journal} == {
            key: number for number, key in enumerate(keys)
        }
    assert list(tmp_path.iterdir()) == [tmp_path / "j"]


def test_a_result_that_is_cut_or_changed_anywhere_is_missing(tmp_path: Path) -> None:
    whole, rng = written(tmp_path / "j"), random.Random(2)
    size = len(whole["part 1.npy"])
    for at in [0, 1, *(rng.randrange(size) for _ in range(60)), size - 1]:
        changed = bytearray(whole["part 1.npy"])
        changed[at] ^= 1 << rng.randrange(8)
        for damaged in (whole["part 1.npy"][:at], bytes(changed)):
            (tmp_path / "j/part 1.npy").write_bytes(damaged)
            with Journal(tmp_path / "j", RUN) as journal:
                assert "part 0" in journal
                assert "part 1" not in journal
                journal["part 1"] = {"key": np.full(1000, 1), **RESULT}
            assert content(tmp_path / "j") == whole


def test_the_last_result_of_a_key_counts_and_one_can_be_forgotten(tmp_path: Path) -> None:
    with Journal(tmp_path / "j", RUN) as journal:
        journal["a"] = {"x": np.zeros(3)}
        journal["a"] = {"x": np.ones(5)}
        assert journal["a"]["x"].tolist() == [1] * 5
    with Journal(tmp_path / "j", RUN) as journal:
        assert journal["a"]["x"].tolist() == [1] * 5 and not journal.is_empty
        del journal["a"], journal["never"]
        assert "a" not in journal and journal.is_empty


def test_other_journals_are_only_read(tmp_path: Path) -> None:
    before = written(tmp_path / "other")
    for file in (tmp_path / "other").iterdir():
        file.chmod(0o400)
    (tmp_path / "other").chmod(0o500)
    with Journal(tmp_path / "j", RUN, [tmp_path / "other"]) as journal:
        journal["part 9"] = RESULT
        assert "part 1" in journal and journal["part 1"]["key"][0] == 1 and len(journal) == 4
    assert content(tmp_path / "other") == before
    (tmp_path / "other").chmod(0o700)


def test_the_journal_of_another_run_is_refused_and_left(tmp_path: Path) -> None:
    before = written(tmp_path / "j")
    other = {"config": {"seed": 1}}
    with pytest.raises(InvalidInput, match="seed is 0 there and 1 here"):
        Journal(tmp_path / "j", other)
    with pytest.raises(InvalidInput, match="seed is 0 there and 1 here"):
        Journal(tmp_path / "new", other, [tmp_path / "j"])
    assert content(tmp_path / "j") == before and not (tmp_path / "new").exists()
    with pytest.raises(Occupied, match="--resume continues it, --restart deletes it"):
        Journal(tmp_path / "j", other, resume=False)
    with Journal(tmp_path / "j", other, resume=False, restart=True) as journal:
        assert journal.is_empty
    for run in ({"config": {"seed": 0, "note": "long" * 99}}, RUN, RUN):
        assert (
            Journal(tmp_path / "j", run).__enter__().is_empty
        )  # what holds no result is any run's


def test_a_result_that_does_not_reach_the_disk_is_not_counted_and_spoils_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Journal(tmp_path / "j", RUN) as journal:
        journal["a"] = {"x": np.zeros(3)}
        for broken in ("os.fsync", "knotgym.runs.journal.np.lib.format.write_array"):
            with monkeypatch.context() as patch:
                patch.setattr(broken, full_disk)
                for key in ("a", "b"):
                    with pytest.raises(OSError, match="No space"):
                        journal[key] = RESULT
            assert list(journal) == ["a"]
        journal["c"] = RESULT  # after room was made
    with Journal(tmp_path / "j", RUN) as journal:
        assert list(journal) == ["a", "c"] and journal["a"]["x"].tolist() == [0] * 3


def test_objects_are_not_kept(tmp_path: Path) -> None:
    with Journal(tmp_path / "j", RUN) as journal:
        for wrong in (np.array([object()]), np.zeros(2, "f8,i4"), np.zeros(2, "M8[s]")):
            with pytest.raises(InvalidInput, match="not objects"):
                journal["a"] = {"x": wrong}
        assert journal.is_empty


OLDER = b'{"format": "knotgym journal", "format_version": 1, "run": {"config": {"seed": 0}}}'


@pytest.mark.parametrize("head", [b"", b'{"run": 3}', OLDER, b"[" * 100_000, b"\x89HDF\r\n\x1a\n"])
def test_what_no_run_writes_is_one_line(head: bytes, tmp_path: Path) -> None:
    written(tmp_path / "j")
    (tmp_path / "j/run.json").write_bytes(head)
    before = content(tmp_path / "j")
    with pytest.raises((InvalidFile, InvalidInput)) as caught:
        Journal(tmp_path / "j", RUN)
    assert "\n" not in str(caught.value)
    assert content(tmp_path / "j") == before


@pytest.mark.parametrize("kind", ["a file", "a link", "a linked run", "a pipe", "an old journal"])
def test_a_path_that_is_no_folder_of_a_journal_is_one_line(kind: str, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/run.json").write_text("mine")
    path = tmp_path / "j"
    if kind == "a link":
        path.symlink_to(tmp_path / "mine")
    elif kind in ("a file", "an old journal"):
        path.write_bytes(b"knotgym journal 1\n")
    else:
        path.mkdir()
        if kind == "a pipe":
            os.mkfifo(path / "run.json")
        else:
            (path / "run.json").symlink_to(tmp_path / "mine/run.json")
    with pytest.raises(KnotgymError, match="should be the folder of a journal; remove it"):
        Journal(path, RUN)
    assert (tmp_path / "mine/run.json").read_text() == "mine"
