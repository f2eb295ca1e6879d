"""Recordings: pulls in a few bytes a step, from which a set's arrays follow."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from knotgym.common import InvalidFile, InvalidInput, Stream
from knotgym.control import PolicyConfig, make_policy, rollouts
from knotgym.datasets import Episodes
from knotgym.envs import TaskConfig
from knotgym.generate.episode_configs import CollectConfig, SuiteConfig
from knotgym.generate.recordings import Recording, digests, first_difference, rebuilt

CONFIG = CollectConfig(
    task=TaskConfig(task="tie", nx=2, engine="chain", observation="state", horizon=15),
    policy=PolicyConfig(policy="expert"),
    episodes=3,
    dataset_id="knotgym/tie-nx2/expert-v0",
)


@pytest.fixture(scope="module")
def played() -> Episodes:
    seeds = [Stream.EPISODE.derived_seed(CONFIG.seed, number) for number in range(3)]
    return rollouts(make_policy(CONFIG.policy), CONFIG.task, seeds)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, played: Episodes) -> Path:
    path = tmp_path_factory.mktemp("recordings") / "recordings.h5"
    other = replace(CONFIG, dataset_id="knotgym/a-v0")
    both = [Recording.of(CONFIG, played), Recording.of(other, played.select([1]))]
    Recording.write_all(path, both)
    return path


def test_a_replay_gives_the_same_arrays(played: Episodes, path: Path) -> None:
    again = Episodes.of(rebuilt(CONFIG, range(3), path))
    assert played.differences(again) == []
    assert first_difference(again, Recording.read_all(path)[CONFIG.dataset_id]) is None
    part = Episodes.of(rebuilt(CONFIG, range(1, 3), path))
    assert played.select([1, 2]).differences(part) == []


def test_equal_recordings_give_equal_bytes(played: Episodes, path: Path, tmp_path: Path) -> None:
    Recording.write_all(tmp_path / "again.h5", [*Recording.read_all(path).values()][::-1])
    assert (tmp_path / "again.h5").read_bytes() == path.read_bytes()


def test_a_digest_is_of_contents_alone(played: Episodes) -> None:
    whole = digests(played)
    assert len(np.unique(whole, axis=0)) == 3
    assert (digests(played.select([2, 0])) == whole[[2, 0]]).all()
    moved = played.steps["observation"].copy()
    moved[played.offsets[1] + 2, 50, 0] += 1e-6
    changed = Episodes(played.episodes, played.steps.replaced(observation=moved))
    assert (digests(changed) == whole).all(axis=1).tolist() == [True, False, True]


@pytest.mark.parametrize("factor", [0.9, -1.0])  # -0.0, which no whole number gives
def test_only_quantized_pulls_are_recorded(factor: float, played: Episodes, path: Path) -> None:
    uneven = played.steps.replaced(force=played.steps["force"] * np.float32(factor))
    with pytest.raises(InvalidInput, match="can't be recorded"):
        Recording.of(CONFIG, Episodes(played.episodes, uneven))
    with pytest.raises(InvalidFile, match=r"is recorded with \d+ episodes, got 9"):
        rebuilt(replace(CONFIG, episodes=9), range(3, 9), path)


def test_damaged_recordings_are_refused(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.h5"
    copy.write_bytes(path.read_bytes())
    with h5py.File(copy, "r+") as file:
        file["episodes/length"][0] += 1
    with pytest.raises(InvalidFile, match="don't fit its pulls"):
        Recording.read_all(copy)


def test_the_ones_that_ship_are_of_the_suite() -> None:
    sets = {one.dataset_id: one for one in SuiteConfig().sets()}
    for name, one in Recording.read_all().items():
        # by the policy as it was when they were recorded
        own = replace(sets[name], episodes=one.config.episodes, policy=one.config.policy)
        assert one.config == own and one.episodes.episodes.rows == own.episodes
