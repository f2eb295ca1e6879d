"""Stable-Baselines3 over one batched simulation; run with -m clients where it is installed."""

from typing import Any

import numpy as np
import pytest

from knotgym.adapters import goal_env, sb3_vec_env
from knotgym.envs import KnotEnv

from ..envs.test_env import same as equal

pytestmark = pytest.mark.clients
sb3 = pytest.importorskip("stable_baselines3")
evaluate_policy = pytest.importorskip("stable_baselines3.common.evaluation").evaluate_policy
vec_env = pytest.importorskip("stable_baselines3.common.vec_env")
SMALL: dict[str, Any] = {"nx": 1, "horizon": 4, "image_size": 36}


@pytest.mark.parametrize("observation", ["pixels", "state", "both", "symbolic", "goals"])
def test_steps_are_those_of_single_environments(states_path: str, observation: str) -> None:
    goals = observation == "goals"
    settings = {**SMALL, "states": states_path, "observation": "state" if goals else observation}
    batched = sb3_vec_env("unknot", 3, goals=goals, **settings)
    make = goal_env if goals else KnotEnv
    singles = vec_env.VecMonitor(vec_env.DummyVecEnv([lambda: make("unknot", **settings)] * 3))
    assert batched.observation_space == singles.observation_space
    assert batched.venv.metadata["render_fps"] == KnotEnv.metadata["render_fps"]
    rng, rows, ended = np.random.default_rng(0), 0, 0
    for each in (batched, singles):
        each.seed(7)
    ours, theirs = batched.reset(), singles.reset()
    for _ in range(12):
        # its class has ordered dictionaries
        assert equal(ours, dict(theirs) if isinstance(theirs, dict) else theirs)
        actions = rng.uniform(-1, 1, (3, 6)).astype(np.float32)
        (ours, *told), (theirs, *right) = batched.step(actions), singles.step(actions)
        assert equal(told[0], right[0]) and equal(told[1], right[1])
        for one, other in zip(told[2], right[2], strict=True):
            for info in (one, other):
                info.get("episode", {}).pop("t", None)  # seconds
            assert equal(one, other) and ("episode" in one) == ("terminal_observation" in one)
            ended += "episode" in one
        assert equal(batched.reset_infos, singles.reset_infos)
        rows += 3
    assert rows == 36 and ended >= 9
