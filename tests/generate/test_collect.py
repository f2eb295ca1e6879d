import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest

from knotgym.cli.main import main
from knotgym.common.atomic_files import sha256
from knotgym.common.errors import InvalidInput, Occupied
from knotgym.control.expert import Expert
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import episode_seed
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_verification import verify_episodes
from knotgym.datasets.episode_writer import EpisodeWriter
from knotgym.datasets.minari_dataset import MinariMetadata, metadata_of, publish
from knotgym.datasets.trajectory import relabel_all
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect import collect
from knotgym.generate.episodes.collect_config import CollectConfig
from knotgym.loaders import Transitions
from knotgym.rope.model import RopeConfig
from knotgym.runs.engine import request_of
from knotgym.runs.run_options import RunOptions
from knotgym.runs.staging import staging_folder
from knotgym.states.state_file import States, write_states

from ..minari_list import check_minari
from ..small_job import knotgym

FORK = multiprocessing.get_context("forkserver")
FORK.set_forkserver_preload(["knotgym.cli.main", "knotgym.generate.episodes.collect"])
VIEWS_ID = "tests/views-v0"
QUIET = RunOptions(workers=1, quiet=True)
RESUMED = replace(QUIET, resume=True)


def config(states_path: str, **settings: Any) -> CollectConfig:
    task = TaskConfig(task="unknot", nx=1, states=states_path, observation="state", horizon=4)
    return CollectConfig(
        **{"task": task, "policy": PolicyConfig(policy="scripted"), "episodes": 6, **settings}
    )


def made(folder: Path) -> bytes:
    return (folder / "data" / "main_data.hdf5").read_bytes()


def test_the_dataset_takes_its_id_and_holds_every_episode(states_path: str, tmp_path: Path) -> None:
    folder = collect(config(states_path), tmp_path, QUIET)
    assert folder == tmp_path / "knotgym/unknot-nx1/scripted-v0"
    assert len(EpisodeReader(folder)) == 6
    assert list(folder.parent.iterdir()) == [folder]


def test_labels_are_an_expert_s_and_change_nothing_that_is_played(
    states_path: str, tmp_path: Path
) -> None:
    policy = PolicyConfig(policy="random", planner=PlannerConfig(budget=16))
    task = replace(config(states_path).task, horizon=2)
    plain = config(states_path, task=task, policy=policy, episodes=2)
    labelled = config(states_path, task=task, policy=policy, episodes=2, labels="expert")
    assert labelled.dataset_id == "knotgym/unknot-nx1/random-labelled-v0"
    made_plain, made_labelled = (collect(one, tmp_path, QUIET) for one in (plain, labelled))
    assert verify_episodes(made_labelled) == []
    for before, after in zip(EpisodeReader(made_plain), EpisodeReader(made_labelled), strict=True):
        labels = after.expert_action
        assert labels is not None and before.digest() == replace(after, expert_action=None).digest()
        assert not labels[-1].any() and labels[:-1].any(axis=1).all()
        assert not np.array_equal(labels[:-1], after.actions)
    reader = EpisodeReader(made_labelled)
    told = np.concatenate([reader.column(row, "expert_action")[:-1] for row in range(2)])
    assert np.array_equal(Transitions(made_labelled, labels=True).actions, told)
    for dataset, relabel in ((made_plain, None), (made_labelled, "all")):
        with pytest.raises(InvalidInput):
            Transitions(dataset, labels=True, relabel=relabel)


@pytest.mark.slow  # its plans are acted out in tests/control/test_expert.py
def test_what_the_expert_says_at_every_state_leads_to_the_goal(states_path: str) -> None:
    task = replace(config(states_path).task, horizon=50)
    episodes, expert = EpisodeBatch(task, 1), Expert()
    episodes.begin(0, np.random.default_rng(0))
    for step in range(50):
        action, _ = expert.advise(episodes, 0, np.random.default_rng(step))
        _, terminated, _ = episodes.step(action[None], np.array([0]))
        if terminated[0]:
            return
    raise AssertionError("the goal wasn't reached in 50 steps")


