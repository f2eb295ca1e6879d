"""Training: the same bytes every time, broken off or not, and on nothing but train episodes."""

from __future__ import annotations

import csv
import json
import os
import shutil
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from ..small_job import knotgym
from .conftest import train_tiny

pytestmark = pytest.mark.clients
pytest.importorskip("torch")
pytest.importorskip("safetensors")


def weights(folder: Path) -> bytes:
    return (folder / "weights.safetensors").read_bytes()


def test_the_same_seed_and_data_give_the_same_weights(
    episodes: Path, learner: Path, tmp_path: Path
) -> None:
    train_tiny(episodes, tmp_path / "again")
    assert weights(tmp_path / "again") == weights(learner)


def test_another_seed_gives_others(episodes: Path, learner: Path, tmp_path: Path) -> None:
    train_tiny(episodes, tmp_path / "other", seed=1)
    assert weights(tmp_path / "other") != weights(learner)


def test_a_training_broken_off_and_resumed_ends_with_the_same_weights(
    episodes: Path, learner: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from knotgym.learn.reader_training import ReaderTraining

    advance = ReaderTraining.advance

    def break_off(training: ReaderTraining) -> None:
        if training.step == 3:  # one step after the last that was kept
            raise KeyboardInterrupt
        advance(training)

    monkeypatch.setattr(ReaderTraining, "advance", break_off)
    with pytest.raises(KeyboardInterrupt):
        train_tiny(episodes, tmp_path / "broken")
    monkeypatch.undo()
    assert not (tmp_path / "broken" / "weights.safetensors").exists()
    train_tiny(episodes, tmp_path / "broken", resume=True)
    assert weights(tmp_path / "broken") == weights(learner)


def test_the_curve_has_a_row_for_the_last_steps(learner: Path) -> None:
    with (learner / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows and {"step", "join", "correct"} == set(rows[0])
    assert (learner / "curve.png").stat().st_size > 0


def test_the_card_says_what_was_trained_on(learner: Path) -> None:
    card = json.loads((learner / "policy.json").read_text())
    assert card["episodes"] == 3 and card["config"]["steps"] == 6


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Type `knotgym train`, which must say one line and end with status 2."""
    assert knotgym("train", *arguments, "--quiet") == 2
    said = capsys.readouterr().err.strip()
    assert said.count("\n") == 0
    return said


def test_a_folder_in_use_is_refused(
    episodes: Path, learner: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "exists already" in refused(capsys, "--data", episodes, "--out", learner)


def test_resuming_another_training_names_what_differs(tmp_path: Path) -> None:
    training = pytest.importorskip("knotgym.learn.training")
    begun = {"config": {"steps": 6, "seed": 0}, "data_sha256": "ab"}
    (tmp_path / training.REQUEST).write_text(json.dumps(begun))
    asked = {"config": {"steps": 9, "seed": 0}, "data_sha256": "ab"}
    with pytest.raises(training.InvalidInput, match=r"config\.steps is 6 there and 9 here;"):
        training.begin_training(tmp_path, asked)


def test_a_missing_set_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "no episodes at" in refused(capsys, "--data", tmp_path / "no", "--out", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def copied(episodes: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A copy of the set, and its file."""
    copy = tmp_path / "copy"
    shutil.copytree(episodes, copy)
    return copy, copy / "data" / "main_data.hdf5"


def test_a_set_of_the_test_split_is_refused(
    episodes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, path = copied(episodes, tmp_path)
    with h5py.File(path, "a") as file:
        file.attrs["task"] = json.dumps({**json.loads(file.attrs["task"]), "split": "test"})
    assert "test split" in refused(capsys, "--data", copy, "--out", tmp_path / "new")


def test_a_prediction_is_of_the_forces_that_were_applied(episodes: Path, tmp_path: Path) -> None:
    from knotgym.learn.training_data import read_training_data

    copy, path = copied(episodes, tmp_path)
    with h5py.File(path, "a") as file:
        group = file[min(name for name in file if "actions" in file[name])]["infos"]
        group["force"][1], group["applied_share"][1] = group["force"][1] / 2, 0.5
        force = group["force"][1]
    data = read_training_data([copy], "mujoco")
    assert (data.forces == force).all(axis=1).any()


def test_an_empty_set_is_refused(
    episodes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, path = copied(episodes, tmp_path)
    with h5py.File(path, "a") as file:
        file.attrs["index"] = np.zeros((0, 2), dtype=np.int32)
        for name in list(file):
            del file[name]
    assert "has no episodes" in refused(capsys, "--data", copy, "--out", tmp_path / "new")


def test_a_truncated_set_is_refused(
    episodes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, path = copied(episodes, tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    assert "isn't a whole episode file" in refused(
        capsys, "--data", copy, "--out", tmp_path / "new"
    )


def test_a_set_of_another_rope_is_refused(
    episodes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, path = copied(episodes, tmp_path)
    with h5py.File(path, "a") as file:
        file.attrs["rope"] = "another"
    assert "made with rope another" in refused(capsys, "--data", copy, "--out", tmp_path / "new")


@pytest.mark.parametrize("learner", ["pictures", "clone"])
def test_a_set_of_another_engine_is_refused_unless_it_is_asked_for(
    learner: str, episodes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, path = copied(episodes, tmp_path)
    with h5py.File(path, "a") as file:
        file.attrs["task"] = json.dumps({**json.loads(file.attrs["task"]), "engine": "chain"})
    words = ("--learner", learner, "--out", tmp_path / "new", "--data")
    assert "made with engine chain" in refused(capsys, *words, copy)
    assert "made with engine mujoco" in refused(capsys, *words, episodes, "--engine", "chain")
    assert "no engine 'x'" in refused(capsys, *words, episodes, "--engine", "x")


def test_changed_arrays_are_not_gone_on_with(tmp_path: Path) -> None:
    import torch

    from knotgym.common.errors import InvalidInput
    from knotgym.learn import training

    path = tmp_path / training.UNDER_WAY
    (tmp_path / training.REQUEST).write_text("{}")
    training.keep_training(tmp_path, {"losses": torch.ones(64, 2)}, time.perf_counter() - 60)
    kept, began = training.begin_training(tmp_path, {})
    assert kept.keys() == {"losses"}
    assert time.perf_counter() - began > 60  # the time until it was interrupted counts
    raw = bytearray(path.read_bytes())
    raw[-50] ^= 1
    path.write_bytes(raw)
    with pytest.raises(InvalidInput, match="its checksum differs"):
        training.begin_training(tmp_path, {})
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(InvalidInput, match="isn't a regular file"):
        training.begin_training(tmp_path, {})
