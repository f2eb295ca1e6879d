"""PPO with the paper's settings trains, resumes and is evaluated.

Needs -m clients and Stable-Baselines3.
"""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest

from knotgym.generate.episodes.suite_scores import read_scores

from ..scripts import ROOT, run_script
from ..small_job import knotgym

SCRIPT = ROOT / "baselines" / "ppo.py"
SMALL = ("--envs", 2, "--rollout", 32, "--batch", 32, "--epochs", 1, "--quiet")

no_sb3 = pytest.mark.skipif(
    importlib.util.find_spec("stable_baselines3") is None,
    reason="Stable-Baselines3 isn't installed",
)


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """Run the script with bad options; return the line that it prints."""
    with pytest.raises(SystemExit) as ended:
        run_script(SCRIPT, *words)
    told = capsys.readouterr()
    assert ended.value.code == 2 and told.out == ""
    [line] = told.err.splitlines()
    return line


def test_it_says_how_to_use_it(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        run_script(SCRIPT, "--help")
    assert ended.value.code == 0 and "usage: ppo.py" in capsys.readouterr().out
    assert "\n    python baselines/ppo.py" in SCRIPT.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--task", "braid"), "no task 'braid'; there is unknot, tie, convert"),
        (("--nx", 0), "nx must be a whole number from 1 to 11, got 0"),
        (("--nx", "two"), "argument --nx: invalid int value: 'two'; see --help"),
        (("--states", "none.h5"), "none.h5"),
        (("--observation", "symbolic"), "invalid choice: 'symbolic'"),
        (("--engine", "x"), "argument --engine: invalid choice: 'x'"),
        (("--tow-limit", 0), "tow_limit must be a number of metres above 0"),
        (("--steps", 0), "steps must be a whole number of at least 1, got 0"),
        (("--every", 0), "every must be a whole number of at least 1, got 0"),
        (("--episodes", -1), "episodes must be a whole number of at least 1"),
        (("--split", "dev"), "no split 'dev'"),
        (("--learning-rate", "nan"), "learning_rate must be above 0 and finite, got nan"),
        (("--batch", 48), "batch must be at least 2 and divide the 65536 steps of a rollout"),
        (("--resume",), "leave out --resume to begin one"),
    ],
)
def test_what_cannot_be_had_is_refused_in_a_line(
    words: tuple[object, ...],
    told: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if "--resume" in words:
        pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    assert told in refused(capsys, *words, "--out", "new")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.clients
@no_sb3
def test_it_trains_on_pictures_and_evaluate_takes_its_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    words = ("--image-size", 36, "--steps", 64, "--episodes", 1, "--split", "test")
    run_script(SCRIPT, *SMALL, *words, "--out", out)
    (row,) = read_scores([out / "evaluation.json"])
    found = (row["policy"], row["states"], row["split"], row["task"], row["nx"], row["episodes"])
    assert found == ("sb3-ppo-pixels", "readable", "test", "unknot", 2, 1)
    training = row["training"]
    assert (training["steps"], training["policy"]) == (64, "ActorCriticCnnPolicy")
    assert training["settings"]["learning_rate"] == 1e-5 and training["resumed_at"] == []
    task = ("--task", "unknot", "--nx", 2, "--observation", "pixels", "--set", "task.image_size=36")
    again = tmp_path / "again.json"
    monkeypatch.chdir(out)
    model = ("--policy", "model:act", "--episodes", 1, "--quiet", "--workers", 1)
    assert knotgym("evaluate", *task, *model, "--out", again) == 0
    (other,) = json.loads(again.read_text(encoding="utf-8"))["results"]
    assert (other["successes"], other["mean_return"]) == (
        row["successes"],
        json.loads((out / "evaluation.json").read_text())["results"][0]["mean_return"],
    )


@pytest.mark.clients
@no_sb3
def test_a_training_on_states_goes_on_for_as_many_steps_as_an_unbroken_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    chain = ("--engine", "chain", "--tow-limit", 0.04, "--observation", "state")
    words = (*SMALL, *chain, "--every", 128, "--episodes", 0, "--out", out)
    run_script(SCRIPT, *words, "--steps", 128)
    held = "isn't empty; name a new folder, or --resume the training in it"
    assert held in refused(capsys, *words)
    assert "seed is 0 there and 1 here" in refused(capsys, *words, "--resume", "--seed", 1)
    run_script(SCRIPT, *words, "--steps", 320, "--resume")
    names = [path.name for path in sorted((out / "checkpoints").iterdir())]
    assert names == ["000000128.zip", "000000256.zip", "000000320.zip"]
    assert (out / "model.zip").read_bytes() == (out / "checkpoints" / names[-1]).read_bytes()
    curve = json.loads((out / "curve.json").read_text(encoding="utf-8"))
    assert curve["resumed_at"] == [128]
    assert [row["steps"] for row in curve["rows"]] == [64, 128, 192, 256, 320]
    spent = [row["seconds"] for row in curve["rows"]]
    assert spent == sorted(spent) and sum(row["episodes"] for row in curve["rows"]) >= 4
    assert (out / "curve.png").read_bytes()[:4] == b"\x89PNG"
    (out / "checkpoints" / names[-1]).write_bytes(b"PK")
    assert "can't resume from" in refused(capsys, *words, "--steps", 999, "--resume")
