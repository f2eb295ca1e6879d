"""PPO with the paper's settings trains, and `knotgym evaluate` plays it (-m clients)."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ..scripts import ROOT, run_script
from ..small_job import knotgym

SCRIPT = ROOT / "baselines" / "ppo.py"


def test_it_says_how_to_use_it(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        run_script(SCRIPT, "--help")
    assert ended.value.code == 0 and "usage: ppo.py" in capsys.readouterr().out


@pytest.mark.clients
@pytest.mark.parametrize("observation", ["pixels", "state"])
def test_it_trains_and_is_evaluated(
    observation: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("stable_baselines3")
    out, task = tmp_path / "out", ("--task", "unknot", "--nx", 2, "--engine", "chain")
    small = ("--envs", 2, "--rollout", 32, "--steps", 64)
    run_script(
        SCRIPT, *task, *small, "--observation", observation, "--image-size", 36, "--out", out
    )
    report = json.loads((out / "ppo.json").read_text(encoding="utf-8"))
    assert report["settings"]["learning_rate"] == 1e-5 and report["curve"][-1]["steps"] == 64
    monkeypatch.setenv("KNOTGYM_PPO", str(out))
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    seen = ("--set", f"task.observation={observation}", "--set", "task.image_size=36")
    words = ("--policy", "ppo:act", "--episodes", 2, "--quiet", "--workers", 1)
    assert knotgym("evaluate", *task, *words, *seen, "--out", tmp_path / "scores.json") == 0
    (row,) = json.loads((tmp_path / "scores.json").read_text(encoding="utf-8"))["results"]
    assert row["episodes"] == 2
