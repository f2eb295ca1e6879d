"""Tests of verification: every column of an episode file follows from its starts and pulls."""

from pathlib import Path
from re import findall

import h5py
import numpy as np
import pytest
from synthetic_episodes import TINY

import knotgym
from knotgym.common import Table
from knotgym.control import replay
from knotgym.datasets.episode_dataset import EpisodeDataset, open_episodes, write_episodes
from knotgym.datasets.episode_verification import episode_faults
from knotgym.datasets.episodes import STEPS, gauss_codes
from knotgym.datasets.summaries import show_episodes


@pytest.fixture(scope="module")
def good() -> EpisodeDataset:
    return open_episodes(TINY["expert"])


def test_a_drawn_part_is_checked_by_its_own_numbers(tmp_path: Path, good: EpisodeDataset) -> None:
    whole, path = good.episodes, tmp_path / "a.h5"
    wrong = whole.steps["reward"].copy()
    wrong[whole.offsets[:-1]] += 1  # in every episode
    write_episodes(path, [whole._replace(steps=whole.steps.replaced(reward=wrong))], good.task)
    named, drawn = (
        {
            int(k)
            for text in knotgym.verify(path, sample=n)
            for k in findall(r"episode (\d+),", text)
        }
        for n in (0, 2)
    )
    assert named == {*range(whole.episodes.rows)}
    assert len(drawn) == 2 and drawn < named
    assert knotgym.verify(TINY["expert"], sample=2) == []


RECOMPUTED = (
    "observation action reward terminated truncated applied_fraction visits signs crossings"
)
RECOMPUTED += " force bead success diverged return_ goal_points goal_visits goal start start_qpos"


@pytest.mark.parametrize(
    ("column", "value"),
    [
        *((name, None) for name in RECOMPUTED.split()),  # the smallest change
        *(("force", 2), ("observation", np.nan), ("goal", 10**6), ("start", -1)),
    ],
)
def test_changed_values_are_faults(
    tmp_path: Path, good: EpisodeDataset, column: str, value: float | None
) -> None:
    name = "steps" if column in good.episodes.steps else "episodes"
    table = getattr(good.episodes, name)
    values = table[column].copy()
    if value is None:
        values.view(np.uint8).flat[0] ^= 1
    else:
        values[0] = value
    harmed = good.episodes._replace(**{name: table.replaced(**{column: values})})
    write_episodes(tmp_path / "h.h5", [harmed], good.task)
    assert [*episode_faults(tmp_path / "h.h5", lambda episodes, task: good.episodes)]


@pytest.mark.parametrize(
    "column",
    [
        *(
            f"{one.schema.name}/{name}"
            for one in open_episodes(TINY["expert"]).episodes
            for name in one
        ),
        "steps/expert_action",
    ],
)
def test_every_stored_column_is_recomputed_or_under_a_digest(
    tmp_path: Path, good: EpisodeDataset, column: str
) -> None:
    steps = good.episodes.steps
    advised = {**steps, "expert_action": -steps["action"]}
    advised_steps = Table(STEPS.sized(**dict(steps.schema.sizes)), advised)
    labelled = good.episodes._replace(steps=advised_steps)
    write_episodes(tmp_path / "h.h5", [labelled], good.task)
    assert not [*episode_faults(tmp_path / "h.h5", lambda episodes, task: labelled)]
    with h5py.File(tmp_path / "h.h5", "r+") as file:
        values = file[column][:]
        if values.dtype.kind in "OS":
            values[0] = b"other!"[: values.dtype.itemsize]
        else:
            values.view(np.uint8).flat[0] ^= 1
        file[column][...] = values
    assert [*episode_faults(tmp_path / "h.h5", lambda episodes, task: labelled)]


def test_an_episode_twice_and_a_cut_file_are_faults(tmp_path: Path, good: EpisodeDataset) -> None:
    write_episodes(tmp_path / "h.h5", [good.episodes.select([0, 1, 0])], good.task)
    faults = [*episode_faults(tmp_path / "h.h5", replay)]
    assert [fault for fault in faults if "episode 2: the same as episode 0" in fault]
    (tmp_path / "h.h5").write_bytes(TINY["expert"].read_bytes()[:4000])
    assert len([*episode_faults(tmp_path / "h.h5", replay)]) == 1


def test_a_summary_says_how_many_situations_the_episodes_are(good: EpisodeDataset) -> None:
    twice = good.episodes.select([0, 1, 2, 0, 1, 2])
    starts = set(twice.episodes["start"].tolist())
    goals = {*gauss_codes(twice.episodes["goal_visits"]).tolist()}
    assert twice.distinct() == {"starts": len(starts), "goals": len(goals), "pairs": 3}
    found = show_episodes(TINY["expert"])
    assert (found["episodes"], found["success_rate"], found["form"]) == (3, 1.0, "columns")
    assert found["lengths"]["max"] == good.episodes.episodes["length"].max()
    assert found["policies"] == {"expert": 3} and found["distinct"] == twice.distinct()
