"""Trajectory data: episodes, hindsight, episode files, merging, Minari datasets, and the checks
that they tell the truth.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import minari.cli
import numpy as np
import pytest
from typer.testing import CliRunner

import knotgym
from knotgym.common.errors import InvalidFile, InvalidInput, Occupied
from knotgym.datasets import episode_verification
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_verification import replay, show_episodes, verify_episodes
from knotgym.datasets.episode_writer import EpisodeWriter, merge_episodes
from knotgym.datasets.minari_dataset import MinariMetadata, compact, metadata_of, publish
from knotgym.datasets.trajectory import (
    INFOS,
    OPTIONAL,
    Episode,
    goals_reached,
    relabel_all,
    relabelled,
)
from knotgym.envs.observations import stacked
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import arrays

ID = "knotgym/tie-nx2/random-v0"
METADATA = MinariMetadata(
    dataset_id=ID,
    algorithm_name="random",
    description="Random pulls.",
    author=("Ada", "Bob"),
    author_email=("ada@example.org",),
    code_permalink="https://example.org/code",
    ref_min_score=-5.0,
    ref_max_score=5.0,
    num_episodes_average_score=64,
)


def record(env: gym.Env[Any, Any], seed: int) -> tuple[Episode, list[Any]]:
    """An episode of pulls at random beads, each kept up for a while, and what the environment
    showed.
    """
    core: Any = env.unwrapped
    rng, simulation = np.random.default_rng(seed), core.episodes.simulation
    seen, info = env.reset(seed=seed)
    start_qpos = simulation.qpos()[0]
    observations, infos, points = [seen], [info], [simulation.points[0].copy()]
    actions: list[Any] = []
    outcomes: list[Any] = []
    while not outcomes or not (outcomes[-1][1] or outcomes[-1][2]):
        if len(actions) % 8 == 0:
            bead = rng.integers(100)
            over = points[-1].mean(axis=0) - points[-1][bead] + rng.normal(0, 0.05, 3)
            over *= 0.2 / np.abs(over).max()
        over[2] = 0.1 if len(actions) % 8 < 4 else -0.1
        action = simulation.actions([bead], [over])[0]
        seen, *outcome, info = env.step(action)
        observations.append(seen)
        infos.append(info)
        points.append(simulation.points[0].copy())
        actions.append(action)
        outcomes.append(outcome)
    rewards, terminations, truncations = (
        np.array(column) for column in zip(*outcomes, strict=True)
    )
    columns: dict[str, Any] = {
        name: np.array([one[name] for one in infos]) for name in INFOS if name not in OPTIONAL
    }
    episode = Episode(
        start_qpos=start_qpos,
        points=np.array(points),
        goal_points=np.array(core.episodes._goals.points[info["goal"]]),
        actions=np.array(actions),
        rewards=rewards,
        terminations=terminations,
        truncations=truncations,
        **columns,
        move=np.array(["", *(["twist → cross"] * len(actions))]),
        expert_action=np.array([*actions[::-1], np.zeros(6)], dtype=np.float32),
        goal_gauss_code=info["goal_gauss_code"],
        seed=seed,
        options={"start": info["start"], "goal": info["goal"]},
        policy="random",
    )
    return episode, observations


@pytest.fixture(scope="module")
def task(states_path: str) -> TaskConfig:
    return TaskConfig(
        task="tie", nx=2, states=states_path, observation="both", horizon=12, image_size=48
    )


@pytest.fixture(scope="module")
def recorded(task: TaskConfig) -> list[tuple[Episode, list[Any]]]:
    settings = {name: value for name, value in vars(task).items() if name != "task"}
    env = gym.make("knotgym/Tie-v0", **settings)
    return [record(env, seed) for seed in range(4)]


@pytest.fixture(scope="module")
def episodes(recorded: list[tuple[Episode, list[Any]]]) -> list[Episode]:
    """Four as recorded, and what hindsight makes of them: terminated, of unequal lengths."""
    own = [episode for episode, _ in recorded]
    return own + list(relabel_all(own, "all"))


def write(
    path: Path, task: TaskConfig, episodes: dict[int, Episode], compact: bool = False
) -> Path:
    with EpisodeWriter(path, task, compact=compact) as writer:
        for number, episode in episodes.items():
            writer.add(episode, number)
    return path


@pytest.fixture(scope="module")
def root(
    tmp_path_factory: pytest.TempPathFactory, task: TaskConfig, episodes: list[Episode]
) -> Path:
    """A place where Minari finds one dataset, merged from two shards."""
    room = tmp_path_factory.mktemp("minari")
    shards = [
        write(room / f"{k}.h5", task, dict(list(enumerate(episodes))[k::2])) for k in range(2)
    ]
    publish(shards, METADATA, room / "root")
    return room / "root"


def own_faults(folder: Path, **how: Any) -> list[str]:
    """Faults but that the states lie outside; `collect` carries them along, this didn't."""
    faults = verify_episodes(folder, **how)
    own = [one for one in faults if "outside the dataset" not in one]
    assert len(own) == len(faults) - 1
    return own


def sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


# episodes and hindsight


def test_the_recorded_episodes_are_of_unequal_lengths_and_of_both_ends(
    episodes: list[Episode],
) -> None:
    assert len({len(one) for one in episodes}) > 2
    assert {bool(one.terminations[-1]) for one in episodes} == {True, False}


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("actions", np.zeros((12, 5), np.float32)),
        ("actions", np.zeros((12, 6))),
        ("bead", np.zeros(12, int)),
    ],
)
def test_an_episode_refuses_arrays_that_do_not_fit(
    episodes: list[Episode], name: str, wrong: Any
) -> None:
    with pytest.raises(InvalidInput, match=name):
        replace(episodes[0], **{name: wrong})


def test_a_digest_changes_with_any_bit(episodes: list[Episode]) -> None:
    points = episodes[0].points.copy()
    points[-1, -1, -1] = np.nextafter(points[-1, -1, -1], 1)
    assert (
        replace(episodes[0], points=points).digest()
        != episodes[0].digest()
        == replace(episodes[0]).digest()
    )


@pytest.mark.slow  # verification acts them out below
def test_replay_is_exact(episodes: list[Episode], task: TaskConfig) -> None:
    assert replay(episodes, task) == [None] * len(episodes)


def test_replay_says_where_the_rope_lies_elsewhere(
    episodes: list[Episode], task: TaskConfig
) -> None:
    points = episodes[1].points.copy()
    points[5:] += 1e-16 + 1e-12
    assert replay([episodes[0], replace(episodes[1], points=points)], task) == [None, 5]


def test_hindsight_cuts_where_a_code_is_reached_first(
    recorded: list[tuple[Episode, list[Any]]],
) -> None:
    episode = next(episode for episode, _ in recorded if goals_reached(episode.gauss_code))
    step = goals_reached(episode.gauss_code)[-1]
    before = episode.digest()
    cut = relabelled(episode, step)
    assert episode.digest() == before
    assert (
        len(cut) == step
        and cut.goal_gauss_code == episode.gauss_code[step] not in episode.gauss_code[:step]
    )
    assert cut.rewards.tolist() == [0.0] * (step - 1) + [5.0]
    assert cut.terminations.tolist() == [False] * (step - 1) + [True] and not cut.truncations.any()
    assert (
        np.array_equal(cut.goal_points, cut.points[-1])
        and "goal" not in cut.options
        and cut.relabelled
    )


def test_hindsight_refuses_a_goal_that_was_reached_before() -> None:
    assert goals_reached(["", "1+,1-", "", "1+,1-", ""]) == [1]


def test_hindsight_refuses_a_step_that_reaches_nothing_new(episodes: list[Episode]) -> None:
    with pytest.raises(InvalidInput, match="reaches another code first"):
        relabelled(episodes[0], 0)


# files


def test_what_is_written_comes_back(
    tmp_path: Path, task: TaskConfig, episodes: list[Episode]
) -> None:
    path = write(tmp_path / "a.h5", task, dict(enumerate(episodes)))
    assert [one.digest() for one in EpisodeReader(path)] == [one.digest() for one in episodes]


def test_stored_observations_are_the_environments_byte_for_byte(
    root: Path, recorded: list[tuple[Episode, list[Any]]]
) -> None:
    reader = EpisodeReader(root / ID)
    for index, (_, observations) in enumerate(recorded):
        stored = reader.observations(index)
        for name in ("pixels", "state"):
            shown = np.array([one[name] for one in observations])
            assert stored[name].dtype == shown.dtype and np.array_equal(stored[name], shown)


def test_the_compact_form_draws_what_the_environment_showed(
    tmp_path: Path,
    task: TaskConfig,
    episodes: list[Episode],
    recorded: list[tuple[Episode, list[Any]]],
) -> None:
    reader = EpisodeReader(write(tmp_path / "a.h5", task, dict(enumerate(episodes)), compact=True))
    assert reader.stored == "none"
    assert np.array_equal(
        reader.observations(3, slice(4, 6), observation="pixels"),
        np.array([one["pixels"] for one in recorded[3][1][4:6]]),
    )


