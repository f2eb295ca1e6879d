"""Tests of `knotgym.datasets.episode_dataset`: files of episodes, and what they refuse."""

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from pytest_types import Patch
from synthetic_episodes import TASK, episodes, written

from knotgym.common import InvalidFile, InvalidInput, MissingFile, Table, sha256
from knotgym.datasets import Episodes, locate
from knotgym.datasets.episode_dataset import (
    _digests_of,
    columns_of,
    episode_file,
    open_episodes,
    write_episodes,
)
from knotgym.datasets.episodes import RECORDED
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.rope import quantized


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("episodes") / "a.h5", episodes([3, 1, 4]))


@pytest.mark.parametrize("pack", [False, True])
def test_what_is_written_is_read(tmp_path: Path, pack: bool) -> None:
    made = episodes([3, 1])
    write_episodes(tmp_path / "a.h5", [made], TASK, {"run": {"seed": 3}}, pack=pack)
    read = open_episodes(tmp_path / "a.h5")
    assert made.differences(read.episodes) == []
    assert made.episodes.keys() == read.episodes.episodes.keys()
    assert made.steps.keys() == read.episodes.steps.keys()
    assert read.task == TASK and read.facts["run"] == {"seed": 3}


def test_parts_give_the_same_bytes_as_the_whole(tmp_path: Path) -> None:
    made = episodes([3, 1, 2])
    written(tmp_path / "whole.h5", made)
    write_episodes(tmp_path / "parts.h5", [made.select([0]), made.select([1, 2])], TASK)
    assert (tmp_path / "whole.h5").read_bytes() == (tmp_path / "parts.h5").read_bytes()


def test_a_recording_is_read_as_one_and_has_the_same_digest(tmp_path: Path, file: Path) -> None:
    recording = open_episodes(file).episodes.recording()
    written(tmp_path / "r.h5", recording)
    read = open_episodes(tmp_path / "r.h5")
    assert read.episodes.is_recording and read.attributes["form"] == "recording"
    assert read.attributes["digest"] == open_episodes(file).attributes["digest"]
    with pytest.raises(InvalidInput, match="is a recording"):
        columns_of(tmp_path / "r.h5")


def test_a_recording_stores_quantized_forces_in_bytes_and_others_exactly(tmp_path: Path) -> None:
    made = episodes([3, 1]).recording()
    force = quantized(made.steps["force"]).astype(np.float32)
    whole = made._replace(steps=made.steps.replaced(force=force))
    force = np.where(force == 0, np.float32(-0.0), force)
    signed = made._replace(steps=made.steps.replaced(force=force))
    for given, kept in ((made, "force"), (whole, "force_bins"), (signed, "force")):
        path = written(tmp_path / "r.h5", given)
        with h5py.File(path) as file:
            assert {*file["steps"]} == {"bead", kept}
        assert given.differences(open_episodes(path).episodes) == []
    with h5py.File(written(path, whole), "r+") as file:
        del file["steps/force_bins"]
    with pytest.raises(InvalidFile, match="has no forces"):
        open_episodes(path)


def test_a_recording_leaves_out_the_starts_that_seeds_draw(tmp_path: Path) -> None:
    task, seeds = TaskConfig(task="tie", engine="chain"), [3, 4, -1]
    drawn = EpisodeBatch(task).drawn([3, 4, 5])
    starts = drawn["start_qpos"].copy()
    starts[1, 0] += 1e-3
    own = {"seed": np.array(seeds), "start_qpos": starts}
    rows = Table(RECORDED, {**episodes([1, 1, 1]).episodes, **own})
    made = Episodes(rows, episodes([1, 1, 1]).recording().steps)
    path = written(tmp_path / "r.h5", made, task)
    with h5py.File(path) as file:
        assert file["episodes/start_qpos"][()].any(axis=1).tolist() == [False, True, True]
    assert made.differences(open_episodes(path).episodes) == []


