import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from knotgym.control.policies import PolicyConfig
from knotgym.generate.episodes.evaluate import EvaluateConfig, Result, report
from knotgym.generate.episodes.suite_scores import InvalidScores, read_scores, score_tables
from knotgym.tasks import TaskConfig

RESULT = Result(
    policy="random",
    task="tie",
    nx=2,
    split="test",
    episodes=64,
    successes=16,
    success_rate=0.25,
    low=0.16,
    high=0.37,
    steps=20.0,
    mean_return=-2.5,
    planned_actions=0.0,
    planning_seconds=0.0,
    simulation_failures=0,
    start_states="own",
    goal_states="own",
)


def told(path: Path, seed: int, successes: int, episodes: int, **rules: Any) -> Path:
    """A file of `knotgym evaluate --out`."""
    config = EvaluateConfig(
        policies=(PolicyConfig(),),
        tasks=("tie",),
        nx=(2,),
        splits=("test",),
        episodes=episodes,
        seed=seed,
        task=TaskConfig(task="tie", **rules),
    )
    result = replace(
        RESULT, episodes=episodes, successes=successes, success_rate=successes / episodes
    )
    path.write_text(json.dumps(report(config, [result])), encoding="utf-8")
    return path


def test_files_of_one_set_up_with_other_seeds_are_counted_together(tmp_path: Path) -> None:
    files = [told(tmp_path / "a", 1, 16, 64), told(tmp_path / "b", 2, 80, 192)]
    (row,) = read_scores(files)
    assert (row["successes"], row["episodes"], row["success_rate"]) == (96, 256, 0.375)
    assert row["seeds"] == [1, 2] and row["steps"] == 20.0
    low, high = row["interval"]
    assert 0.317 < low < 0.319 and 0.435 < high < 0.437  # Wilson, of 96 in 256
    assert read_scores(files[::-1]) == [row]


def test_a_file_from_before_a_rule_came_is_of_its_default(tmp_path: Path) -> None:
    files = [told(tmp_path / "a", 1, 16, 64), told(tmp_path / "b", 2, 80, 192)]
    old = json.loads(files[0].read_text(encoding="utf-8"))
    del old["settings"]["task"]["max_goals"]
    files[0].write_text(json.dumps(old), encoding="utf-8")
    (row,) = read_scores(files)
    assert row["episodes"] == 256 and row["rules"]["max_goals"] is None


def test_the_same_episodes_twice_and_other_rules_are_refused(tmp_path: Path) -> None:
    first = told(tmp_path / "a", 1, 16, 64)
    with pytest.raises(InvalidScores, match=r"b tells once more of random, readable, test, tie, 2"):
        read_scores([first, told(tmp_path / "b", 1, 80, 192)])
    with pytest.raises(InvalidScores, match="by other rules, another version or other weights"):
        read_scores([first, told(tmp_path / "b", 2, 80, 192, horizon=20)])


def test_a_learner_s_training_stands_beside_its_scores_and_weights_are_not_mixed(
    tmp_path: Path,
) -> None:
    files = [told(tmp_path / "a", 1, 16, 64), told(tmp_path / "b", 2, 80, 192)]
    for path, digest in zip(files, ("ab", "cd"), strict=True):
        said = json.loads(path.read_text())
        said["learners"] = {"random": {"weights_sha256": digest, "seconds": 766, "episodes": 810}}
        path.write_text(json.dumps(said))
    assert "| random |" in (page := "\n".join(score_tables(read_scores(files[:1]))))
    assert re.search(r"\| random \|.*\| 766 \|$", page, re.M)
    with pytest.raises(InvalidScores, match="other weights"):
        read_scores(files)


@pytest.mark.parametrize("name, value", [("policy", []), ("split", "\x1b[2J"), ("nx", "2")])
def test_what_no_evaluation_says_is_refused(name: str, value: Any, tmp_path: Path) -> None:
    path = told(tmp_path / "a", seed=0, successes=1, episodes=2)
    said = json.loads(path.read_text())
    said["results"][0][name] = value
    path.write_text(json.dumps(said))
    with pytest.raises(InvalidScores, match=f"evaluate --out`: {name} is"):
        read_scores([path])


@pytest.mark.parametrize("name", ["success_rate", "seconds"])
def test_numbers_beyond_all_bounds_are_refused(name: str, tmp_path: Path) -> None:
    path = told(tmp_path / "a", seed=0, successes=1, episodes=2)
    said = json.loads(path.read_text())
    holder = said["results"][0] if name == "success_rate" else said.setdefault("training", {})
    holder[name] = 10**400
    path.write_text(json.dumps(said))
    with pytest.raises(InvalidScores, match="evaluate --out`"):
        read_scores([path])