def test_hindsight_shows_the_same_stored_as_drawn(
    tmp_path: Path, task: TaskConfig, episodes: list[Episode]
) -> None:
    files = [
        write(tmp_path / f"{small}.h5", task, {0: episodes[0]}, compact=small)
        for small in (True, False)
    ]
    drawn, stored = (
        EpisodeReader(path).observations(0, slice(0, 3), goal_step=5) for path in files
    )
    assert all(np.array_equal(drawn[name], stored[name]) for name in ("pixels", "state"))


def test_an_error_leaves_nothing_under_the_final_name(
    tmp_path: Path, task: TaskConfig, episodes: list[Episode]
) -> None:
    with pytest.raises(RuntimeError), EpisodeWriter(tmp_path / "a.h5", task) as writer:
        writer.add(episodes[0])
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow  # the same by tests/common/test_atomic_files.py
def test_a_kill_leaves_nothing_under_the_final_name(tmp_path: Path) -> None:
    script = (
        "import os\nfrom knotgym.datasets.episode_writer import EpisodeWriter\nfrom"
        f" knotgym.envs.tasks import TaskConfig\nwith EpisodeWriter({str(tmp_path / 'a.h5')!r},"
        " TaskConfig(task='tie')):\n    os.kill(os.getpid(), 9)"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", script], cwd=Path(knotgym.__file__).parent.parent
        ).returncode
        == -9
    )
    assert not (tmp_path / "a.h5").exists()


@pytest.mark.parametrize("shards", [pytest.param(k, marks=pytest.mark.slow) for k in (1, 2)] + [5])
def test_merging_gives_the_same_bytes_whatever_the_shards(
    tmp_path: Path, root: Path, task: TaskConfig, episodes: list[Episode], shards: int
) -> None:
    numbered = list(enumerate(episodes))
    sources = [
        write(tmp_path / f"{k}.h5", task, dict(reversed(numbered[k::shards])))
        for k in range(shards)
    ]
    again = publish(sources[::-1], METADATA, tmp_path / "root")
    for name in ("main_data.hdf5", "metadata.json"):
        assert sha(again / "data" / name) == sha(root / ID / "data" / name)


@pytest.mark.parametrize("stored", ["pixels", "both"])
def test_stacked_pictures_are_stored_read_and_drawn_alike(
    tmp_path: Path, task: TaskConfig, episodes: list[Episode], stored: str
) -> None:
    stack = replace(task, observation=stored, layout="stacked", image_size=16)
    path = write(tmp_path / "a.h5", stack, {0: episodes[-1]})
    beside = write(tmp_path / "b.h5", replace(stack, layout="beside"), {0: episodes[-1]})
    for goal_step in (None, 1):
        seen = [
            EpisodeReader(one).observations(0, observation="pixels", goal_step=goal_step)
            for one in (path, beside)
        ]
        assert seen[0].shape[1:] == (16, 16, 6) and np.array_equal(seen[0], stacked(seen[1]))
    assert verify_episodes(path, frames=None) == []


def test_merging_closes_gaps_in_the_numbers(
    tmp_path: Path, task: TaskConfig, episodes: list[Episode]
) -> None:
    merge_episodes(
        [write(tmp_path / "a.h5", task, {7: episodes[1], 3: episodes[0]})], tmp_path / "b.h5"
    )
    reader = EpisodeReader(tmp_path / "b.h5")
    assert reader.rows == [0, 1] and [one.digest() for one in reader] == [
        one.digest() for one in episodes[:2]
    ]


def test_merging_refuses_two_episodes_of_one_number(
    tmp_path: Path, task: TaskConfig, episodes: list[Episode]
) -> None:
    paths = [write(tmp_path / f"{k}.h5", task, {4: episodes[k]}) for k in range(2)]
    with pytest.raises(InvalidFile, match="number 4"):
        merge_episodes(paths, tmp_path / "c.h5")
    merge_episodes(paths[::-1], tmp_path / "c.h5", concatenate=True)
    assert [one.digest() for one in EpisodeReader(tmp_path / "c.h5")] == [
        episodes[1].digest(),
        episodes[0].digest(),
    ]


