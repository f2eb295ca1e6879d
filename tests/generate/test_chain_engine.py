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
import numpy as np
import pytest

from knotgym.common.errors import InvalidInput
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.verification import replay
from knotgym.datasets.state_verification import folder_faults
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.evaluate import run as evaluate
from knotgym.generate.episodes.evaluate_config import EvaluateConfig
from knotgym.generate.episodes.suite_scores import read_scores
from knotgym.runs.run_options import RunOptions

from ..small_job import knotgym

QUIET = RunOptions(workers=1, quiet=True)
TASK = TaskConfig(task="tie", nx=2, observation="state", horizon=5, engine="chain")


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
    assert np.array_equal(simulation.points, before)
    assert env.step(np.full(6, 0.5, dtype=np.float32))[4]["applied_share"] == 1.0


def test_states_that_lie_as_they_are_stored_show_the_code_that_info_says() -> None:
    from knotgym.topology.crossings import label

    env: Any = gym.make(
        *("knotgym/Unknot-v0",), nx=4, engine="chain", reset_noise=0, states="random-walk"
    ).unwrapped
    for row in env.episodes.rows["start"][:20].tolist():
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


@pytest.mark.slow  # compiles for half a minute
def test_a_fresh_compilation_collects_the_same_bytes_as_a_cached_one(tmp_path: Path) -> None:
    words = "collect --task tie --policy random --episodes 2 --set task.horizon=5".split()
    found = []
    for name in ("cold", "warm"):
        subprocess.run(
            [sys.executable, "-m", "knotgym", *words, "--engine", "chain", "--workers", "1"]
            + ["--quiet", "--out", str(tmp_path / name), "--id", "a/b-v0"],
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
            check=True,
        )
        found.append((tmp_path / name / "a/b-v0/data/episodes.h5").read_bytes())
    assert found[0] == found[1] and any((tmp_path / "cache").rglob("solver.advance*.nbc"))


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


@pytest.mark.slow
def test_demonstrations_are_verified_with_their_engine(tmp_path: Path) -> None:
    out = tmp_path / "nx1"
    words = ("generate", "--nx", "1", "--count", "2", "--engine", "chain", "--workers", "1")
    assert knotgym(*words, "--quiet", "--out", out) == 0
    assert list(folder_faults(out, replay)) == [] and (out / "minari").is_dir()
