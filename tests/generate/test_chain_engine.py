"""Everything that a run writes with engine="chain" says so, is the same bytes however it was made,
and is replayed and verified with that engine alone.
"""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest

from knotgym.cli.inspection import film, merge
from knotgym.common.errors import InvalidFile, InvalidInput, KnotgymError
from knotgym.control.old_policies import make_policy
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import rollout
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_verification import episode_faults, replay, verify_episodes
from knotgym.datasets.state_verification import folder_faults
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect import collect, distinct_id
from knotgym.generate.episodes.collect_config import CollectConfig
from knotgym.generate.episodes.evaluate import run as evaluate
from knotgym.generate.episodes.evaluate_config import EvaluateConfig
from knotgym.generate.episodes.suite import SuiteConfig
from knotgym.generate.episodes.suite_scores import read_scores
from knotgym.generate.states.generate_config import GenerateConfig, PlayConfig
from knotgym.generate.states.state_recipe import make_states
from knotgym.rope.model import Rope
from knotgym.runs.progress import Progress
from knotgym.runs.run_options import RunOptions
from knotgym.states.state_file import merge_states, read_states

from ..small_job import knotgym

QUIET = RunOptions(workers=1, quiet=True)
TASK = TaskConfig(task="tie", nx=2, observation="state", horizon=5, engine="chain")