@pytest.mark.slow
def test_of_several_attempts_the_shortest_success_is_kept(states_path: str, tmp_path: Path) -> None:
    acted = {
        "task": replace(config(states_path).task, horizon=10),
        "policy": PolicyConfig(policy="random"),
        "episodes": 4,
    }
    once, twice = (
        EpisodeReader(collect(config(states_path, **acted, attempts=number), tmp_path, QUIET))
        for number in (1, 2)
    )
    assert [episode.seed for episode in once] == [episode.seed for episode in twice]
    assert verify_episodes(twice.path) == []
    pairs = list(zip(once, twice, strict=True))
    assert all(len(best) <= len(first) for first, best in pairs if first.is_success[-1])
    assert sum(first.digest() != best.digest() for first, best in pairs)
    assert all(best.is_success[-1] for first, best in pairs if first.digest() != best.digest())


@pytest.mark.slow  # tests/datasets/test_episodes.py does it
def test_every_episode_can_be_acted_out_again(states_path: str, tmp_path: Path) -> None:
    folder = collect(config(states_path), tmp_path, QUIET)
    assert verify_episodes(folder, act_out=True) == []


@pytest.mark.thorough
def test_episodes_of_a_rope_integrated_otherwise_say_so_and_can_be_acted_out_again(
    states_path: str, tmp_path: Path
) -> None:
    usual, coarse = (
        config(states_path, episodes=2),
        config(
            states_path,
            task=replace(config(states_path).task, integrator_steps=20),
            episodes=2,
        ),
    )
    folders = [
        collect(one, tmp_path / str(one.task.integrator_steps), QUIET) for one in (usual, coarse)
    ]
    assert verify_episodes(folders[1], act_out=True) == []
    one, other = map(EpisodeReader, folders)
    assert (one.rope, other.rope) == (
        usual.task.rope.fingerprint,
        coarse.task.rope.fingerprint,
    ) and one.rope != other.rope
    apart = np.linalg.norm(one.episode(0).points[1] - other.episode(0).points[1], axis=1).max()
    assert 0 < apart < 0.002 and np.array_equal(
        one.episode(0).actions[0], other.episode(0).actions[0]
    )
    with pytest.raises(SystemExit) as stopped:
        main(["dataset", "replay", str(folders[1]), "--out", str(tmp_path / "film.gif")])
    assert stopped.value.code == 0
    metadata = [json.loads((folder / "data" / "metadata.json").read_text()) for folder in folders]
    assert json.loads(metadata[1]["env_spec"])["kwargs"]["integrator_steps"] == 20


def test_the_environment_s_reset_with_the_stored_seed_begins_the_same_episode(
    states_path: str, tmp_path: Path
) -> None:
    made_config = config(states_path)
    episode = EpisodeReader(collect(made_config, tmp_path, QUIET)).episode(3)
    assert episode.seed == episode_seed(0, 3)
    env = gym.make("knotgym/Unknot-v0", nx=1, states=states_path, observation="state", horizon=4)
    for options in (None, dict(episode.options)):
        observation, info = env.reset(seed=episode.seed, options=options)
        assert (info["start"], info["goal"]) == (episode.options["start"], episode.options["goal"])
        for step, action in enumerate(episode.actions):
            assert np.array_equal(
                observation[:300], episode.points[step].reshape(-1).astype(np.float32)
            )
            observation, reward, terminated, truncated, info = env.step(action)
            assert (reward, terminated, truncated) == (
                episode.rewards[step],
                episode.terminations[step],
                episode.truncations[step],
            )
            assert info["gauss_code_chiral"] == episode.gauss_code_chiral[step + 1]
            assert info["bead"] == episode.bead[step + 1] and np.array_equal(
                info["force"], episode.force[step + 1]
            )


