"""Tests of splits: planted leaks, mixed splits and duplicates are named, each with its episode."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from synthetic_episodes import TINY

from knotgym.common import Table
from knotgym.datasets.episode_dataset import EpisodeDataset, open_episodes
from knotgym.datasets.episode_verification import _duplicate_faults, _split_faults
from knotgym.datasets.row_verification import _demonstration_faults
from knotgym.states import States, read_states, shipped


@pytest.fixture(scope="module")
def states() -> States:
    return read_states(shipped(), images=False)


@pytest.fixture
def tiny() -> EpisodeDataset:
    """Three episodes that tie diagrams of nx 2, from the train split of the readable states."""
    return open_episodes(TINY["expert"])


def changed(dataset: EpisodeDataset, **columns: NDArray[np.generic]) -> EpisodeDataset:
    own = dataset.episodes.episodes.replaced(**columns)
    return replace(dataset, episodes=dataset.episodes._replace(episodes=own))


def faults(dataset: EpisodeDataset) -> list[str]:
    """List the faults of the splits, without the path."""
    return [fault.removeprefix(str(dataset.path)) for fault in _split_faults(dataset)]


def test_a_goal_of_another_split_or_row_is_named(tiny: EpisodeDataset, states: States) -> None:
    own, leaked = tiny.episodes.episodes, int(states.rows(2, "test")[0])
    goals, points = own["goal"].copy(), own["goal_points"].copy()
    goals[1:], points[1] = (leaked, 10**6), states.points[leaked]
    assert faults(changed(tiny, goal=goals, goal_points=points)) == [
        f", episode 1: its goal is row {leaked}, none of those of the train split",
        f", episode 2: its goal is row 1000000, of {len(states)} states",
    ]
    (fault, *_) = faults(changed(tiny, goal=np.roll(own["goal"], 1)))
    assert "its goal isn't row" in fault


def test_a_dataset_of_the_other_split_is_named_episode_by_episode(tiny: EpisodeDataset) -> None:
    other = replace(tiny, task=replace(tiny.task, split="test"))
    assert {fault.split(":")[0] for fault in faults(other)} == {f", episode {k}" for k in range(3)}


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_other_split_starts_are_named(tiny: EpisodeDataset, states: States, noise: float) -> None:
    row = int(states.rows(2, "test")[0])
    own, rng = tiny.episodes.episodes, np.random.default_rng(0)
    starts, laid = np.full(3, states.rows(2, "train")[0]), own["start_qpos"].copy()
    laid[:] = states.qpos[starts[0]]
    laid[1] = states.qpos[row] + rng.uniform(-noise, noise, laid.shape[1])
    untied = replace(tiny, task=replace(tiny.task, task="unknot"))
    loops = np.full(3, states.rows(0, "train")[0])
    points = states.points[loops].astype(np.float32)
    moved = changed(untied, start=starts, start_qpos=laid, goal=loops, goal_points=points)
    assert any(f"episode 1: its start is row {row}" in fault for fault in faults(moved))


def test_a_start_of_other_states_is_named(tiny: EpisodeDataset, states: States) -> None:
    """Earlier versions recorded play on two sets of states in one dataset."""
    bench = read_states("bench", images=False)
    laid = tiny.episodes.episodes["start_qpos"].copy()
    laid[1] = bench.qpos[bench.rows(2, "train")[0]]
    assert [fault[:12] for fault in faults(changed(tiny, start_qpos=laid))] == [", episode 1:"]


def test_the_same_pulls_twice_are_named_whatever_the_seed(tiny: EpisodeDataset) -> None:
    twice = tiny.select([0, 1, 1])
    seeds = changed(twice, seed=np.arange(3))
    (fault,) = _duplicate_faults(seeds)
    assert fault.endswith("episode 2: the same as episode 1, start, goal and pulls")
    silent = replace(seeds, task=replace(seeds.task, reset_noise=0.0))
    assert _duplicate_faults(silent) == []


def test_without_its_states_a_set_can_t_be_checked(tiny: EpisodeDataset, tmp_path: Path) -> None:
    named = replace(tiny, task=replace(tiny.task, states="gone.h5"), path=tmp_path / "e.h5")
    (fault,) = _split_faults(named)
    assert "its split can't be checked" in fault
    single = {"states_sha256": "0" * 64}  # an episode file by itself
    assert _split_faults(replace(named, attributes=single)) == []


# What states say of their demonstrations.


@pytest.fixture
def shown(tiny: EpisodeDataset, states: States) -> States:
    """The goals of the episodes as states that name them."""
    own = tiny.episodes.episodes
    some = states.take(own["goal"])
    named = {
        "source/dataset": np.full(3, tiny.name),
        "source/trajectory": np.arange(3),
        "source/step": own["length"],
        "source/policy": np.full(3, "drawing"),
        "source/steps": own["length"],
    }
    return States(Table(states.table.schema, {**some.table, **named}), states.attributes)


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        ({}, []),
        ({"source/trajectory": np.array([1, 7, 2])}, ["row 0: episode 1 of ", "row 1: episode 7 "]),
        ({"split": np.full(3, "test")}, [f"row {k}: episode {k} of " for k in range(3)]),
    ],
)
def test_a_row_that_its_demonstration_does_not_lead_to_is_a_fault(
    tiny: EpisodeDataset, shown: States, columns: dict[str, NDArray[np.generic]], says: list[str]
) -> None:
    found = [*_demonstration_faults(shown.replaced(columns), tiny.name, tiny)]
    for fault, begins in zip(found, says, strict=True):
        assert fault.startswith(f"states.h5 {begins}")