def test_a_pickled_dataset_keeps_its_selection_and_no_data(file: Path) -> None:
    chosen = open_episodes(file).select([2, 0]).select([1])
    stored = pickle.dumps(chosen)
    again = pickle.loads(stored)
    assert len(stored) < 1000 and again.rows.tolist() == [0]
    assert chosen.episodes.differences(again.episodes) == []
    whole = open_episodes(file)
    drawn = [whole.drawn(sample).episodes.episodes.rows for sample in (0, 1, 2, 3, 9)]
    assert drawn == [3, 1, 2, 3, 3]


def test_the_digest_follows_the_pulls_alone() -> None:
    made = episodes([3])
    moved = made.steps["observation"] + 1
    force = made.steps["force"] / 2
    digests = [
        _digests_of([made._replace(steps=made.steps.replaced(**changed))])["digest"]
        for changed in ({}, {"observation": moved}, {"force": force})
    ]
    assert digests[0] == digests[1] != digests[2]


def test_a_dataset_is_found_by_file_by_folder_and_by_id(tmp_path: Path, monkeypatch: Patch) -> None:
    data = tmp_path / "root/knotgym/tie-nx2/expert-v0/data"
    data.mkdir(parents=True)
    made = written(data / "episodes.h5", episodes([1]))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "root"))
    around = data.parents[2], tmp_path / "root"  # any folder that holds one
    for source in (made, data, data.parent, "knotgym/tie-nx2/expert-v0", *around):
        assert episode_file(source) == made
        (one,) = locate(str(source)).episodes
        assert episode_file(one) == made
    for number in range(7):
        (data.parents[1] / f"other{number}/data").mkdir(parents=True)
        written(data.parents[1] / f"other{number}/data/episodes.h5", episodes([1]))
    with pytest.raises(InvalidFile, match="several datasets; choose one of them: .* and 3 more"):
        episode_file(tmp_path / "root")


@pytest.mark.parametrize("named", ["{root}/private.h5", "a/../../private.h5", "a/b-v0", "../x"])
def test_states_are_found_by_digest_alone(named: str, tmp_path: Path, monkeypatch: Patch) -> None:
    root, private = tmp_path / "root", tmp_path / "private.h5"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    private.write_bytes(b"private")
    facts = {"states_sha256": sha256(private)}
    data = root / "a" / "c-v0" / "data"
    data.mkdir(parents=True)
    path, beside = data / "episodes.h5", data / "states.h5"
    write_episodes(path, [episodes([1])], replace(TASK, states=named.format(root=tmp_path)), facts)
    (root / "a" / "b-v0" / "data").mkdir(parents=True)
    (root / "a" / "b-v0" / "data" / "states.h5").symlink_to(private)
    with pytest.raises(MissingFile, match="put the state file"):
        open_episodes(path).states_path()
    beside.write_bytes(b"stray")
    with pytest.raises(InvalidFile, match="isn't the state file"):
        open_episodes(path).states_path()
    beside.write_bytes(b"private")
    assert open_episodes(path).states_path() == beside
    assert open_episodes(path).found_task.states == str(beside)


def attribute(name: str, old: str, new: str) -> Callable[[h5py.File], None]:
    return lambda file: file.attrs.__setitem__(
        name, np.bytes_(str(file.attrs[name].astype(str)).replace(old, new))
    )


@pytest.mark.parametrize(
    "harm",
    [
        lambda file: file["episodes/length"].__setitem__(0, 5),
        lambda file: file["episodes/length"].__setitem__(0, 2**62),
        attribute("task", '"tie"', '"fly"'),
        attribute("task", '"beads": 50', '"beads": 60'),
        attribute("task", '"horizon": ', '"horizon": 10000000'),  # no memory holds it
        attribute("form", "columns", "poem"),
    ],
)
def test_harm_is_one_line(file: Path, tmp_path: Path, harm: Callable[[h5py.File], None]) -> None:
    copy = tmp_path / "copy.h5"
    copy.write_bytes(file.read_bytes())
    with h5py.File(copy, "r+") as opened:
        harm(opened)
    with pytest.raises(InvalidFile) as caught:
        open_episodes(copy)
    assert "\n" not in str(caught.value) and str(copy) in str(caught.value)
