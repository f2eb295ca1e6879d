import contextlib
import io
import json
import re
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from knotgym.common import InvalidInput, Occupied, Stream
from knotgym.control import PolicyConfig
from knotgym.datasets import Episodes
from knotgym.envs import TaskConfig
from knotgym.generate import evaluation as evaluating
from knotgym.generate.episode_configs import EvaluateConfig
from knotgym.generate.evaluation import _commit, _report, evaluate
from knotgym.generate.results import show
from knotgym.rope import RopeConfig
from knotgym.runs import RunOptions, identity

from ..small_job import knotgym

QUIET = RunOptions(workers=1, quiet=True)
CHAIN = TaskConfig(task="tie", engine="chain", observation="state", horizon=5)


def config(**settings: Any) -> EvaluateConfig:
    policies = tuple(PolicyConfig(policy=name) for name in settings.pop("policies", ("random",)))
    return EvaluateConfig(
        **{"policies": policies, "nx": (1,), "episodes": 9, "task": CHAIN, **settings}
    )


def printed(results: Any, engine: str = "mujoco") -> str:
    console = Console(record=True, width=80, file=io.StringIO())
    show(results, console, engine)
    return console.export_text()


def test_every_setup_gets_its_row_in_order() -> None:
    tasks, splits = ("unknot", "tie"), ("train", "test")
    results = evaluate(config(tasks=tasks, nx=(1, 2), splits=splits, episodes=1), QUIET)
    found = [(one.task, one.split, one.nx) for one in results]
    assert found == [(task, split, nx) for task in tasks for split in splits for nx in (1, 2)]


def test_an_expert_beats_random_and_says_what_planning_took() -> None:
    task = replace(CHAIN, horizon=25)
    worse, better = evaluate(config(policies=("random", "expert"), task=task, episodes=12), QUIET)
    assert better.success_rate > 0.8 > worse.success_rate
    assert better.planned_actions > 0 == worse.planned_actions
    assert better.mean_return == pytest.approx(10 * better.success_rate - 5)
    assert better.steps is not None and better.steps < 25
    assert "expert, tie nx 1, test: planned with" in printed([better])


def test_the_file_holds_the_rate_the_interval_and_the_settings(tmp_path: Path) -> None:
    made = config()
    results = evaluate(made, QUIET, out=tmp_path / "r.json")
    held = json.loads((tmp_path / "r.json").read_text())
    assert held == json.loads(json.dumps(_report(made, results, identity(made), {})))
    low, high = held["interval"]
    assert 0 <= low <= held["success_rate"] <= high <= 1
    assert held["config"]["seed"] == 0 and held["config"]["policies"][0]["policy"] == "random"
    assert held["rope"] == RopeConfig().fingerprint
    assert {"knotgym", "code", "mujoco"} <= held["versions"].keys()


def test_blocks_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    one = evaluate(config(), QUIET)
    monkeypatch.setattr(evaluating, "blocks", lambda *_: [range(4), range(4, 9)])
    assert one == evaluate(config(), QUIET)


def test_a_finished_evaluation_is_only_shown(tmp_path: Path, monkeypatch: Any) -> None:
    first = evaluate(config(), QUIET, out=tmp_path / "r.json")
    monkeypatch.setattr(evaluating, "_play", None)
    assert evaluate(config(), replace(QUIET, resume=True), out=tmp_path / "r.json") == first
    with pytest.raises(InvalidInput, match="config.seed is 0 there and 1 here"):
        evaluate(config(seed=1), replace(QUIET, resume=True), out=tmp_path / "r.json")


def test_what_lies_where_an_entry_or_a_film_was_asked_for_is_not_taken_for_it(
    tmp_path: Path,
) -> None:
    outputs: dict[str, Any] = {
        "out": tmp_path / "r.json", "video": tmp_path / "f.gif", "record": tmp_path / "e.h5"
    }  # fmt: skip
    first = evaluate(config(episodes=2), QUIET, **outputs)
    again = replace(QUIET, resume=True)
    assert evaluate(config(episodes=2), again, **outputs) == first
    other = tmp_path / "other.h5"
    evaluate(config(episodes=2, seed=1), QUIET, record=other)
    for name in ("video", "record"):
        with pytest.raises(Occupied, match="finished already, but .*other.* is another's"):
            wrong = other.with_suffix(outputs[name].suffix)
            wrong.write_bytes(other.read_bytes())
            evaluate(config(episodes=2), again, **{**outputs, name: wrong})


@pytest.mark.parametrize("one, other", [("out", "record"), ("out", "video"), ("record", "video")])
def test_two_outputs_are_not_one_file(
    one: str, other: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluating, "_play", None)
    (tmp_path / "link").symlink_to(tmp_path)
    for place in (tmp_path / "r.gif", tmp_path / "link" / "r.gif", tmp_path / "r.gif" / "r.gif"):
        outputs: dict[str, Any] = {one: tmp_path / "r.gif", other: place}
        with pytest.raises(Occupied, match="two outputs of one command"):
            evaluate(config(), replace(QUIET, overwrite=True), **outputs)
    assert not (tmp_path / "r.gif").exists()


