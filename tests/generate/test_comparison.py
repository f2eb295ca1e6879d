"""Results are compared in pairs of the same cell, episode by episode where starts are the same."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from pytest_types import Capture

from knotgym.common import InvalidFile
from knotgym.control import PolicyConfig
from knotgym.envs import TaskConfig
from knotgym.generate import EvaluateConfig, evaluate
from knotgym.generate.comparison import _difference, _scores_in
from knotgym.runs import RunOptions

from ..small_job import knotgym

Made = tuple[Path, Path]
TASK = TaskConfig(task="unknot", states="bench", engine="chain", observation="state", horizon=30)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """An entry of two policies that often reach the same goals, and the same as JSON."""
    folder = tmp_path_factory.mktemp("compared")
    policies = PolicyConfig(policy="random"), PolicyConfig(policy="scripted")
    config = EvaluateConfig(policies=policies, tasks=("unknot",), nx=(2,), episodes=64, task=TASK)
    found = folder / "entry.h5", folder / "scores.json"
    evaluate(config, RunOptions(workers=1, quiet=True), record=found[0], out=found[1])
    return found


@pytest.fixture(scope="module")
def scores(made: Made) -> list[Any]:
    """What the entry says, played again, and what the file of results says."""
    return [_scores_in(path) for path in made]


def test_pairs_of_episodes_make_the_interval_narrower(scores: list[Any]) -> None:
    first, second = scores[0]
    together, is_paired = _difference(second, first)
    apart, is_not = _difference(second._replace(seed=1), first)
    assert is_paired and not is_not and together.mean == pytest.approx(apart.mean)
    assert apart.low < together.low < together.mean < together.high < apart.high


def test_an_entry_compares_as_the_results_that_were_counted(scores: list[Any]) -> None:
    entry, counted = scores
    for one, other in zip(entry, counted, strict=True):
        assert _difference(one, other)[0][:3] == pytest.approx((0, -0.04, 0.04), abs=0.04)
        assert one.cell == other.cell and one.result.outcomes == other.result.outcomes


def test_the_command_draws_each_difference(made: Made, capsys: Capture, tmp_path: Path) -> None:
    assert knotgym("compare", *made) == 0
    said = capsys.readouterr().out
    assert "scores" in said and "3 of 3 paired" in said and "o" in said
    assert max(map(len, said.splitlines())) <= 80
    words = ("--policy", "random", "--task", "tie", "--nx", 2, "--episodes", 1, "--engine", "chain")
    other = tmp_path / "other.json"
    assert knotgym("evaluate", *words, "--out", other, "--workers", 1, "--quiet") == 0
    assert knotgym("compare", other, made[1]) == 0
    copy = shutil.copytree(made[1].parent, tmp_path / "b") / "scores.json"
    assert knotgym("compare", copy, made[1]) == 0
    said = capsys.readouterr().out
    assert "random, b" in said and "random, compared" in said
    assert knotgym("compare", other) == 2 and "no two results" in capsys.readouterr().err
    assert knotgym("compare") == 2 and knotgym("compare", tmp_path / "none.h5") == 2
    (tmp_path / "empty").touch()
    capsys.readouterr()
    assert knotgym("compare", tmp_path / "empty") == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"policy": "random",\n', '"policy": "ranLom",\n', "aren't those of its configuration"),
        ('"success_rate": 0.', '"success_rate": 0.1', "aren't those of its outcomes"),
    ],
)
def test_results_that_their_file_contradicts_are_refused(
    made: Made, tmp_path: Path, old: str, new: str, says: str
) -> None:
    text = made[1].read_text()
    head, results = text[: text.index('"results"')], text[text.index('"results"') :]
    assert old in results
    (tmp_path / "scores.json").write_text(head + results.replace(old, new, 1))
    with pytest.raises(InvalidFile, match=says):
        _scores_in(tmp_path / "scores.json")
