"""Shared by the adapters to official code: the paper's settings, checkouts and progress."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from knotgym.common.errors import KnotgymError, MissingExtra

from ..scripts import ROOT

FOLDER = ROOT / "baselines"
DREAMER = FOLDER / "dreamerv3" / "settings.toml"
TDMPC = FOLDER / "tdmpc2" / "settings.toml"


@pytest.fixture
def shared() -> Iterator[Any]:
    """Import the module as the scripts do."""
    with mock.patch.object(sys, "path", [str(FOLDER), *sys.path]):
        import official_code

        yield official_code


def test_the_settings_are_those_of_the_paper(shared: Any) -> None:
    dreamer = shared.read_settings(DREAMER, "paper", [])
    assert dreamer["configs"] == ["size12m"]
    assert (dreamer["run.envs"], dreamer["run.train_ratio"]) == (32, 256.0)
    assert (dreamer["agent.opt.lr"], dreamer["replay.size"]) == (4e-5, 5e6)
    tdmpc = shared.read_settings(TDMPC, "paper", [])
    assert (tdmpc["model_size"], tdmpc["num_envs"], tdmpc["steps_per_update"]) == (5, 16, 4)
    assert (tdmpc["rho"], tdmpc["lr"], tdmpc["batch_size"]) == (0.7, 3e-4, 256)
    assert (tdmpc["horizon"], tdmpc["iterations"], tdmpc["num_samples"]) == (3, 6, 512)
    assert (tdmpc["num_elites"], tdmpc["num_pi_trajs"]) == (64, 24)


def test_a_setting_can_be_changed_to_one_of_its_kind(shared: Any) -> None:
    changed = shared.read_settings(DREAMER, "paper", ["run.train_ratio=8", "jax.platform=cpu"])
    assert (changed["run.train_ratio"], changed["jax.platform"]) == (8.0, "cpu")
    assert type(changed["run.train_ratio"]) is float
    with pytest.raises(KnotgymError, match="model_size must be like 5, got 'true'"):
        shared.read_settings(TDMPC, "paper", ["model_size=true"])


def test_another_commit_is_warned_of_in_a_line(
    shared: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = {"name": "A", "repository": "example.org/a", "commit": 40 * "a", "files": ("a.py",)}
    code = shared.OfficialCode(**told)
    with pytest.raises(KnotgymError, match="isn't a checkout of example.org/a at aaaaaaaaaaaa"):
        shared.require_checkout(code, tmp_path)
    (tmp_path / "a.py").touch()
    with mock.patch.object(shared, "_commit", lambda _: 40 * "b"):
        assert shared.require_checkout(code, tmp_path) == 40 * "b"
    [line] = capsys.readouterr().err.splitlines()
    assert line.endswith("is at commit bbbbbbbbbbbb; this adapter was tested with aaaaaaaaaaaa")
    without = shared.OfficialCode(**told, libraries=("no_such_library",))
    with pytest.raises(MissingExtra, match="needs no_such_library"):
        shared.require_checkout(without, tmp_path)


def test_progress_goes_on_where_it_was_written(shared: Any, tmp_path: Path) -> None:
    progress = sys.modules["baseline_script"].Progress
    first = progress(tmp_path, False)
    first.resume(10)
    first.write(10)
    told = json.loads((tmp_path / "progress.json").read_text(encoding="utf-8"))
    assert (told["steps"], told["resumed_at"]) == (10, [])
    again = progress(tmp_path, True)
    again.resume(10)  # has nothing to do
    assert (again.steps, again.resumed_at) == (10, [])
    again.resume(20)
    assert again.resumed_at == [10] and again.as_json()["seconds"] >= told["seconds"]
    (tmp_path / "progress.json").write_text("[", encoding="utf-8")
    with pytest.raises(KnotgymError, match="is corrupted"):
        progress(tmp_path, True)
