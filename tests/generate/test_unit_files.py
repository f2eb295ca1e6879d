"""Walks kept in files are those that were made, or are made anew."""

import os
from pathlib import Path

import numpy as np
import pytest

from knotgym.common.errors import InvalidFile
from knotgym.generate.images import unit_files
from knotgym.generate.images.unit_files import UnitFile, load_frames, walked
from knotgym.generate.images.walks import WalkFrames

FRAMES = WalkFrames(
    points=np.zeros((2, 3, 3)),
    walk=np.arange(2),
    steps=np.arange(2),
    rounds=np.arange(2),
    ease=np.zeros(2),
    number=np.arange(1),
    start=np.arange(1),
    beads=np.zeros((1, 4), np.int16),
    forces=np.zeros((1, 4, 3), np.float32),
    dropped={"near": 3},
)


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> UnitFile:
    monkeypatch.setattr(unit_files, "make_walks", lambda unit: FRAMES)
    unit = UnitFile(tmp_path / "0.npz", None)  # type: ignore[arg-type]
    walked(unit)
    return unit


def test_walks_come_back(work: UnitFile) -> None:
    again = vars(load_frames(work.path))
    assert all(np.array_equal(again[name], own) for name, own in vars(FRAMES).items())


@pytest.mark.parametrize("at", [26, 200, -30])  # of a name, of values, of the list of names
def test_a_changed_byte_is_refused_and_the_walks_are_made_anew(at: int, work: UnitFile) -> None:
    sound = work.path.read_bytes()
    spoilt = bytearray(sound)
    spoilt[at] ^= 255
    work.path.write_bytes(spoilt)
    with pytest.raises(InvalidFile):
        load_frames(work.path)
    assert walked(work).read_bytes() == sound


def test_a_pipe_is_not_opened_and_other_columns_are_refused(work: UnitFile) -> None:
    with np.load(work.path) as file:
        columns = dict(file)
    np.savez(work.path, **{**columns, "frames.walk": np.zeros(2)})
    with pytest.raises(InvalidFile, match="walk is float64, should be int64"):
        load_frames(work.path)
    work.path.unlink()
    os.mkfifo(work.path)
    walked(work)
    assert work.path.is_file()
