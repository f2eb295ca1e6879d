"""PPO with the paper's settings trains, and `knotgym evaluate` plays it (-m clients)."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ..scripts import ROOT, run_script
from ..small_job import knotgym

SCRIPT = ROOT / "baselines" / "ppo.py"


def test_it_says_how_to_use_it(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("torch")
    with pytest.raises(SystemExit) as ended:
        run_script(SCRIPT, "--help")
    assert ended.value.code == 0 and "usage: ppo.py" in capsys.readouterr().out


@pytest.mark.clients
@pytest.mark.parametrize("observation", ["pixels", "state"])
def test_it_trains_and_is_evaluated(
    observation: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch")
    out, task = tmp_path / "out", ("--task", "unknot", "--nx", 2, "--engine", "chain")
    small = ("--envs", 2, "--rollout", 32, "--batch", 32, "--epochs", 1, "--steps", 64)
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


@pytest.mark.clients
@pytest.mark.parametrize("observation", ["pixels", "state"])
def test_an_update_is_that_of_stable_baselines(
    observation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same weights come of the same rollout, in one update by all of its rows."""
    library = pytest.importorskip("stable_baselines3")
    import torch

    from knotgym.adapters import sb3_vec_env

    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    import ppo

    given = ppo.parser().parse_args(["--batch", "16", "--learning-rate", "0.001", "--out", "none"])
    pictures = observation == "pixels"
    venv = sb3_vec_env("unknot", 2, nx=2, engine="chain", observation=observation, image_size=36)
    features = {"features_extractor_kwargs": {"features_dim": 768}} if pictures else None
    name = "CnnPolicy" if pictures else "MlpPolicy"
    model = library.PPO(name, venv, 0.001, 8, 16, 1, policy_kwargs=features, device="cpu")
    agent = ppo.Agent(venv.observation_space.shape, 768)
    theirs, mine = [*model.policy.parameters()], [*agent.parameters()]
    for own, other in zip(mine, theirs, strict=True):
        own.data.copy_(other)
    rollout = model.rollout_buffer
    model.collect_rollouts(model.env, model._setup_learn(16)[1], rollout, 8)
    names = ("observations", "actions", "log_probs", "advantages", "returns")
    parts = [torch.from_numpy(getattr(rollout, name)).flatten(0, 1) for name in names]
    if pictures:
        parts[0] = parts[0].permute(0, 2, 3, 1)
    before = [own.detach().clone() for own in mine]
    ppo.updater(agent, parts, given)(torch.randperm(16))
    model.train()
    for old, one, other in zip(before, mine, theirs, strict=True):
        assert torch.allclose(one, other, atol=1e-5) and not torch.equal(one, old)