def test_what_evaluate_writes_does_not_depend_on_how_it_is_run(tmp_path: Path) -> None:
    """A policy of one's own with a card, whose command was once claimed with its options."""
    (tmp_path / "still.py").write_text("CARD = {'seed': 1}\nact = lambda seen: [0.0] * 6\n")
    task = "--policy still:act --policy random --nx 1 --engine chain --set task.horizon=5"
    made = dict[str, list[bytes]]()
    with contextlib.chdir(tmp_path):
        for own in ("--workers 1", "--workers 2 --quiet --overwrite"):
            outputs = ("--out", "r.json", "--record", "e.h5", "--video", "f.gif")
            words = (*task.split(), *own.split(), "--episodes", 4, *outputs)
            assert knotgym("evaluate", *words) == 0
            for name in outputs[1::2]:
                made.setdefault(name, []).append(Path(name).read_bytes())
    assert {name: len({*some}) for name, some in made.items()} == dict.fromkeys(made, 1)


def test_no_output_replaces_the_settings(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(text := "[task]\nhorizon = 2\n")
    words = "--nx 1 --engine chain --policy random --episodes 1 --overwrite --settings".split()
    with contextlib.chdir(tmp_path):
        for name in ("--out", "--record", "--video"):
            assert knotgym("evaluate", *words, "s.toml", name, "s.toml") == 2
    assert (tmp_path / "s.toml").read_text() == text


def test_policies_of_one_name_have_a_row_each() -> None:
    noisy = tuple(PolicyConfig(policy="noisy", noise=one) for one in (0.9, 1.0))
    results = evaluate(replace(config(episodes=1), policies=noisy), QUIET)
    assert "noisy (2)" in printed(results)


def test_no_seed_makes_an_evaluation_play_the_episodes_of_a_dataset() -> None:
    streams = (Stream.EPISODE, Stream.EVALUATION_EPISODE)
    kept, scored = (
        {stream.derived_seed(seed, number) for seed in range(20) for number in range(200)}
        for stream in streams
    )
    assert not kept & scored
    # learners that train online seed rope i with s + i: below any seed of an evaluation
    assert min(scored) > 2**32
    played = Episodes.of(evaluating._play(PolicyConfig(), CHAIN, range(2), 0, True))
    assert played.episodes["seed"].tolist() == [
        Stream.EVALUATION_EPISODE.derived_seed(0, number) for number in range(2)
    ]


def test_a_film_shows_the_episodes_of_every_setup(tmp_path: Path) -> None:
    evaluate(config(nx=(1, 2), episodes=1), QUIET, video=tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as reel:
        assert getattr(reel, "n_frames", 1) >= 3 and np.ptp(np.asarray(reel)) > 0


def test_failures_are_listed_by_goal_and_filmed(tmp_path: Path, capsys: Any) -> None:
    line = "--nx 1 --engine chain --policy random --episodes 12 --set task.horizon=12 --workers 1"
    words = line.split()
    with contextlib.chdir(tmp_path):
        films = ("--video", "f.gif", "--failures", "--record", "e.h5")
        assert knotgym("evaluate", *words, *films, "--out", "r.json") == 0
        said = capsys.readouterr().out
        assert knotgym("dataset", "show", "e.h5") == 0
        (result,) = json.loads(Path("r.json").read_text())["results"]
        success, steps = (result["outcomes"][name] for name in ("success", "steps"))
        missed = [k for k, reached in enumerate(success) if not reached]
        assert 0 < len(missed) < 12
        with Image.open("f.gif") as film:
            assert getattr(film, "n_frames", 1) == sum(steps[k] + 1 for k in missed[:2])
        listed = re.findall(
            r"(\S+) +(\d+) +(\d+) *$", said.split("goals that failed most")[1], re.M
        )
        assert sum(int(count) for _, count, _ in listed) == len(missed)
        shown = " ".join(capsys.readouterr().out.split())
        assert f"missed goals {listed[0][0]} {listed[0][1]} of {listed[0][2]}" in shown
        easy = line.replace("random", "expert").replace("=12", "=50").split()
        assert knotgym("evaluate", *easy, "--video", "g.gif", "--failures") == 1
        assert "no failure to film" in capsys.readouterr().err and not Path("g.gif").exists()


def test_the_command_prints_the_matrix(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--nx", "1,2", "--split", "train,test", "--episodes", 1, "--engine", "chain")
    assert knotgym("evaluate", *words, "--set", "task.horizon=2", "--workers", 1) == 0
    assert "success, %" in capsys.readouterr().out


def test_only_the_checkout_that_holds_the_package_gives_its_commit(tmp_path: Path) -> None:
    module = tmp_path / ".venv" / "evaluation.py"
    module.parent.mkdir()
    module.touch()
    git = ("git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c")
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "a checkout around"], check=True)
    assert _commit(module) == ""
    subprocess.run([*git, "add", str(module)], check=True)
    assert len(_commit(module)) == 40
