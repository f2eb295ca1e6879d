"""Episodes keep to their split: planted leaks, mis-splits and duplicates are named, each with its
episode; what `knotgym generate` writes has none.
"""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_verification import verify_episodes
from knotgym.datasets.episode_writer import EpisodeWriter, merge_episodes
from knotgym.datasets.split_verification import duplicate_faults, split_faults
from knotgym.datasets.state_verification import demonstration_faults, state_faults
from knotgym.datasets.trajectory import Episode
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import arrays
from knotgym.states.state_file import States, demonstrations_id, read_states


def ways(curated: Path, split: str) -> EpisodeReader:
    return EpisodeReader(curated / "minari" / demonstrations_id(1, split))


@pytest.fixture(scope="module")
def states(curated: Path) -> States:
    return read_states(curated / "states.h5", images=False)


@pytest.fixture(scope="module")
def train(curated: Path) -> list[Episode]:
    return list(ways(curated, "train"))


@pytest.fixture(scope="module")
def test(curated: Path) -> list[Episode]:
    return list(ways(curated, "test"))


def written(
    folder: Path, curated: Path, episodes: Sequence[Episode], task: TaskConfig | None = None
) -> EpisodeReader:
    """A train dataset of these episodes, without pictures, that carries its states."""
    (folder / "data").mkdir(parents=True)
    shutil.copy(curated / "states.h5", folder / "data")
    path = folder / "data" / "main_data.hdf5"
    with EpisodeWriter(path, task or ways(curated, "train").task, compact=True) as writer:
        for episode in episodes:
            writer.add(episode)
    return EpisodeReader(path)


def told(reader: EpisodeReader) -> list[str]:
    """The faults of the splits, without the path."""
    return [fault.removeprefix(str(reader.path)) for fault in split_faults(reader)]


def test_a_loader_gets_the_train_demonstrations_alone(curated: Path, train: list[Episode]) -> None:
    actions = [episode.actions for episode in train]
    loaded = arrays(curated / "minari/knotgym/tie-nx1/demonstrations-v0", observation="state")
    assert np.array_equal(loaded["actions"], np.concatenate(actions))


def test_a_leaked_episode_is_named_and_so_is_the_mix(
    curated: Path, states: States, train: list[Episode], test: list[Episode], tmp_path: Path
) -> None:
    reader = written(tmp_path, curated, [train[0], test[1], train[1]])
    row = states.rows(1, "test")[1]
    assert told(reader) == [
        f", episode 1: its goal is row {row} of the states, of the test split; the dataset says"
        " train",
        ": mixes splits, of starts or goals of episodes train: 0, 2; test: 1",
    ]
    assert [fault for fault in verify_episodes(reader.path) if "episode 1" in fault]


def test_a_whole_dataset_of_the_other_split_is_named_episode_by_episode(
    curated: Path, test: list[Episode], tmp_path: Path
) -> None:
    faults = told(written(tmp_path, curated, test))
    assert [fault[:12] for fault in faults] == [", episode 0:", ", episode 1:"]
    assert all("of the test split; the dataset says train" in fault for fault in faults)


def test_a_goal_that_was_moved_and_turned_is_still_known(
    curated: Path, train: list[Episode], test: list[Episode], tmp_path: Path
) -> None:
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = replace(test[0], goal_points=test[0].goal_points @ turn + 0.01)
    assert "of the test split" in told(written(tmp_path, curated, [train[0], moved]))[0]


@pytest.mark.parametrize("shift", [0.0, 0.003])
def test_a_start_of_the_other_split_is_named(
    curated: Path, states: States, train: list[Episode], tmp_path: Path, shift: float
) -> None:
    own, other = states.rows(0, "train")[0], states.rows(0, "test")[0]
    qpos = states.qpos.copy()
    qpos[:, 0] += shift
    task = replace(ways(curated, "train").task, reset_noise=0.015)
    leaked = [replace(train[0], start_qpos=qpos[row]) for row in (own, other)]
    (fault, mixed) = told(written(tmp_path, curated, leaked, task))
    assert fault.startswith(f", episode 1: its start is row {other} of the states, of the test")
    assert mixed.endswith("train: 0-1; test: 1")


