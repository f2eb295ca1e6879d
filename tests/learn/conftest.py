"""A small dataset and learners barely trained on it. Run with -m clients; needs torch."""

import json
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from knotgym.control import PolicyConfig, make_policy, rollouts
from knotgym.datasets import Episodes, MinariMetadata, publish
from knotgym.envs import TaskConfig
from knotgym.learn.train_config import CloneConfig, ReaderConfig
from knotgym.runs import RunOptions

if not all(map(find_spec, ("torch", "safetensors"))):
    collect_ignore_glob = ["test_*.py"]
READER = ReaderConfig(steps=6, batch=2, save_every=2)
CLONE = CloneConfig(steps=4, batch=4, save_every=2, width=16, layers=1, guided=True, trials=0)
TASK = TaskConfig(task="tie", nx=2, horizon=12, observation="state", engine="chain")


def published(root: Path, episodes: Episodes, task: TaskConfig = TASK, name: str = "a") -> Path:
    metadata = MinariMetadata(
        dataset_id=f"knotgym/{name}-v0", algorithm_name="scripted", description=""
    )
    return publish([episodes], task, metadata, root)


def train(
    data: Sequence[Path], out: Path, config: Any, *, resume: bool = False, log: Any = None
) -> Path:
    from knotgym.learn.train_recipe import train

    return train(data, out, config, RunOptions(workers=1, quiet=True, resume=resume), log=log)


def break_off(data: Sequence[Path], out: Path, config: Any) -> None:
    """Train until the first checkpoint is saved, and interrupt."""
    from knotgym.learn.training import Training

    save = Training._save

    def save_and_stop(training: Training, path: Path) -> None:
        save(training, path)
        raise KeyboardInterrupt

    with mock.patch.object(Training, "_save", save_and_stop), pytest.raises(KeyboardInterrupt):
        train(data, out, config)


def weights(folder: Path) -> bytes:
    return (folder / "weights.safetensors").read_bytes()


def put_card(folder: Path, **fields: object) -> None:
    """Change fields of a learner's card, as who can write its digest, too."""
    from knotgym.learn.card import write_card

    write_card(folder, {**json.loads((folder / "policy.json").read_text()), **fields})


@pytest.fixture(scope="session")
def played() -> Episodes:
    """Three episodes of passes, of which one didn't reach its goal."""
    episodes = rollouts(make_policy(PolicyConfig(policy="expert")), TASK, [1, 2, 3])
    episodes.episodes["success"][:] = np.array([True, True, False])
    return episodes


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory, played: Episodes) -> Path:
    return published(tmp_path_factory.mktemp("data"), played)


@pytest.fixture(scope="session")
def learner(tmp_path_factory: pytest.TempPathFactory, data: Path) -> Path:
    return train([data], tmp_path_factory.mktemp("learner") / "made", READER)


@pytest.fixture(scope="session")
def clone(tmp_path_factory: pytest.TempPathFactory, data: Path) -> Path:
    return train([data], tmp_path_factory.mktemp("clone") / "made", CLONE)
