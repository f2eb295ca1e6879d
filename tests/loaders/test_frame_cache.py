"""Pictures kept uncompressed: the same to the byte as those read plainly, never of another set."""

from __future__ import annotations

import importlib.util
import io
import json
import os
import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common.atomic_files import Unwritable
from knotgym.datasets.episode_reader import Chosen
from knotgym.datasets.episode_writer import EpisodeWriter, merge_episodes
from knotgym.datasets.trajectory import Episode
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import FrameCache, NoCache, Transitions, arrays, torch_dataset
from knotgym.rendering.picture import PictureConfig
from knotgym.rope.model import Rope
from knotgym.topology.crossings import label

from ..conftest import curled

STEPS = (1, 4, 3, 2)
TASK = TaskConfig(task="tie", observation="both", image_size=16, horizon=9)
VARIANTS = {
    "stored": TASK,
    "stacked": replace(TASK, observation="pixels", layout="stacked"),
    "views with depth": replace(TASK, observation="pixels", views=("top", "left"), depth=True),
    "drawn": TASK,
}


def episode(rope: Rope, k: int) -> Episode:
    """Ropes with ever other curls; two episodes share each goal."""
    steps = STEPS[k]
    points = np.stack(
        [rope.from_curve(curled((k + step) % 3, 0.1 * (k + step))) for step in range(steps + 1)]
    )
    codes = [label(one) for one in points]
    last = np.arange(steps) == steps - 1
    return Episode(
        start_qpos=rope.qpos(points[0]),
        points=points,
        goal_points=rope.from_curve(curled(2, 0.3 * (k % 2))),
        actions=np.full((steps, 6), k / 8, dtype=np.float32),
        rewards=np.arange(steps, dtype=np.float64) + 10.0 * k,
        terminations=last & (k % 2 == 0),
        truncations=last & (k % 2 == 1),
        gauss_code=np.array([str(code) for code in codes]),
        gauss_code_chiral=np.array([code.chiral for code in codes]),
        crossings=np.array([code.nx for code in codes]),
        bead=np.full(steps + 1, 3),
        force=np.zeros((steps + 1, 3)),
        applied_share=np.ones(steps + 1),
        is_success=np.zeros(steps + 1, dtype=bool),
        simulation_failed=np.zeros(steps + 1, dtype=bool),
        goal_gauss_code="1+,2-,1-,2+",
        policy="by hand",
    )


