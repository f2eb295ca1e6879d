"""A stranger adds a record to a table: it is right everywhere, or refused where it can't be."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from pytest_types import Patch

import knotgym
from knotgym.common import InvalidInput
from knotgym.control import PolicyConfig
from knotgym.datasets import open_episodes
from knotgym.envs import TaskConfig
from knotgym.generate import CollectConfig, collect
from knotgym.rope import CHAIN, ENGINES, ChainSimulation, simulation
from knotgym.runs import RunOptions

ALONE = RunOptions(workers=1, quiet=True)
TASK = TaskConfig(task="tie", nx=1, engine="chain", observation="state", horizon=5)


def collected(root: Path, policy: str = "random", **settings: Any) -> Path:
    """Collect three episodes, which `verify` must find faultless."""
    task, acting = replace(TASK, **settings), PolicyConfig(policy=policy)
    made = collect(CollectConfig(task=task, policy=acting, episodes=3), root, ALONE)
    assert knotgym.verify(made) == []
    return made


class Soft(ChainSimulation):
    """An engine that pulls half as hard."""

    engine = "soft"

    @property
    def max_force(self) -> float:
        return super().max_force / 2


def test_an_engine(tmp_path: Path, monkeypatch: Patch) -> None:
    with pytest.raises(InvalidInput, match="engine must be one of mujoco, chain"):
        simulation("soft")
    soft = ENGINES[CHAIN]._replace(simulation=f"{__name__}:Soft", workers=1)
    monkeypatch.setitem(ENGINES, "soft", soft)
    env: Any = gym.make("knotgym/Tie-v0", engine="soft", nx=1)
    assert type(env.unwrapped.episodes.simulation) is Soft
    made = collected(tmp_path, engine="soft")
    assert made.name.startswith("random-soft-")
    steps, hard = (open_episodes(one).episodes.steps for one in (made, collected(tmp_path)))
    assert steps["action"].shape == hard["action"].shape
    assert not np.array_equal(steps["observation"], hard["observation"])