def test_merging_refuses_files_of_different_tasks(
    tmp_path: Path, task: TaskConfig, episodes: list[Episode]
) -> None:
    paths = [write(tmp_path / f"{nx}.h5", replace(task, nx=nx), {nx: episodes[0]}) for nx in (2, 3)]
    with pytest.raises(InvalidFile, match="one task"):
        merge_episodes(paths, tmp_path / "c.h5")


def test_to_the_compact_form_and_back_gives_the_same_bytes(tmp_path: Path, root: Path) -> None:
    compact(root / ID, tmp_path / "small.h5")
    assert (tmp_path / "small.h5").stat().st_size < (
        root / ID / "data" / "main_data.hdf5"
    ).stat().st_size
    metadata = metadata_of(tmp_path / "small.h5")
    assert metadata == METADATA
    again = publish([tmp_path / "small.h5"], METADATA, tmp_path / "root")
    for name in ("main_data.hdf5", "metadata.json"):
        assert sha(again / "data" / name) == sha(root / ID / "data" / name)


def test_to_other_observations_and_back_gives_the_same_bytes(tmp_path: Path, root: Path) -> None:
    merge_episodes([root / ID], tmp_path / "state.h5", store="state")
    assert EpisodeReader(tmp_path / "state.h5").task.observation == "state"
    publish([tmp_path / "state.h5"], METADATA, tmp_path / "root", store="both")
    assert sha(tmp_path / "root" / ID / "data" / "main_data.hdf5") == sha(
        root / ID / "data" / "main_data.hdf5"
    )


