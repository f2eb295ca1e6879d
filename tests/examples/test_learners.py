"""Learners of other libraries train, save and are evaluated; needs -m clients and the libraries."""

from __future__ import annotations

import importlib.util
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.control import rollouts
from knotgym.datasets import columns_of
from knotgym.generate import read_scores

from ..scripts import ROOT, run_script
from ..small_job import knotgym

FOLDER = ROOT / "examples" / "learners"
CHECKOUT = os.environ.get("KNOTGYM_OGBENCH", "")  # of OGBench, whose agents can't be installed
TINY = ("--steps", 2, "--batch", 4, "--task", "unknot", "--nx", 2, "--episodes", 1)

pytestmark = pytest.mark.clients
no_d3rlpy = pytest.mark.skipif(
    importlib.util.find_spec("d3rlpy") is None, reason="d3rlpy isn't installed"
)
no_torch = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="torch isn't installed"
)
no_ogbench = pytest.mark.skipif(
    not CHECKOUT or importlib.util.find_spec("jax") is None,
    reason="jax isn't installed, or KNOTGYM_OGBENCH names no checkout",
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("played")
    words = ("--task", "tie", "--nx", 2, "--policy", "expert", "--observation", "state")
    assert knotgym("collect", *words, "--episodes", 3, "--workers", 1, "--quiet", "--out", out) == 0
    return out / "knotgym/tie-nx2/expert-v0"


def check_scores(folder: Path, name: str) -> None:
    """Check the evaluation file, which `benchmarks/results.py` reads."""
    (row,) = read_scores([folder / "evaluation.json"])
    assert (row["policy"], row["task"], row["nx"], row["episodes"]) == (name, "unknot", 2, 1)
    assert row["training"]["steps"] == 2 and row["training"]["episodes"] == 6
    assert row["training"]["cpu_seconds"] > 0


def test_ppo_in_one_file_trains_and_acts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    task = ("--task", "unknot", "--nx", 2)
    few = ("--envs", 2, "--rollout", 4, "--batch", 4, "--epochs", 1, "--steps", 16)
    run_script(FOLDER / "online_ppo.py", *task, *few, "--out", tmp_path / "ppo.pt")
    monkeypatch.chdir(tmp_path)
    words = ("--policy", "ppo:act", "--engine", "chain", "--episodes", 1, "--set", "task.horizon=3")
    assert knotgym("evaluate", *task, *words, "--workers", 1, "--quiet") == 0


@no_d3rlpy
@pytest.mark.parametrize(
    "learner", ["discrete-bc", "discrete-cql", "bc", "td3bc", "iql", "cql", "dt"]
)
def test_a_learner_of_d3rlpy_is_trained_and_measured(
    learner: str, dataset: Path, tmp_path: Path
) -> None:
    dense = ("--width", 0, "--frame", "world") if learner == "iql" else ()
    words = (learner, dataset, dataset, *TINY, *dense, "--out", tmp_path / "out")
    run_script(FOLDER / "offline_rl.py", *words)
    check_scores(tmp_path / "out", f"d3rlpy-{learner}")
    assert (tmp_path / "out" / "model.pt").is_file()


@no_torch
def test_chunked_learners_are_trained_and_measured(dataset: Path, tmp_path: Path) -> None:
    for learner in ("flow", "qc"):
        words = (learner, dataset, dataset, *TINY, "--out", tmp_path / learner)
        flow = () if learner == "flow" else ("--flow", tmp_path / "flow" / "flow.pt")
        run_script(FOLDER / "chunked.py", *words, *flow)
        check_scores(tmp_path / learner, f"torch-{learner}")


@no_torch
@pytest.mark.parametrize("frame", ["rope", "world"])
def test_decisions_read_from_an_expert_and_acted_out_are_its_pulls(
    frame: str, dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    from decisions import ChunkPolicy, nearest, read

    rows = read([str(dataset)], frame)

    class Remembering(ChunkPolicy):
        def choose(self, indices: list[int], seen: Any, points: Any) -> tuple[Any, Any]:
            offsets = np.abs(seen[:, None] - rows.observations).max(axis=2)
            return nearest(rows.chunks[offsets.argmin(axis=1)], points)

    own = columns_of(dataset)
    played = rollouts(Remembering("remembering", frame), own.task, own.episodes.episodes)
    assert np.array_equal(played.steps["bead"], own.episodes.steps["bead"])


@no_ogbench
@pytest.mark.parametrize("learner", ["gcbc", "gcivl", "gciql", "crl", "hiql"])
def test_an_agent_of_ogbench_is_trained_and_measured(
    learner: str, dataset: Path, tmp_path: Path
) -> None:
    words = (learner, dataset, dataset, *TINY, "--ogbench", CHECKOUT, "--out", tmp_path / "out")
    run_script(FOLDER / "goal_conditioned.py", *words)
    check_scores(tmp_path / "out", f"ogbench-{learner}")
    told = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert told["learners"][f"ogbench-{learner}"]["library"].startswith("OGBench's agents, jax ")
    assert (tmp_path / "out" / "agent.msgpack").stat().st_size > 0