@pytest.mark.parametrize(
    "observation",
    [
        pytest.param("pixels", marks=pytest.mark.slow),  # three views of it are tried below
        pytest.param("state", marks=pytest.mark.slow),
        "both",
    ],
)
def test_minari_does_with_a_dataset_all_that_it_does(
    observation: str, states_path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = TaskConfig(
        task="tie", nx=1, states=states_path, observation=observation, horizon=3, image_size=32
    )
    name = "tests/scripted-v3"
    collect(
        config(
            states_path,
            task=task,
            policy=PolicyConfig(policy="scripted"),
            episodes=3,
            dataset_id=name,
        ),
        tmp_path,
        QUIET,
    )
    check_minari(tmp_path, name, monkeypatch)


@pytest.fixture(scope="module")
def many_views(tmp_path_factory: pytest.TempPathFactory, states_path: str) -> Path:
    """The root of a dataset of three views with depth, made by the command."""
    root = tmp_path_factory.mktemp("views")
    ended = knotgym(
        *("collect", "--task", "tie", "--nx", 1, "--policy", "scripted", "--episodes", 2),
        *(
            "--states",
            states_path,
            "--set",
            "task.horizon=2",
            "--set",
            "task.image_size=16",
            "--observation",
            "pixels",
        ),
        *("--set", "task.views=top,left,front", "--set", "task.depth=true", "--id", VIEWS_ID),
        *("--workers", 1, "--quiet", "--out", root),
    )
    assert ended == 0
    return root


def test_minari_does_it_with_three_views_and_depth(
    many_views: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_minari(many_views, VIEWS_ID, monkeypatch)
    reader = EpisodeReader(many_views / VIEWS_ID)
    assert reader.task.views == ("top", "left", "front") and reader.task.depth
    assert reader.observations(0).shape == (3, 48, 32, 4)
    metadata = json.loads((many_views / VIEWS_ID / "data/metadata.json").read_text())
    assert json.loads(metadata["env_spec"])["kwargs"]["views"] == ["top", "left", "front"]


@pytest.mark.parametrize("place", [(1, 40, 3, 0), (1, 8, 24, 3)])  # the front view; a depth
def test_a_changed_pixel_of_a_side_view_or_of_the_depth_is_found(
    many_views: Path, tmp_path: Path, place: tuple[int, int, int, int]
) -> None:
    spoilt = tmp_path / "spoilt.h5"
    spoilt.write_bytes((many_views / VIEWS_ID / "data/main_data.hdf5").read_bytes())
    with h5py.File(spoilt, "a") as file:
        file["episode_1/observations"][place] ^= 1
    faults = verify_episodes(spoilt, pyknotid=False)
    assert len(faults) == 1 and "episode 1: step 1: the stored pixels isn't what" in faults[0]


def test_views_that_are_not_there_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert knotgym("collect", "--set", "task.views=top,below", "--out", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "views must be a list of top, left, front" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.slow  # test_episodes reads relabelled episodes through Minari
def test_minari_does_it_with_hindsight_too(
    states_path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = TaskConfig(
        task="tie", nx=1, states=states_path, observation="both", horizon=16, image_size=32
    )
    played = collect(config(states_path, task=task, episodes=5), tmp_path / "played", QUIET)
    name = "knotgym/tie-nx1/hindsight-v0"
    with EpisodeWriter(tmp_path / "hindsight.h5", replace(task, states=name)) as writer:
        for episode in relabel_all(EpisodeReader(played), "all"):
            writer.add(episode)
    publish(
        [tmp_path / "hindsight.h5"],
        MinariMetadata(dataset_id=name, algorithm_name="scripted", description="Codes passed."),
        tmp_path / "root",
        states=states_path,
    )
    check_minari(tmp_path / "root", name, monkeypatch)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["scripted", pytest.param("noisy", marks=pytest.mark.slow)])
def test_workers_do_not_change_the_bytes(name: str, states_path: str, tmp_path: Path) -> None:
    policy = PolicyConfig(policy=name, planner=PlannerConfig(budget=40, batch_size=2))
    one = collect(config(states_path, policy=policy), tmp_path / "one", QUIET)
    two = collect(config(states_path, policy=policy), tmp_path / "two", replace(QUIET, workers=2))
    assert made(one) == made(two)


def test_failed_episodes_are_dropped_when_asked_and_counted(
    states_path: str, tmp_path: Path
) -> None:
    policy = PolicyConfig(policy="scripted")
    kept = collect(config(states_path, policy=policy), tmp_path / "kept", QUIET)
    tally = json.loads((kept / "data" / "collection.json").read_text())["tally"]
    assert 0 < tally["succeeded"] < tally["played"] == tally["kept"] == 6
    dropped = collect(
        config(states_path, policy=policy, keep_failed=False), tmp_path / "dropped", QUIET
    )
    assert len(EpisodeReader(dropped)) == tally["succeeded"]
    assert all(episode.is_success[-1] for episode in EpisodeReader(dropped))


def test_with_nothing_left_nothing_is_written(states_path: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="nothing is left"):
        collect(
            config(
                states_path, policy=PolicyConfig(policy="random"), episodes=1, keep_failed=False
            ),
            tmp_path,
            QUIET,
        )
    assert not (tmp_path / "knotgym/unknot-nx1/random-v0").exists()


def test_a_finished_dataset_is_not_written_over(states_path: str, tmp_path: Path) -> None:
    folder = collect(config(states_path, episodes=1), tmp_path, QUIET)
    with pytest.raises(Occupied):
        collect(config(states_path, episodes=1), tmp_path, QUIET)
    assert collect(config(states_path, episodes=1), tmp_path, RESUMED) == folder
    with pytest.raises(InvalidInput, match="config.episodes is 1 there and 2 here"):
        collect(config(states_path, episodes=2), tmp_path, RESUMED)


@pytest.mark.slow  # test_kills kills a collection and compares the bytes
def test_a_killed_run_leaves_nothing_under_its_name_and_resumes_to_the_same_bytes(
    states_path: str, tmp_path: Path
) -> None:
    arguments = [
        "collect",
        "--task",
        "unknot",
        "--nx",
        "1",
        "--policy",
        "scripted",
        "--id",
        "knotgym/unknot-nx1/scripted-v0",
        "--states",
        states_path,
        "--horizon",
        "4",
        "--episodes",
        "24",
    ]
    arguments += ["--observation", "state", "--workers", "1", "--quiet", "--out"]
    program = "import sys; from knotgym.cli.main import main; main(sys.argv[1:])"
    broken = subprocess.Popen([sys.executable, "-c", program, *arguments, str(tmp_path / "broken")])
    partial = tmp_path / "broken/knotgym/unknot-nx1/.scripted-v0.partial"
    while broken.poll() is None and len(list(partial.glob("episodes-*.json"))) < 2:
        time.sleep(0.01)
    os.kill(broken.pid, signal.SIGKILL)
    broken.wait()
    assert not (partial.parent / "scripted-v0").exists()
    for where, resume in (("broken", ["--resume"]), ("whole", [])):
        assert knotgym(*arguments, tmp_path / where, *resume) == 0
    assert made(tmp_path / "broken/knotgym/unknot-nx1/scripted-v0") == made(
        tmp_path / "whole/knotgym/unknot-nx1/scripted-v0"
    )


@pytest.mark.slow
def test_ten_kills_at_random_moments_leave_nothing_half_written_and_change_no_byte(
    states_path: str, tmp_path: Path
) -> None:
    name, episodes, rng = "knotgym/unknot-nx1/scripted-v0", 24, np.random.default_rng(7)
    words = [
        "collect",
        "--task",
        "unknot",
        "--nx",
        "1",
        "--policy",
        "scripted",
        "--id",
        "knotgym/unknot-nx1/scripted-v0",
        "--states",
        states_path,
        "--horizon",
        "12",
    ]
    words += [
        "--set",
        "task.image_size=32",
        "--episodes",
        str(episodes),
        "--quiet",
        "--resume",
        "--out",
    ]

    def begun(where: str) -> multiprocessing.process.BaseProcess:
        process = FORK.Process(
            target=main,
            args=([*words, str(tmp_path / where), "--workers", str(1 + int(rng.integers(2)))],),
        )
        process.start()
        return process

    began = time.perf_counter()
    unbroken = begun("whole")
    unbroken.join()
    took = time.perf_counter() - began
    assert unbroken.exitcode == 0
    kills, runs = 0, 0
    while kills < 10 or not (tmp_path / f"broken-{runs}" / name).exists():
        where = tmp_path / f"broken-{runs}"
        process = begun(where.name)
        process.join(rng.uniform(0, took) if kills < 10 else None)
        if process.is_alive():
            process.kill()
            process.join()
            kills += 1
        else:
            assert process.exitcode == 0
        if (where / name).exists():  # perhaps just before the kill
            assert verify_episodes(where / name) == []
            assert [made(where / name), len(EpisodeReader(where / name))] == [
                made(tmp_path / "whole" / name),
                episodes,
            ]
            runs += kills < 10
    assert all(
        list((tmp_path / f"broken-{run}" / name).parent.iterdir())
        == [tmp_path / f"broken-{run}" / name]
        for run in range(runs)
    )


def test_another_collection_is_not_resumed(states_path: str, tmp_path: Path) -> None:
    folder = tmp_path / "knotgym/unknot-nx1/scripted-v0"
    collect(config(states_path, seed=1, episodes=1), tmp_path / "other", QUIET)
    made_by = request_of(tmp_path / "other" / folder.relative_to(tmp_path))
    staging_folder(folder).mkdir(parents=True)
    (staging_folder(folder) / "request.json").write_text(json.dumps(made_by))
    with pytest.raises(InvalidInput, match="seed is 1 there and 0 here"):
        collect(config(states_path, episodes=1), tmp_path, RESUMED)


@pytest.fixture
def own_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CollectConfig:
    """A collection by a module in the current folder, on states beside it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "collected_policy", raising=False)
    (tmp_path / "collected_policy.py").write_text("act = lambda seen: [0.5] * 6\n")
    return config(
        str(tmp_path / "states.h5"), policy=PolicyConfig(policy="collected_policy:act"), episodes=1
    )


@pytest.mark.parametrize("swapped", ["states.h5", "collected_policy.py"])
@pytest.mark.parametrize("finished", [True, False])
def test_a_file_swapped_in_between_is_refused_by_name(
    swapped: str,
    finished: bool,
    own_policy: CollectConfig,
    states: States,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_states(tmp_path / "states.h5", states)
    if finished:
        collect(own_policy, tmp_path / "out", QUIET)
    else:
        with monkeypatch.context() as stopped, pytest.raises(KeyboardInterrupt):
            stopped.setattr("knotgym.generate.episodes.collect.play", interrupted)
            collect(own_policy, tmp_path / "out", QUIET)
    if swapped == "states.h5":
        write_states(tmp_path / swapped, states.taken(np.arange(len(states))[::-1]))
    else:
        with (tmp_path / swapped).open("a") as file:
            file.write("# changed\n")
    name = "states.own" if swapped == "states.h5" else re.escape(swapped)
    with pytest.raises(InvalidInput, match=rf"{name} is .* there and .* here"):
        collect(own_policy, tmp_path / "out", RESUMED)


def interrupted(file: Any) -> Any:
    """As a person who stops the run while a file is written."""
    file.path.touch()
    raise KeyboardInterrupt


def test_a_dataset_holds_the_digests_of_what_made_it(
    own_policy: CollectConfig, states: States, tmp_path: Path
) -> None:
    write_states(tmp_path / "states.h5", states)
    folder = collect(own_policy, tmp_path / "out", QUIET)
    of_minari = json.loads((folder / "data" / "metadata.json").read_text())["digests"]
    stored = metadata_of(folder)
    assert stored is not None and stored.digests == of_minari
    assert of_minari["states"] == {"own": sha256(tmp_path / "states.h5")}
    file = "collected_policy.py"
    assert of_minari["policies"] == {"collected_policy:act": {file: sha256(tmp_path / file)}}
    assert of_minari["rope"] == RopeConfig().fingerprint and of_minari["versions"]["code"]


def test_transcripts_are_no_policy_of_a_dataset(states_path: str) -> None:
    with pytest.raises(InvalidInput, match="give knotgym evaluate --policy prompt:run"):
        config(states_path, policy=PolicyConfig(policy="prompt:run"))


def test_a_run_of_another_version_is_not_resumed(states_path: str, tmp_path: Path) -> None:
    folder = collect(config(states_path, episodes=1), tmp_path, QUIET)
    report = folder / "data" / "collection.json"
    said = json.loads(report.read_text())
    said["versions"]["mujoco"] = "3.0.0"
    report.write_text(json.dumps(said))
    with pytest.raises(InvalidInput, match='versions.mujoco is "3.0.0" there and') as caught:
        collect(config(states_path, episodes=1), tmp_path, RESUMED)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("settings", [{"episodes": 0}, {"seed": -1}])
def test_settings_that_make_no_sense_are_refused(
    settings: dict[str, Any], states_path: str
) -> None:
    with pytest.raises(InvalidInput):
        config(states_path, **settings)


@pytest.mark.parametrize(
    "words",
    [
        ["--policy", "genius"],
        ["--task", "knit"],
        ["--split", "dev"],
        ["--id", "no version"],
        ["--set", "policy.shares=a"],
    ],
)
def test_a_mistake_is_one_line_and_status_2(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        main(["collect", "--out", str(tmp_path), *words])
    assert left.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_limit_of_goals_is_kept_stored_and_verified(tmp_path: Path) -> None:
    words = ("--task", "tie", "--nx", 3, "--set", "task.max_goals=2", "--workers", 1, "--quiet")
    random = ("collect", "--policy", "random", "--episodes", 6, "--set", "task.horizon=2")
    assert knotgym(*random, "--observation", "state", *words, "--out", tmp_path) == 0
    (folder,) = tmp_path.glob("knotgym/tie-nx3/random-state-rules*-v0")  # a set of its own
    reader = EpisodeReader(folder)
    goals = [reader.attributes(k)["options/goal"] for k in range(6)]
    env = gym.make("knotgym/Tie-v0", nx=3, max_goals=2).unwrapped
    assert reader.task.max_goals == 2 and {*goals} == {*env.episodes.rows("goal")}  # type: ignore[attr-defined]
    said = json.loads((folder / "data" / "metadata.json").read_text())
    assert json.loads(said["env_spec"])["kwargs"]["max_goals"] == 2
    assert json.loads(said["eval_env_spec"])["kwargs"]["max_goals"] is None  # of the test split
    assert verify_episodes(folder) == []
    reader.close()
    with h5py.File(folder / "data" / "main_data.hdf5", "r+") as file:
        task = {**json.loads(file.attrs["task"]), "max_goals": 1}
        file.attrs["task"] = json.dumps(task)
    assert any("not of the first 1, max_goals" in fault for fault in verify_episodes(folder))
    scores = tmp_path / "scores.json"
    assert (
        knotgym("evaluate", "--episodes", 1, "--set", "task.horizon=1", *words, "--out", scores)
        == 0
    )
    assert json.loads(scores.read_text())["settings"]["task"]["max_goals"] == 2
    assert knotgym("evaluate", "--set", "task.max_goals=0", "--out", tmp_path / "none.json") == 2
    assert not (tmp_path / "none.json").exists()
