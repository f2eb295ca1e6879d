"""The adapter to the official TD-MPC2.

With -m clients, and KNOTGYM_TDMPC2 naming a checkout, the official code itself is run.
"""

from __future__ import annotations

import importlib.util
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

FOLDER = ROOT / "baselines" / "tdmpc2"
SCRIPT = FOLDER / "train_tdmpc2.py"
CHECKOUT = os.environ.get("KNOTGYM_TDMPC2", "")


@pytest.fixture
def adapter() -> Iterator[Any]:
    """Import the module as the script does."""
    with mock.patch.object(sys, "path", [str(FOLDER), *sys.path]):
        import rope_rounds

        yield rope_rounds


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
        ((), "97c14471997d: it has no tdmpc2/tdmpc2.py"),
        (("--nx", 0), "nx must be a whole number from 1 to 11, got 0"),
        (("--image-size", 78), "image_size must be at least 79 for the encoder, got 78"),
        (("--threads", -1), "threads must be a whole number of at least 0, got -1"),
        (("--settings", "huge"), "no settings 'huge'; choose from paper, small"),
        (("--set", "lr=fast"), "lr must be like 0.0003, got 'fast'"),
        (("--set", "device=tpu"), "device must be cuda:0 or cpu, got 'tpu'"),
        (("--set", "num_envs=0"), "num_envs must be at least 1, got 0"),
        (("--set", "seed_steps=784"), "seed_steps must be at least 800, a round of num_envs"),
        (("--set", "num_envs=3"), "eval_freq must be a multiple of num_envs, 3, got 50000"),
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


def test_pictures_have_their_channels_first(adapter: Any) -> None:
    task = TaskConfig(task="unknot")
    ropes = adapter.RopeRounds(task, 2, np.random.default_rng(0), least=4, threads=1)
    seen = ropes.reset()
    assert seen.shape == (2, 3, 128, 256) and seen.dtype == np.uint8
    picture = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3)
    assert (adapter.channels_first(picture)[1] == picture[..., 1]).all()


def test_a_round_is_over_when_all_ropes_are_but_not_too_soon(adapter: Any) -> None:
    task = TaskConfig(task="tie", nx=4, horizon=2, image_size=79)
    ropes = adapter.RopeRounds(task, 2, np.random.default_rng(0), least=3, threads=1)
    ropes.reset()
    steps = [ropes.step(np.zeros((2, 6), dtype=np.float32)) for _ in range(3)]
    assert [step.over for step in steps] == [False, False, True]
    assert [step.rewards.tolist() for step in steps] == [[0.0, 0.0], [-5.0, -5.0], [0.0, 0.0]]
    assert not any(step.terminated.any() for step in steps) and ropes.acted == 4
    assert (steps[1].pictures == steps[2].pictures).all()


@pytest.mark.clients
@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="torch isn't installed")
def test_the_encoder_has_the_layers_of_the_paper() -> None:
    import torch
    from torch import nn

    with mock.patch.object(sys, "path", [str(FOLDER), *sys.path]):
        import official_patches

    def official(in_shape: tuple[int, ...], channels: int, act: Any) -> Any:
        convs = [
            nn.Conv2d(first, channels, size, stride=stride)
            for first, size, stride in ((in_shape[0], 7, 2), (channels, 5, 2), (channels, 3, 2))
        ]
        layers = [layer for conv in convs for layer in (conv, nn.ReLU())]
        last = (nn.Conv2d(channels, channels, 3), nn.Flatten(), act)
        return nn.Sequential(nn.Identity(), nn.Identity(), *layers, *last)

    conv = official_patches.wider_conv(torch, official, 64)
    encoder = conv((3, 128, 256), 8, nn.Softmax(dim=-1))
    kinds = [type(layer).__name__ for layer in encoder]
    assert kinds[2:] == [*("Conv2d", "ReLU") * 4, "Conv2d", "Flatten", "Linear", "Softmax"]
    convs = [layer for layer in encoder if isinstance(layer, nn.Conv2d)]
    assert [one.kernel_size[0] for one in convs] == [7, 5, 5, 3, 3]
    assert [one.stride[0] for one in convs] == [2, 2, 2, 2, 1]
    assert encoder(torch.zeros(2, 3, 128, 256)).shape == (2, 64)


@pytest.mark.clients
@pytest.mark.skipif(not CHECKOUT, reason="KNOTGYM_TDMPC2 names no checkout")
def test_the_official_code_trains_resumes_and_is_evaluated(tmp_path: Path) -> None:
    out = tmp_path / "out"
    few = ("--set", "seed_steps=200", "--set", "eval_freq=400", "--threads", 1)
    words = ("--checkout", CHECKOUT, "--settings", "small", *few, "--image-size", 79, "--out", out)
    tried = ("--episodes", 1, "--split", "test", "--quiet")
    for more in (("--steps", 404), ("--steps", 612, "--resume")):
        command = [sys.executable, SCRIPT, *words, *tried, *more]
        subprocess.run([str(word) for word in command], cwd=ROOT, check=True)
    (row,) = read_scores([out / "evaluation.json"])
    assert (row["policy"], row["task"], row["nx"], row["episodes"]) == ("tdmpc2", "unknot", 2, 1)
    assert row["training"]["steps"] >= 612 and row["training"]["parameters"] > 0
    (before,) = row["training"]["resumed_at"]
    assert 404 <= before < 612 and (out / "model.pt").is_file()
    lines = (out / "losses.jsonl").read_text(encoding="utf-8").splitlines()
    assert any("consistency_loss" in json.loads(line) for line in lines)
