"""A stranger adds a record to a table: it is right everywhere, or refused where it can't be."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from minari import MinariDataset
from pytest_types import Patch
from synthetic_episodes import TINY

import knotgym
from knotgym.adapters import goal_env
from knotgym.common import InvalidInput
from knotgym.control import PolicyConfig
from knotgym.datasets import open_episodes
from knotgym.envs import OBSERVATIONS, TaskConfig
from knotgym.generate import CollectConfig, collect
from knotgym.loaders import Transitions, arrays, multiplied
from knotgym.rope import CHAIN, ENGINES, VIEWS, ChainSimulation, simulation
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


def rope_alone(frames: Any, ropes: Any, goals: Any) -> np.ndarray:
    return OBSERVATIONS["state"].halves(frames, ropes)


ROPE = OBSERVATIONS["marked"]._replace(
    goal=(),
    space=lambda task: gym.spaces.Box(-np.inf, np.inf, (3 * task.beads,), np.float32),
    whole=rope_alone,
    canonical=None,
    centred=None,
)


@pytest.mark.parametrize("name", ["rope", *OBSERVATIONS])
def test_every_observation_is_the_same_in_environments_arrays_and_minari(
    name: str, tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.setitem(OBSERVATIONS, "rope", ROPE)
    made = collected(tmp_path, observation=name, image_size=16)
    stored = open_episodes(made)
    env: Any = gym.make("knotgym/Tie-v0", **{**vars(stored.task), "engine": "chain"})
    seen, _ = env.reset(seed=int(stored.episodes.episodes["seed"][0]))
    held, minari = arrays(made), MinariDataset(made / "data")[0]
    assert seen in env.observation_space
    for k, action in enumerate(held["actions"][: stored.episodes.episodes["length"][0]]):
        for here, own in ((held["observations"], seen), (minari.observations, seen)):
            parts = own if isinstance(own, dict) else {"": own}
            for part, value in parts.items():
                right = (here[part] if part else here)[k]
                # marked vertices are turned before they are rounded, or after
                np.testing.assert_allclose(value, right, rtol=0, atol=1e-5 * (name == "marked"))
        seen, *_ = env.step(action)
    if name == "rope":
        assert seen.shape == (300,)
        with pytest.raises(InvalidInput, match="observation has no halves"):
            Transitions(made).batch([0], apart=True)
        with pytest.raises(InvalidInput, match="rope without its goal needs observation"):
            goal_env("tie", observation="rope")


# a pull whose six numbers are negated
SIX = VIEWS["pull"]._replace(
    stored=lambda taken: -VIEWS["pull"].stored(taken),
    pull=lambda view, ids: view.simulation.read_actions(-view.actions[ids], ids),
    is_plain=False,
    seen=None,
    to_world=None,
)


@pytest.mark.parametrize("name", ["six", *VIEWS])
def test_every_view_is_the_same_in_environments_and_arrays(
    name: str, tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.setitem(VIEWS, "six", SIX)
    policy = "expert" if VIEWS[name].leads else "random"
    made = TINY[policy] if policy == "expert" else collected(tmp_path, action=name)
    stored, held = open_episodes(made), arrays(made, action=name, observation="state")
    words = {**vars(stored.task), "action": name, "observation": "state"}
    env: Any = gym.make("knotgym/Tie-v0", **words)
    seen, _ = env.reset(seed=int(stored.episodes.episodes["seed"][0]))
    ends = np.flatnonzero(held["terminals"] | held["timeouts"])
    for k, action in enumerate(held["actions"][: ends[0] + 1]):
        assert action in env.action_space
        np.testing.assert_array_equal(seen, held["observations"][k])
        seen, reward, *over, _ = env.step(action)
        np.testing.assert_array_equal(seen, held["next_observations"][k])
        assert reward == held["rewards"][k]
        assert over == [held["terminals"][k], held["timeouts"][k]]
    if name == "six":
        with pytest.raises(InvalidInput, match="any action but .bead., .six., whose"):
            arrays(made, action=name, frame="canonical")
        with pytest.raises(InvalidInput, match="may be of the views pull, six"):
            multiplied(held, 2, np.random.default_rng(0))
