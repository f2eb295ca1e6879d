"""Learners of other libraries train, save and are evaluated; needs -m clients and the libraries."""

from __future__ import annotations

import importlib.util
import json
import os
from pathlib import Path

import pytest

from knotgym.control.policies import PolicyConfig, make_policy
from knotgym.generate.episodes.suite_scores import read_scores

from ..scripts import ROOT, run_script
from ..small_job import knotgym

FOLDER = ROOT / "examples" / "learners"
CHECKOUT = os.environ.get("KNOTGYM_OGBENCH", "")  # of OGBench, whose agents can't be installed
TINY = ("--steps", 2, "--batch", 4, "--task", "unknot", "--nx", 2, "--episodes", 1)

pytestmark = pytest.mark.clients
no_d3rlpy = pytest.mark.skipif(
    importlib.util.find_spec("d3rlpy") is None, reason="d3rlpy isn't installed"
)
no_ogbench = pytest.mark.skipif(
    not CHECKOUT or importlib.util.find_spec("jax") is None,
    reason="jax isn't installed, or KNOTGYM_OGBENCH names no checkout",
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("played")
    words = ("--task", "unknot", "--nx", 2, "--policy", "scripted", "--observation", "state")
    assert knotgym("collect", *words, "--episodes", 3, "--workers", 1, "--quiet", "--out", out) == 0
    return out / "knotgym/unknot-nx2/scripted-state-v0"


def check_scores(folder: Path, name: str) -> None:
    """Check the evaluation file, which `benchmarks/results.py` reads."""
    (row,) = read_scores([folder / "evaluation.json"])
    assert (row["policy"], row["task"], row["nx"], row["episodes"]) == (name, "unknot", 2, 1)
    assert row["training"]["steps"] == 2 and row["training"]["episodes"] == 6
    assert row["training"]["cpu_seconds"] > 0


def test_ppo_in_one_file_trains_and_acts(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    model, task = tmp_path / "ppo.pt", ("--task", "unknot", "--nx", 2, "--tow-limit", 0.04)
    few = ("--envs", 2, "--rollout", 4, "--batch", 4, "--epochs", 1, "--steps", 16)
    run_script(FOLDER / "online_ppo.py", *task, *few, "--out", model)
    words = ("--policy", model, "--engine", "chain", "--episodes", 1, "--horizon", 3)
    assert knotgym("evaluate", *task, *words, "--workers", 1, "--quiet") == 0


@no_d3rlpy
@pytest.mark.parametrize("learner", ["bc", "iql", "td3bc", "cql", "dt"])
def test_a_learner_of_d3rlpy_is_trained_and_measured(
    learner: str, dataset: Path, tmp_path: Path
) -> None:
    words = (learner, dataset, dataset, *TINY, "--out", tmp_path / "out")
    run_script(FOLDER / "offline_rl.py", *words)
    check_scores(tmp_path / "out", f"d3rlpy-{learner}")
    assert (tmp_path / "out" / "model.d3").is_file()
    if learner != "dt":
        make_policy(PolicyConfig(policy=str(tmp_path / "out" / "policy.pt")))


@no_d3rlpy
def test_a_learner_of_d3rlpy_learns_an_experts_labels(dataset: Path, tmp_path: Path) -> None:
    words = ("--task", "unknot", "--nx", 2, "--policy", "random", "--observation", "state")
    labels = ("--labels", "expert", "--budget", 8, "--episodes", 1, "--workers", 1, "--quiet")
    assert knotgym("collect", *words, *labels, "--out", tmp_path / "visited") == 0
    visited = ("--labelled", *(tmp_path / "visited" / "knotgym" / "unknot-nx2").iterdir())
    run_script(FOLDER / "offline_rl.py", "bc", dataset, *TINY, "--out", tmp_path / "out", *visited)
    (row,) = read_scores([tmp_path / "out" / "evaluation.json"])
    assert row["policy"] == "d3rlpy-bc-dagger" and row["training"]["episodes"] == 4


@no_ogbench
@pytest.mark.parametrize("learner", ["gcbc", "gcivl", "gciql", "crl", "hiql"])
def test_an_agent_of_ogbench_is_trained_and_measured(
    learner: str, dataset: Path, tmp_path: Path
) -> None:
    words = (learner, dataset, dataset, *TINY, "--ogbench", CHECKOUT, "--out", tmp_path / "out")
    run_script(FOLDER / "goal_conditioned.py", *words)
    check_scores(tmp_path / "out", f"ogbench-{learner}")
    told = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert told["training"]["library"].startswith("OGBench's agents, jax ")
    assert (tmp_path / "out" / "agent.msgpack").stat().st_size > 0