@pytest.mark.thorough
def test_symbols_go_to_minari_and_back(
    tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = publish([root / ID], METADATA, tmp_path, store="symbolic")
    assert own_faults(folder, pyknotid=False) == []
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = minari.load_dataset(ID)
    reader = EpisodeReader(folder)
    assert reader.task.observation == reader.stored == "symbolic"
    for index, read in enumerate(dataset.iterate_episodes()):
        drawn = EpisodeReader(root / ID).observations(index, observation="symbolic")
        assert np.array_equal(read.observations, drawn) and drawn.dtype == np.int16
        assert dataset.observation_space.contains(read.observations[-1])
    assert dataset.recover_environment().reset(seed=0)[0] in dataset.observation_space
    publish([folder], METADATA, tmp_path / "again", store="both")
    back, first = (where / ID / "data" / "main_data.hdf5" for where in (tmp_path / "again", root))
    assert sha(back) == sha(first)
    spoilt = tmp_path / "spoilt.h5"
    spoilt.write_bytes((folder / "data" / "main_data.hdf5").read_bytes())
    with h5py.File(spoilt, "a") as file:
        file["episode_0/observations"][0, 1, 0] *= -1
    faults = verify_episodes(spoilt, pyknotid=False)
    assert any("the stored symbolic" in fault for fault in faults)


def test_a_dataset_is_replaced_only_when_asked(root: Path, tmp_path: Path) -> None:
    publish([root / ID], METADATA, tmp_path)
    with pytest.raises(Occupied, match="exists already"):
        publish([root / ID], METADATA, tmp_path)
    publish([root / ID], METADATA, tmp_path, overwrite=True)


@pytest.mark.parametrize("content", [b"", b"not HDF5"])
def test_a_foreign_file_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.h5").write_bytes(content)
    with pytest.raises(InvalidFile, match="isn't a whole episode file") as caught:
        EpisodeReader(tmp_path / "a.h5")
    assert "\n" not in str(caught.value)


def test_a_truncated_file_is_refused(tmp_path: Path, root: Path) -> None:
    content = (root / ID / "data" / "main_data.hdf5").read_bytes()
    (tmp_path / "a.h5").write_bytes(content[: len(content) // 2])
    with pytest.raises(InvalidFile):
        EpisodeReader(tmp_path / "a.h5")


def test_another_format_is_refused(tmp_path: Path) -> None:
    h5py.File(tmp_path / "a.h5", "w").close()
    with pytest.raises(InvalidFile, match="format 'none'"):
        EpisodeReader(tmp_path / "a.h5")


# Minari


@pytest.fixture
def dataset(root: Path, monkeypatch: pytest.MonkeyPatch) -> minari.MinariDataset:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    return minari.load_dataset(ID)


def test_minari_iterates_what_was_written(
    dataset: minari.MinariDataset, episodes: list[Episode]
) -> None:
    assert (dataset.total_episodes, dataset.total_steps) == (len(episodes), sum(map(len, episodes)))
    for read, episode in zip(dataset.iterate_episodes(), episodes, strict=True):
        for name in ("actions", "rewards", "terminations", "truncations"):
            assert np.array_equal(getattr(read, name), getattr(episode, name))
        there = [name for name in INFOS if getattr(episode, name) is not None]
        assert sorted(read.infos) == sorted([*there, "goal_gauss_code", "points"])
        goals = [text.decode() for text in read.infos["goal_gauss_code"]]
        assert goals == [episode.goal_gauss_code] * (len(episode) + 1)
        for name in there:
            right = getattr(episode, name)
            assert np.array_equal(
                (
                    [text.decode() for text in read.infos[name]]
                    if right.dtype.kind == "U"
                    else read.infos[name]
                ),
                right,
            )
        assert dataset.observation_space.contains(
            {name: array[-1] for name, array in read.observations.items()}
        )


def test_loaders_keep_to_the_episodes_that_minari_chose(
    dataset: minari.MinariDataset, episodes: list[Episode]
) -> None:
    chosen = dataset.filter_episodes(lambda episode: len(episode) < 15)
    right = [episode.actions for episode in episodes if len(episode) < 15]
    assert right and np.array_equal(
        arrays(chosen, observation="state")["actions"], np.concatenate(right)
    )


def test_minari_samples(dataset: minari.MinariDataset) -> None:
    assert len(list(dataset.sample_episodes(4))) == 4


def test_minari_keeps_seeds_and_options(
    dataset: minari.MinariDataset, episodes: list[Episode]
) -> None:
    for said, episode in zip(
        dataset.storage.get_episode_metadata(range(len(episodes))), episodes, strict=True
    ):
        assert (said["seed"], said["options"], said["policy"]) == (
            episode.seed,
            episode.options,
            "random",
        )
        assert (said["total_steps"], said["goal_gauss_code"]) == (
            len(episode),
            episode.goal_gauss_code,
        )


def test_the_recovered_environment_shows_the_same_again(
    dataset: minari.MinariDataset, task: TaskConfig
) -> None:
    env: Any = dataset.recover_environment()
    assert env.unwrapped.config == task
    assert dataset.recover_environment(eval_env=True).unwrapped.config == replace(
        task, split="test"
    )
    read, said = dataset[2], next(iter(dataset.storage.get_episode_metadata([2])))
    shown = [
        env.reset(
            seed=said["seed"], options={name: int(row) for name, row in said["options"].items()}
        )[0]
    ]
    rewards = []
    for action in read.actions:
        seen, reward, *_ = env.step(action)
        shown.append(seen)
        rewards.append(reward)
    assert rewards == read.rewards.tolist()
    assert all(
        np.array_equal(np.array([one[name] for one in shown]), read.observations[name])
        for name in shown[0]
    )


@pytest.mark.thorough
def test_minari_recovers_the_environment_in_a_process_that_never_imported_knotgym(
    root: Path,
) -> None:
    script = (
        f"import minari, sys\nenv = minari.load_dataset({ID!r}).recover_environment()\nassert"
        " env.reset()[0]['pixels'].shape == (48, 96, 3)"
    )
    where = {
        "MINARI_DATASETS_PATH": str(root),
        "PATH": "",
        "PYTHONPATH": str(Path(knotgym.__file__).parent.parent),
    }
    where |= {name: os.environ[name] for name in ("NUMBA_CACHE_DIR",) if name in os.environ}
    subprocess.run([sys.executable, "-c", script], env=where, check=True)


@pytest.mark.parametrize("command", [["show", ID], ["list", "local"]])
def test_minaris_own_commands_work(dataset: minari.MinariDataset, command: list[str]) -> None:
    result = CliRunner().invoke(minari.cli.app, command, env={"COLUMNS": "200"})
    assert result.exit_code == 0 and ID in result.output and "Ada" in result.output


def test_scores_are_normalized_by_the_references(dataset: minari.MinariDataset) -> None:
    assert minari.get_normalized_score(dataset, np.float32(0.0)) == 0.5


def test_the_metadata_names_what_minari_names(root: Path) -> None:
    entries = json.loads((root / ID / "data" / "metadata.json").read_text())
    assert (
        entries["author"] == ["Ada", "Bob"]
        and entries["code_permalink"] == "https://example.org/code"
    )
    assert entries["jpeg_encoding"] is False and entries["minari_version"] == minari.__version__
    assert entries["algorithm_name"] == "random" and entries["num_episodes_average_score"] == 64
    size = sum(file.stat().st_size for file in (root / ID / "data").iterdir()) / 1e6
    assert abs(entries["dataset_size"] - size) < 0.051


def test_a_dataset_is_two_files_and_names_no_folder_of_its_maker(root: Path) -> None:
    files = sorted(file for file in (root / ID).rglob("*") if file.is_file())
    assert [file.name for file in files] == ["main_data.hdf5", "metadata.json"]
    assert not any(str(root).encode() in file.read_bytes() for file in files)


# checks


def test_what_was_written_has_no_fault(root: Path) -> None:
    assert own_faults(root / ID, frames=None, act_out=True) == []


def test_show_counts_episodes_steps_and_successes(root: Path, episodes: list[Episode]) -> None:
    summary = show_episodes(root / ID)
    assert (summary["episodes"], summary["steps"], summary["dataset_id"]) == (
        len(episodes),
        sum(map(len, episodes)),
        ID,
    )
    assert summary["successes"] == summary["relabelled"] == len(episodes) - 4
    json.dumps(summary)


def set_last(name: str, value: Any) -> Callable[[h5py.Group], None]:
    def change(group: h5py.Group) -> None:
        group[name][-1] = value

    return change


@pytest.fixture(scope="module")
def two(
    tmp_path_factory: pytest.TempPathFactory, task: TaskConfig, episodes: list[Episode]
) -> Path:
    """A file of two episodes; harm is done to copies."""
    return write(tmp_path_factory.mktemp("two") / "a.h5", task, dict(enumerate(episodes[:2])))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (set_last("infos/gauss_code", b"1+"), "step 12: gauss_code is"),
        (set_last("infos/goal_gauss_code", b"1+"), "infos/goal_gauss_code isn't"),
        (lambda group: group.pop("infos/goal_gauss_code"), "goal_gauss_code is missing"),
        (set_last("infos/crossings", 99), "step 12: crossings is 99"),
        (set_last("infos/bead", -7), "step 12: bead is -7"),
        (set_last("infos/applied_share", 0.7), "step 12: applied_share is 0.7, should be 1.0, 0.5"),
        (set_last("infos/force", 0.01), "step 12: force is"),
        (set_last("rewards", 1.0), "step 11: rewards is 1.0, should be -5.0"),
        (set_last("truncations", False), "step 11: truncations is False"),
        (set_last("infos/points", np.nan), "points holds nan at [12, "),
        (set_last("observations/pixels", 7), "step 12: the stored pixels"),
        (set_last("observations/state", 7.0), "step 12: the stored state"),
        (
            lambda group: group.attrs.modify("start_qpos", np.ones(421)),
            "step 0: the rope doesn't lie",
        ),
        (lambda group: group.attrs.modify("policy", "expert"), "digest"),
        (lambda group: group.pop("actions"), "actions"),
    ],
)
def test_verification_names_the_fault(two: Path, tmp_path: Path, change: Any, said: str) -> None:
    path = Path(shutil.copy(two, tmp_path / "a.h5"))
    with h5py.File(path, "r+") as file:
        change(file["episode_1"])
    faults = verify_episodes(path)
    assert faults and all(f"{path}, episode 1" in fault for fault in faults)
    assert any(said in fault for fault in faults), faults


def test_a_share_of_the_force_that_was_not_applied_is_found_by_replay(
    tmp_path: Path, task: TaskConfig, episodes: list[Episode]
) -> None:
    shares = np.where(np.arange(len(episodes[0]) + 1) == 3, 0.5, 1.0)
    eased = replace(episodes[0], applied_share=shares, force=shares[:, None] * episodes[0].force)
    path = write(tmp_path / "a.h5", task, {0: eased})
    assert not verify_episodes(path)
    (fault,) = verify_episodes(path, act_out=True)
    assert "step 3: replayed" in fault and "another share of the force" in fault


def test_verification_names_wrong_counts(tmp_path: Path, root: Path) -> None:
    folder = publish([root / ID], METADATA, tmp_path)
    beside = folder / "data" / "metadata.json"
    beside.write_text(json.dumps({**json.loads(beside.read_text()), "total_steps": 3}))
    assert [fault for fault in verify_episodes(folder) if "total_steps is 3" in fault]


def test_a_header_that_h5py_stumbles_over_is_a_fault(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # what h5py raises where a checksum of the library's own is wrong
    def stumble(*_: Any) -> None:
        raise RuntimeError("Can't determine if attribute exists (incorrect metadata checksum)")

    monkeypatch.setattr(episode_verification, "counted_index", stumble)
    (fault,) = verify_episodes(root / ID)
    assert fault.endswith("attribute exists (incorrect metadata checksum)")
