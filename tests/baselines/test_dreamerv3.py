"""The adapter to the official DreamerV3.

With -m clients, and KNOTGYM_DREAMERV3 naming a checkout, the official code itself is run.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.suite_scores import read_scores

from ..scripts import ROOT, run_script

FOLDER = ROOT / "baselines" / "dreamerv3"
SCRIPT = FOLDER / "train_dreamerv3.py"
CHECKOUT = os.environ.get("KNOTGYM_DREAMERV3", "")


def space(*words: object) -> tuple[object, ...]:
    """A stand-in for `elements.Space`."""
    return words


@pytest.fixture
def adapter() -> Iterator[Any]:
    """Import the module as the script does."""
    with mock.patch.object(sys, "path", [str(FOLDER), *sys.path]):
        import dreamer_rope

        yield dreamer_rope


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """Run the script with bad options; return the line that it prints."""
    with pytest.raises(SystemExit) as ended:
        run_script(SCRIPT, *words)
    told = capsys.readouterr()
    assert ended.value.code == 2 and told.out == ""
    [line] = told.err.splitlines()
    return line


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "it has no dreamerv3/main.py"),
        (("--task", "braid"), "no task 'braid'"),
        (("--image-size", 60), "image_size must be 48, 64, 80, 96, 112 or 128"),
        (("--steps", 0), "steps must be a whole number of at least 1, got 0"),
        (("--settings", "huge"), "no settings 'huge'; choose from paper, small"),
        (("--set", "run.envs"), "--set takes NAME=VALUE with one of configs, "),
        (("--set", "run.env=8"), "got 'run.env=8'"),
        (("--set", "run.envs=many"), "run.envs must be like 32, got 'many'"),
        (("--episodes", -1), "episodes must be a whole number of at least 1"),
    ],
)
def test_what_cannot_be_had_is_refused_in_a_line(
    words: tuple[object, ...],
    told: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert told in refused(capsys, *words, "--checkout", ".", "--out", "new")
    assert list(tmp_path.iterdir()) == []


def test_the_rope_is_seen_as_the_environment_shows_it(adapter: Any) -> None:
    rope = adapter.DreamerRope(TaskConfig(task="unknot"), np.random.default_rng(0), space)
    assert rope.obs_space["image"] == (np.uint8, (128, 256, 3))
    assert rope.act_space["action"] == (np.float32, (6,), -1.0, 1.0)
    seen = rope.step({"action": np.zeros(6), "reset": True})
    assert seen.keys() == rope.obs_space.keys()
    assert seen["image"].shape == (128, 256, 3) and seen["image"].dtype == np.uint8
    assert (seen["is_first"], seen["is_last"], seen["reward"]) == (True, False, 0.0)


def test_an_episode_cut_off_is_no_terminal_one_and_the_next_begins(adapter: Any) -> None:
    task = TaskConfig(task="tie", nx=4, horizon=2, image_size=48)
    rope = adapter.DreamerRope(task, np.random.default_rng(0), space)
    still = {"action": np.zeros(6, dtype=np.float32), "reset": False}
    steps = [rope.step(still) for _ in range(4)]
    assert [step["is_first"] for step in steps] == [True, False, False, True]
    assert [step["is_last"] for step in steps] == [False, False, True, False]
    assert [step["reward"] for step in steps] == [0.0, 0.0, -5.0, 0.0]
    assert not any(step["is_terminal"] for step in steps)


@pytest.mark.clients
@pytest.mark.skipif(not CHECKOUT, reason="KNOTGYM_DREAMERV3 names no checkout")
def test_the_official_code_trains_resumes_and_is_evaluated(tmp_path: Path) -> None:
    out = tmp_path / "out"
    small = ("--settings", "small", "--set", "run.log_every=1", "--image-size", 48)
    words = ("--checkout", CHECKOUT, *small, "--out", out)
    tried = ("--episodes", 1, "--split", "test", "--quiet")
    for more in (("--steps", 300), ("--steps", 400, "--resume")):
        command = [sys.executable, SCRIPT, *words, *tried, *more]
        subprocess.run([str(word) for word in command], cwd=ROOT, check=True)
    (row,) = read_scores([out / "evaluation.json"])
    assert (row["policy"], row["task"], row["nx"], row["episodes"]) == ("dreamerv3", "unknot", 2, 1)
    assert row["training"]["steps"] >= 400 and row["training"]["parameters"] > 0
    (before,) = row["training"]["resumed_at"]
    assert 300 <= before < 400 and (out / "official" / "ckpt" / "latest").is_file()
    lines = (out / "official" / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line) for line in lines]
