"""A small dataset and a learner barely trained on it. Run with -m clients; needs torch."""

from pathlib import Path
from typing import Any

import pytest

from knotgym.runs.run_options import Existing

from ..small_job import knotgym

TINY = {"steps": 6, "batch": 2, "save_every": 2}


@pytest.fixture(scope="session")
def episodes(tmp_path_factory: pytest.TempPathFactory, states_path: str) -> Path:
    """Three episodes of macro-actions, of the train split."""
    out = tmp_path_factory.mktemp("episodes")
    arguments = ("--task", "tie", "--nx", 3, "--policy", "scripted", "--episodes", 3)
    settings = ("--set", "task.horizon=6", "--observation", "state", "--states", states_path)
    named = ("--id", "knotgym/tie-nx3/scripted-v0")
    assert (
        knotgym("collect", *arguments, *settings, *named, "--out", out, "--workers", 1, "--quiet")
        == 0
    )
    return out / "knotgym" / "tie-nx3" / "scripted-v0"


@pytest.fixture(scope="session")
def learner(tmp_path_factory: pytest.TempPathFactory, episodes: Path) -> Path:
    """A checkpoint folder."""
    out = tmp_path_factory.mktemp("learner") / "made"
    train_tiny(episodes, out)
    return out


def train_tiny(episodes: Path, out: Path, **changes: Any) -> None:
    from knotgym.learn.train_config import TrainConfig
    from knotgym.learn.training import train

    existing = Existing(resume=changes.pop("resume", False))
    train([episodes], out, TrainConfig(**{**TINY, **changes}), existing=existing, quiet=True)
