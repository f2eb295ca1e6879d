import json
import runpy
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common import InvalidFile, Table
from knotgym.control import PolicyConfig, PullPlannerConfig
from knotgym.datasets import RECORDED
from knotgym.envs import TaskConfig
from knotgym.generate import EvaluateConfig, Result
from knotgym.runs import cluster_interval, identity

from ..scripts import ROOT

read_scores: Any = runpy.run_path(str(ROOT / "benchmarks" / "scores.py"))["read_scores"]
STARTS = 8


def told(
    path: Path, seed: int, successes: int, episodes: int, budget: int = 60000, **rules: Any
) -> Path:
    """A file of `knotgym evaluate --out`, whose first episodes succeed."""
    policy = PolicyConfig(planner=PullPlannerConfig(budget=budget))
    task = TaskConfig(task="tie", nx=2, split="test", observation="state", **rules)
    config = EvaluateConfig(
        policies=(policy,), tasks=("tie",), episodes=episodes, seed=seed, task=task
    )
    number, count = np.arange(episodes), np.zeros(episodes, dtype=np.int64)
    columns = {
        "start": number % STARTS,
        "goal": number % 5,
        "success": number < successes,
        "length": count + 20,
        "return_": count - 2.5,
        "planner_steps": count,
        "diverged": count > 0,
    }
    played = Table(RECORDED.only(*columns), columns)
    results = [asdict(Result.of(policy.policy, "pull", task, played))]
    path.write_text(json.dumps({**identity(config), "learners": {}, "results": results}))
    return path


def changed(path: Path, *place: Any, value: Any) -> None:
    """Write `value` at a place of a JSON file."""
    said = inner = json.loads(path.read_text())
    for name in place[:-1]:
        inner = inner[name]
    inner[place[-1]] = value
    path.write_text(json.dumps(said))


def test_files_of_one_cell_with_other_seeds_are_counted_together(tmp_path: Path) -> None:
    files = [told(tmp_path / "a", 1, 16, 64), told(tmp_path / "b", 2, 80, 192)]
    (row,) = read_scores(files)
    assert (row["successes"], row["episodes"], row["success_rate"]) == (96, 256, 0.375)
    assert row["seeds"] == [1, 2] and row["steps"] == 20.0
    assert (row["starts"], row["goals"]) == (STARTS, 5)
    episodes = [(number, number < most) for most, n in ((16, 64), (80, 192)) for number in range(n)]
    success = [int(reached) for _, reached in episodes]
    clusters = [[number % count for number, _ in episodes] for count in (STARTS, 5)]
    assert row["interval"] == list(cluster_interval(success, *clusters))
    assert read_scores(files[::-1]) == [row]


def test_the_same_episodes_twice_are_refused(tmp_path: Path) -> None:
    first = told(tmp_path / "a", 1, 16, 64)
    with pytest.raises(InvalidFile, match="b repeats episodes of random, readable, test"):
        read_scores([first, told(tmp_path / "b", 1, 80, 192)])


@pytest.mark.parametrize(
    "place, value",
    [
        (("source", "policies", "random"), {"model.pt": "ab"}),
        (("source", "states", "shipped"), "cd"),
        (("versions", "code"), "ef"),
        (("versions", "mujoco"), "0"),
        (("config", "policies", 0, "planner", "budget"), 7),
        (("config", "task", "horizon"), 20),
        (("config", "task", "engine"), "chain"),
    ],
)
def test_what_was_played_otherwise_is_never_in_one_row(
    place: tuple[Any, ...], value: Any, tmp_path: Path
) -> None:
    files = [told(tmp_path / "a", 1, 16, 64), told(tmp_path / "b", 2, 80, 192)]
    changed(files[1], *place, value=value)
    assert sorted(row["episodes"] for row in read_scores(files)) == [64, 192]


def test_budgets_and_rules_that_differ_are_named(tmp_path: Path) -> None:
    (row,) = read_scores([told(tmp_path / "a", 1, 16, 64, budget=7, horizon=20)])
    assert row["settings"] == "horizon=20; planner.budget=7"


def test_a_learner_s_training_stands_beside_its_scores(tmp_path: Path) -> None:
    path = told(tmp_path / "a", 1, 16, 64)
    changed(path, "learners", value={"random": {"seconds": 766}})
    assert read_scores([path])[0]["training"] == {"seconds": 766}


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("results", 0, "outcomes", "goal"), [0]),
        (("results", 0, "outcomes", "success"), [2] * 4),
        (("results", 0, "outcomes", "start"), [-1] * 4),
        (("results", 0, "outcomes", "steps"), "1234"),
        (("results", 0, "policy"), []),
        (("results", 0, "split"), "\x1b[2J"),
        (("results", 0, "nx"), "2"),
        (("results", 0, "planned_actions"), 10**400),
        (("learners", "random"), {"seconds": 10**400}),
        (("versions",), {}),
        (("source",), "none"),
    ],
)
def test_what_no_evaluation_says_is_refused(
    place: tuple[Any, ...], value: Any, tmp_path: Path
) -> None:
    path = told(tmp_path / "a", 1, 2, 4)
    changed(path, *place, value=value)
    with pytest.raises(InvalidFile, match="isn't a file of `knotgym evaluate --out`"):
        read_scores([path])