def config(**settings: Any) -> CollectConfig:
    policy = PolicyConfig(policy="random")
    return CollectConfig(**{"task": TASK, "policy": policy, "episodes": 6, **settings})


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small dataset of each engine."""
    folder = tmp_path_factory.mktemp("engines")
    for engine in ("chain", "mujoco"):
        collect(config(task=replace(TASK, engine=engine), episodes=2), folder, QUIET)
    return folder


def dataset(root: Path, engine: str) -> Path:
    return root / "knotgym/tie-nx2" / {"chain": "random-chain-v0", "mujoco": "random-v0"}[engine]


def test_a_dataset_names_its_engine_wherever_it_is_described(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader = EpisodeReader(dataset(root, "chain"))
    assert reader.task.engine == "chain"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    loaded = minari.load_dataset("knotgym/tie-nx2/random-chain-v0")
    assert loaded.recover_environment().unwrapped.episodes.simulation.engine == "chain"
    assert "engine chain" in loaded.storage.metadata["description"]
    assert loaded.storage.metadata.get("ref_min_score") is None  # MuJoCo's
    whole = config(task=replace(TASK, horizon=50))
    assert distinct_id(whole) == "knotgym/tie-nx2/random-chain-state-v0"
    ids = {one.dataset_id for one in SuiteConfig(engine="chain").sets()}
    assert not ids & {one.dataset_id for one in SuiteConfig().sets()}


def test_episodes_replay_bit_for_bit_with_their_engine_alone(root: Path) -> None:
    for engine, other in (("chain", "mujoco"), ("mujoco", "chain")):
        assert verify_episodes(dataset(root, engine), act_out=True) == []
        reader = EpisodeReader(dataset(root, engine))
        episodes = list(reader)
        assert None not in replay(episodes, replace(reader.task, engine=other))


def test_an_episode_is_filmed_with_its_engine(root: Path, tmp_path: Path) -> None:
    said = film(str(dataset(root, "chain")), 1, tmp_path / "f.gif", False, Progress(quiet=True))
    assert said == "bit for bit the same, 5 steps"


def test_shares_that_the_engine_cannot_apply_are_faults(root: Path) -> None:
    (episode, _), rope = EpisodeReader(dataset(root, "chain")), Rope()
    shares = episode.applied_share.copy()
    shares[2] = 5 / 1536
    partly = replace(episode, applied_share=shares, force=shares[:, None] * episode.force)
    assert episode_faults(partly, TASK, rope) == []
    assert "applied_share is 0.0032" in " ".join(
        episode_faults(partly, replace(TASK, engine="mujoco"), rope)
    )
    shares[2] = 0.123
    partly = replace(partly, force=shares[:, None] * episode.force)
    assert "should be a multiple of 1/1536" in " ".join(episode_faults(partly, TASK, rope))


def test_an_action_that_is_taken_back_shows_in_info() -> None:
    env: Any = gym.make("knotgym/Tie-v0", nx=2, engine="chain", observation="state").unwrapped
    env.reset(seed=0)
    simulation = env.episodes.simulation
    states = simulation.states().reshape(1, 100, 10)
    states[0, :, 3:6] = np.random.default_rng(0).normal(0, 1e9, (100, 3))  # m/s
    simulation.restore(states)
    before = simulation.points.copy()
    info = env.step(np.full(6, 0.5, dtype=np.float32))[4]
    assert info["applied_share"] < 1 and not info["simulation_failed"]
    assert np.allclose(info["force"], info["applied_share"] * 0.1)
    assert np.array_equal(simulation.points, before) and simulation.steps_reduced == 1
    assert env.step(np.full(6, 0.5, dtype=np.float32))[4]["applied_share"] == 1.0


def test_states_that_lie_as_they_are_stored_show_the_code_that_info_says() -> None:
    from knotgym.topology.crossings import label

    env: Any = gym.make(
        *("knotgym/Unknot-v0",), nx=4, engine="chain", reset_noise=0, states="random-walk"
    ).unwrapped
    for row in env.episodes.rows("start")[:20].tolist():
        info = env.reset(seed=0, options={"start": row})[1]
        assert info["gauss_code_chiral"] == label(env.episodes.simulation.points[0]).chiral


@pytest.mark.parametrize(
    "keywords", [{"camera": "perspective"}, {"views": ["left"], "depth": True}]
)
def test_pictures_are_of_the_rope_whatever_moves_it(keywords: dict[str, Any]) -> None:
    pictures = []
    for engine in ("mujoco", "chain"):
        env = gym.make("knotgym/Tie-v0", nx=2, engine=engine, **keywords)
        pictures.append(env.reset(seed=3)[0])
    assert np.abs(pictures[0].astype(int) - pictures[1]).max() <= 2


@pytest.mark.thorough
def test_the_bytes_depend_neither_on_workers_nor_on_company(tmp_path: Path) -> None:
    made = [
        collect(
            config(episodes_per_file=size), tmp_path / str(size), replace(QUIET, workers=workers)
        )
        for size, workers in ((3, 1), (1, 2), (6, 1))
    ]
    bytes_ = {(one / "data" / "main_data.hdf5").read_bytes() for one in made}
    assert len(bytes_) == 1


@pytest.mark.slow  # compiles for half a minute
def test_a_fresh_compilation_collects_the_same_bytes_as_a_cached_one(tmp_path: Path) -> None:
    words = (
        "collect",
        "--task",
        "tie",
        "--policy",
        "random",
        "--episodes",
        "2",
        "--set",
        "task.horizon=5",
    )
    found = []
    for name in ("cold", "warm"):
        subprocess.run(
            [sys.executable, "-m", "knotgym", *words, "--engine", "chain", "--workers", "1"]
            + ["--quiet", "--out", str(tmp_path / name), "--id", "a/b-v0"],
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
            check=True,
        )
        found.append((tmp_path / name / "a/b-v0/data/main_data.hdf5").read_bytes())
    assert found[0] == found[1] and any((tmp_path / "cache").rglob("solver.advance*.nbc"))


def test_datasets_of_two_engines_are_not_merged(root: Path, tmp_path: Path) -> None:
    both = [str(dataset(root, engine)) for engine in ("chain", "mujoco")]
    with pytest.raises(KnotgymError, match="must be of one engine; .* is of chain, .* of mujoco"):
        merge(both, tmp_path / "both.h5", overwrite=False)
    assert not any(tmp_path.iterdir())


def test_a_run_is_not_resumed_with_another_engine(root: Path) -> None:
    other = config(task=replace(TASK, engine="mujoco"), episodes=2, dataset_id=config().dataset_id)
    with pytest.raises(InvalidInput, match="engine"):
        collect(other, root, replace(QUIET, resume=True))


def test_results_of_two_engines_are_not_pooled(tmp_path: Path) -> None:
    files = []
    for engine, seed in (("mujoco", 0), ("chain", 1), ("chain", 2)):
        files.append(tmp_path / f"{engine}{seed}.json")
        asked = EvaluateConfig(
            policies=(PolicyConfig(policy="random"),),
            episodes=2,
            seed=seed,
            task=replace(TASK, horizon=2, engine=engine),
        )
        evaluate(asked, QUIET, out=files[-1])
    rows = read_scores(files)
    told = [(row["episodes"], 'engine="chain"' in row["settings"]) for row in rows]
    assert sorted(told) == [(2, False), (4, True)]
    with pytest.raises(InvalidInput, match="engine"):
        evaluate(asked, replace(QUIET, resume=True), out=files[0])


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    walk = PlayConfig(settle=0, random=30, opening=0, rounds=0, first=12, every=2, ropes=3)
    small = GenerateConfig(
        nx=(1,), count=2, source="random-walk", walk=walk, engine="chain", demonstrations=False
    )
    return make_states(small, tmp_path_factory.mktemp("walked") / "walks", QUIET)


def test_states_of_random_walks_are_verified_with_their_engine(walked: Path) -> None:
    assert list(folder_faults(walked)) == []
    assert "with engine chain and seed 0" in (walked / "README.md").read_text(encoding="utf-8")
    file = walked / "states.h5"
    states = read_states(file)
    assert states.engine == "chain"
    with pytest.raises(InvalidFile, match="must be of one engine, got chain and mujoco"):
        merge_states(
            [states, replace(states, attributes={**states.attributes, "engine": "mujoco"})]
        )


def test_a_file_that_names_another_engine_has_faults(walked: Path, tmp_path: Path) -> None:
    for engine, fault in (("mujoco", "does not end in qpos bit for bit"), ("x", "no engine 'x'")):
        folder = tmp_path / engine
        folder.mkdir()
        for name in ("states.h5", "manifest.json"):
            (folder / name).write_bytes((walked / name).read_bytes())
        with h5py.File(folder / "states.h5", "r+") as states:
            states.attrs["engine"] = engine
        assert any(fault in one for one in folder_faults(folder))


@pytest.mark.slow
def test_demonstrations_are_verified_with_their_engine(tmp_path: Path) -> None:
    out = tmp_path / "nx1"
    words = ("generate", "--nx", "1", "--count", "2", "--engine", "chain", "--workers", "1")
    assert knotgym(*words, "--quiet", "--out", out) == 0
    assert list(folder_faults(out)) == [] and (out / "minari").is_dir()


def test_the_expert_plans_in_the_engine_of_the_environment() -> None:
    policy = make_policy(PolicyConfig(policy="expert"))
    task = replace(TASK, task="unknot", nx=1, horizon=20)
    (played,) = rollout(task, policy, [0], 0)
    assert played.success