@pytest.fixture(scope="module")
def files(rope: Rope, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    room = tmp_path_factory.mktemp("episodes")
    made = {}
    for name, task in VARIANTS.items():
        made[name] = room / f"{name}.h5"
        with EpisodeWriter(made[name], task) as writer:
            for k in range(len(STEPS)):
                writer.add(episode(rope, k))
    made["drawn"].unlink()
    merge_episodes([made["stored"]], made["drawn"], store="none")
    return made


def npy(array: Any) -> bytes:
    """An array as a file."""
    written = io.BytesIO()
    np.save(written, array)
    return written.getvalue()


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    return one.dtype == other.dtype and np.array_equal(one, other)


@pytest.mark.parametrize("relabel", [None, "last", "all"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_pictures_are_those_that_are_read_plainly(
    variant: str, relabel: str | None, files: dict[str, Path], tmp_path: Path
) -> None:
    chosen: dict[str, Any] = {"observation": "pixels", "relabel": relabel}
    assert same(arrays(files[variant], **chosen, cache=tmp_path), arrays(files[variant], **chosen))


def test_both_have_their_state_too(files: dict[str, Path], tmp_path: Path) -> None:
    assert same(arrays(files["stored"], cache=tmp_path), arrays(files["stored"]))


@pytest.mark.parametrize("observation", ["pixels", "state", "both", "symbolic"])
@pytest.mark.parametrize("cached", [False, True])
def test_a_batch_is_those_rows_of_the_arrays(
    cached: bool, observation: str, files: dict[str, Path], tmp_path: Path
) -> None:
    if cached and observation in ("state", "symbolic"):
        with pytest.raises(NoCache, match=f"observation '{observation}' shows none"):
            arrays(files["stored"], observation=observation, cache=tmp_path)
        return
    rows = [3, 0, 9, 3, -1]
    read = Transitions(files["stored"], observation=observation, cache=tmp_path if cached else None)
    whole: Any = arrays(files["stored"], observation=observation)
    expected: Any = {
        name: {key: seen[rows] for key, seen in value.items()}
        if isinstance(value, dict)
        else value[rows]
        for name, value in whole.items()
    }
    assert same(read.batch(rows), expected)
    parts = read.batch(rows, apart=True)
    seen, axis = ("observations", "next_observations"), {"pixels": 2}
    for name in seen:
        kinds = expected[name] if observation == "both" else {observation: expected[name]}
        ropes = parts[name] if observation == "both" else {observation: parts[name]}
        goals = parts["goals"] if observation == "both" else {observation: parts["goals"]}
        for kind, whole_picture in kinds.items():
            beside = np.concatenate([ropes[kind], goals[kind]], axis=axis.get(kind, 1))
            assert np.array_equal(beside, whole_picture)
    for wrong in ([10], [-11], [], [[1]]):
        with pytest.raises(IndexError):
            read.batch(wrong)


@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="torch isn't installed")
def test_a_loader_of_batches_gives_what_single_items_give(
    files: dict[str, Path], tmp_path: Path
) -> None:
    import torch

    data = torch_dataset(files["drawn"], observation="pixels", cache=tmp_path)
    sampler = torch.utils.data.BatchSampler(torch.utils.data.SequentialSampler(data), 4, False)
    several = next(iter(torch.utils.data.DataLoader(data, sampler=sampler, batch_size=None)))
    single = torch.utils.data.default_collate([data[k] for k in range(4)])
    assert several.keys() == single.keys()
    assert all(torch.equal(several[name], single[name]) for name in single)
    assert all(several[name].dtype == single[name].dtype for name in single)


def test_every_picture_is_kept_once_and_read_by_who_comes_later(
    files: dict[str, Path], tmp_path: Path
) -> None:
    first = Transitions(files["stored"], cache=tmp_path)
    (place,) = tmp_path.iterdir()
    written = (place / "frames.bin").stat()
    states = sum(STEPS) + len(STEPS)
    assert written.st_size == (states + 2) * 16 * 16 * 3  # the goals are two
    again = pickle.loads(pickle.dumps(Transitions(files["stored"], cache=str(tmp_path))))
    assert same(again.batch([5]), first.batch([5]))
    assert (place / "frames.bin").stat().st_mtime_ns == written.st_mtime_ns


def test_another_picture_or_dataset_or_choice_has_pictures_of_its_own(
    files: dict[str, Path], tmp_path: Path
) -> None:
    pixels: dict[str, Any] = {"observation": "pixels", "cache": tmp_path}
    large = arrays(files["stored"], picture=PictureConfig(size=24), **pixels)
    assert large["observations"].shape[1:] == (24, 48, 3)
    some = arrays(Chosen(files["stored"], [2]), **pixels)
    assert same(some, arrays(Chosen(files["stored"], [2]), observation="pixels"))
    arrays(files["views with depth"], **pixels)
    assert len(list(tmp_path.iterdir())) == 3


def test_spoilt_pictures_are_made_anew_and_gone_ones_are_told_of(
    files: dict[str, Path], tmp_path: Path
) -> None:
    plain = arrays(files["drawn"], observation="pixels")
    held = Transitions(files["drawn"], observation="pixels", cache=tmp_path)
    (place,) = tmp_path.iterdir()
    os.truncate(place / "frames.bin", 100)
    with pytest.raises(NoCache, match="gone or spoilt: open the dataset anew"):
        held.batch([0])
    assert same(arrays(files["drawn"], observation="pixels", cache=tmp_path), plain)
    goals = np.load(place / "goals.npy")
    shape = json.loads((place / "made.json").read_text())["shape"]
    for name, content in (
        ("made.json", b"[]"),
        ("made.json", json.dumps({"shape": [str(size) for size in shape]}).encode()),
        ("made.json", json.dumps({"shape": [-size for size in shape]}).encode()),
        ("goals.npy", b"\x93NUMPY"),
        ("goals.npy", npy(goals + shape[0])),
        ("goals.npy", npy(goals[::-1])),
        ("goals.npy", npy(goals.astype(np.float64))),
    ):
        (place / name).write_bytes(content)
        assert same(arrays(files["drawn"], observation="pixels", cache=tmp_path), plain)


def test_a_making_that_is_cut_short_leaves_nothing(
    files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(np, "save", cut)
        Transitions(files["stored"], cache=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_what_was_used_longest_ago_makes_room(files: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("not the cache's")
    sizes: dict[int, Path] = {}
    for size in (16, 17, 18):
        before = {*tmp_path.iterdir()}
        limit = FrameCache(tmp_path, limit=35_000)
        picture = PictureConfig(size=size)
        Transitions(files["stored"], observation="pixels", picture=picture, cache=limit)
        (sizes[size],) = {*tmp_path.iterdir()} - before
        os.utime(sizes[size], (size, size))
        if size == 17:  # the first is used once more
            Transitions(
                files["stored"],
                observation="pixels",
                picture=PictureConfig(size=16),
                cache=limit,
            )
    assert {*tmp_path.iterdir()} == {sizes[16], sizes[18], tmp_path / "mine"}


def test_no_room_is_one_line(
    files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(NoCache, match="more than the cache may hold, 0.0 GB: raise its limit"):
        Transitions(files["stored"], cache=FrameCache(tmp_path, limit=10))
    with pytest.raises(NoCache, match="a number of bytes above 0, got 0"):
        FrameCache(tmp_path, limit=0)
    usage = type("Usage", (), {"total": 10**6, "free": 50_000})
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with pytest.raises(NoCache, match="a twentieth of the disk stays free"):
        Transitions(files["stored"], cache=tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(Unwritable, match="pictures can't be kept at"):
        Transitions(files["stored"], cache=tmp_path / "file")


def test_what_the_key_says_stands_beside_the_pictures(
    files: dict[str, Path], tmp_path: Path
) -> None:
    Transitions(files["stored"], cache=tmp_path)
    (place,) = tmp_path.iterdir()
    made = json.loads((place / "made.json").read_text())
    assert made["picture"]["size"] == 16 and not made["drawn"] and len(made["sha256"]) == 64