def test_options_of_the_other_split_are_named(
    curated: Path, states: States, train: list[Episode], tmp_path: Path
) -> None:
    own, other = states.rows(1, "train")[0], states.rows(1, "test")[0]
    wrong: list[dict[str, int]] = [{"goal": int(own)}, {"goal": int(other)}, {"goal": 99}]
    wrong += [{"goal": int(own) + 1}, {"start": int(states.rows(0, "test")[0])}]
    reader = written(tmp_path, curated, [replace(train[0], options=one) for one in wrong])
    faults = "\n".join(told(reader))
    assert f"episode 1: options/goal is row {other}, of the test split" in faults
    assert "episode 2: its goal is row 99, of 8 states" in faults
    assert "episode 3: " in faults and "by its options, of the test split" in faults
    assert "episode 0" not in faults.replace("episodes", "")


def test_a_goal_that_is_not_the_row_of_its_options_is_named(
    curated: Path, states: States, train: list[Episode], tmp_path: Path
) -> None:
    first, second = states.rows(1, "train").tolist()
    lying = replace(train[0], options={"goal": second})
    assert told(written(tmp_path, curated, [lying])) == [
        f", episode 0: its goal isn't row {second}, as options/goal says"
    ]
    assert np.array_equal(train[0].goal_points, states.points[first])


def test_the_same_episode_twice_is_named_whatever_its_labels(
    curated: Path, train: list[Episode], tmp_path: Path
) -> None:
    again = replace(train[0], policy="another", seed=5)
    reader = written(tmp_path, curated, [*train, again])
    (fault,) = duplicate_faults(reader)
    assert "episode 2: the same as episode 0" in fault and fault in verify_episodes(reader.path)


def test_without_reset_noise_seeds_may_give_the_same_episode(
    curated: Path, train: list[Episode], tmp_path: Path
) -> None:
    task = replace(ways(curated, "train").task, reset_noise=0.0)
    seeds = [replace(train[0], seed=seed) for seed in (1, 2, 2)]
    (fault,) = duplicate_faults(written(tmp_path, curated, seeds, task))
    assert "episode 2: the same as episode 1" in fault


def test_a_set_merged_with_itself_is_named_episode_by_episode(
    curated: Path, tmp_path: Path
) -> None:
    both = [ways(curated, "train").path] * 2
    merge_episodes(both, tmp_path / "m.h5", store="none", concatenate=True)
    faults = duplicate_faults(EpisodeReader(tmp_path / "m.h5"))
    assert [fault.rpartition("m.h5")[2][:30] for fault in faults] == [
        ", episode 2: the same as episo",
        ", episode 3: the same as episo",
    ]


def test_a_dataset_whose_states_are_gone_cannot_be_checked(
    curated: Path, train: list[Episode], tmp_path: Path
) -> None:
    reader = written(tmp_path, curated, train)
    (tmp_path / "data" / "states.h5").unlink()
    assert split_faults(reader) == []  # an episode file by itself
    (tmp_path / "data" / "metadata.json").write_text("{}")
    (fault,) = split_faults(reader)
    assert "its split can't be checked: no state file at" in fault
    reader.task = replace(reader.task, states="../elsewhere.h5")
    (fault,) = split_faults(reader)
    assert "names states that lie outside the dataset, '../elsewhere.h5'" in fault


# What states say of their demonstrations.


def test_rows_name_the_episode_that_leads_to_them(curated: Path, states: States) -> None:
    for split in ("train", "test"):
        name = demonstrations_id(1, split)
        assert list(demonstration_faults(states, name, ways(curated, split))) == []


def test_a_row_that_names_another_episode_is_a_fault(curated: Path, states: States) -> None:
    first, second = states.rows(1, "train").tolist()
    named = {key: states.source[key].copy() for key in ("trajectory", "step")}
    named["trajectory"][[first, second]], named["step"][first] = (1, 7), 3
    wrong = states.replaced({f"source/{key}": values for key, values in named.items()})
    name = demonstrations_id(1)
    elsewhere, absent = demonstration_faults(wrong, name, ways(curated, "train"))
    assert elsewhere.startswith(
        f"states.h5 row {first}: episode 1 of {name} doesn't lead to its code"
    )
    assert absent.startswith(f"states.h5 row {second}: episode 7 of {name} has no state ")


def test_a_row_of_the_other_split_than_its_demonstration_is_a_fault(
    curated: Path, states: States
) -> None:
    swapped = states.replaced({"split": np.where(states.split == "train", "test", "train")})
    faults = list(demonstration_faults(swapped, demonstrations_id(1), ways(curated, "train")))
    assert len(faults) == 2
    assert all("is of the train split, the row of the other" in fault for fault in faults)


def test_states_that_are_there_twice_are_named(curated: Path) -> None:
    states = read_states(curated / "states.h5")
    twice = states.taken(np.array([0, 5, 0]))
    assert "states.h5 rows 0 and 2 are the same configuration" in list(state_faults(twice))
