"""Cached pictures equal those read without a cache, byte for byte."""

from __future__ import annotations

import importlib.util
import os
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common.errors import Failed, InvalidInput
from knotgym.datasets.episode_reader import Chosen, EpisodeReader
from knotgym.datasets.episode_writer import EpisodeWriter, merge_episodes
from knotgym.datasets.trajectory import Episode
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import FrameCache, Transitions, arrays, torch_dataset
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
    """Ropes with a different curl in every state; pairs of episodes share a goal."""
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
        with pytest.raises(InvalidInput, match=f"observation '{observation}' has none"):
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


def test_every_picture_is_kept_once_and_read_by_later_processes(
    files: dict[str, Path], tmp_path: Path
) -> None:
    first = Transitions(files["stored"], cache=tmp_path)
    (kept,) = tmp_path.iterdir()
    written = kept.stat()
    states_and_goals = sum(STEPS) + 2 * len(STEPS)
    assert written.st_size == states_and_goals * 16 * 16 * 3
    again = pickle.loads(pickle.dumps(Transitions(files["stored"], cache=str(tmp_path))))
    assert same(again.batch([5]), first.batch([5]))
    assert kept.stat().st_ino == written.st_ino  # the same file, not a new one of its name


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


@pytest.mark.parametrize("size", [0, 100, 100_000])
def test_a_file_of_the_wrong_size_is_written_again(
    size: int, files: dict[str, Path], tmp_path: Path
) -> None:
    plain = arrays(files["drawn"], observation="pixels")
    arrays(files["drawn"], observation="pixels", cache=tmp_path)
    (kept,) = tmp_path.iterdir()
    os.truncate(kept, size)
    assert same(arrays(files["drawn"], observation="pixels", cache=tmp_path), plain)


@pytest.mark.parametrize("damage", [lambda path: os.truncate(path, 100), os.unlink])
def test_a_file_that_is_lost_before_it_is_mapped_is_one_line(
    damage: Any, files: dict[str, Path], tmp_path: Path
) -> None:
    held = Transitions(files["drawn"], observation="pixels", cache=tmp_path)
    (kept,) = tmp_path.iterdir()
    damage(kept)
    with pytest.raises(InvalidInput, match="missing or truncated: open the dataset again"):
        held.batch([0])


def test_a_link_in_the_place_of_a_file_is_not_followed(
    files: dict[str, Path], tmp_path: Path
) -> None:
    held = Transitions(files["drawn"], observation="pixels", cache=tmp_path)
    (kept,) = tmp_path.iterdir()
    elsewhere = kept.rename(tmp_path / "elsewhere")
    kept.symlink_to(elsewhere)
    with pytest.raises(InvalidInput, match="is a link"):
        held.batch([0])
    with pytest.raises(InvalidInput, match="is a link"):
        Transitions(files["drawn"], observation="pixels", cache=tmp_path)
    other = PictureConfig(size=17)
    cache = FrameCache(tmp_path, limit=20_000)  # room for one of the two
    Transitions(files["drawn"], observation="pixels", picture=other, cache=cache)
    assert kept.is_symlink() and elsewhere.is_file()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
def test_a_file_of_another_user_is_refused(files: dict[str, Path], tmp_path: Path) -> None:
    Transitions(files["drawn"], observation="pixels", cache=tmp_path)
    (kept,) = tmp_path.iterdir()
    os.chown(kept, 12345, 12345)
    with pytest.raises(InvalidInput, match="belongs to another user"):
        Transitions(files["drawn"], observation="pixels", cache=tmp_path)


def test_an_interrupted_write_leaves_nothing(
    files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = EpisodeReader.observations

    def interrupted(reader: EpisodeReader, index: int, *rest: Any, **options: Any) -> Any:
        if index:
            raise KeyboardInterrupt
        return read(reader, index, *rest, **options)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(EpisodeReader, "observations", interrupted)
        Transitions(files["stored"], cache=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_least_recently_used_file_makes_room(files: dict[str, Path], tmp_path: Path) -> None:
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


def test_no_room_is_one_line(files: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(
        InvalidInput, match="more than the cache's limit of 0.0 GB: raise the limit"
    ):
        Transitions(files["stored"], cache=FrameCache(tmp_path, limit=10))
    with pytest.raises(InvalidInput, match="a number of bytes above 0, got 0"):
        FrameCache(tmp_path, limit=0)
    (tmp_path / "file").write_text("")
    with pytest.raises(Failed, match="can't write pictures to"):
        Transitions(files["stored"], cache=tmp_path / "file")
