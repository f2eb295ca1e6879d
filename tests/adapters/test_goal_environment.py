"""Goal-conditioned environments: relabelled rewards, and OGBench's interface."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from knotgym.adapters import OGBenchEnv, goal_env
from knotgym.adapters.goal_environment import GoalEnv
from knotgym.common import InvalidInput
from knotgym.envs import KnotEnv

STATE: dict[str, Any] = {"nx": 1, "observation": "state"}


def untied(states_path: str, **settings: Any) -> tuple[GoalEnv, list[Any]]:
    """Play an episode in which towing undoes a curl; return all observations with their rewards."""
    env = goal_env("unknot", states=states_path, **{**STATE, **settings})
    seen, info = env.reset(seed=2)
    steps = [(seen, 0.0, False, info)]
    while not (steps[-1][2] or steps[-1][3].get("over")):
        seen, reward, terminated, truncated, info = env.step(np.ones(6, np.float32))
        steps.append((seen, reward, terminated, {**info, "over": truncated}))
    return env, steps


def test_what_is_paid_is_what_compute_reward_says(states_path: str) -> None:
    env, steps = untied(states_path)
    assert steps[-1][3]["is_success"] and steps[-1][1] == 5.0
    for seen, reward, _, info in steps:
        assert seen in env.observation_space
        assert env.compute_reward(seen["achieved_goal"], seen["desired_goal"], info) == reward
    many = {name: np.stack([step[0][name] for step in steps]) for name in steps[0][0]}
    paid = env.compute_reward(many["achieved_goal"], many["desired_goal"], [{}] * len(steps))
    assert paid.tolist() == [step[1] for step in steps]


def test_the_code_that_an_episode_began_with_is_nobodys_success(states_path: str) -> None:
    env, steps = untied(states_path)
    began = [step[0] for step in steps if step[3]["gauss_code"] == steps[0][3]["gauss_code"]]
    assert len(began) > 1
    for seen in began:
        assert env.compute_reward(seen["achieved_goal"], began[-1]["achieved_goal"], {}) == 0.0
    last = steps[-1][0]["achieved_goal"]
    assert env.compute_reward(last, last, {}) == 5.0


def test_beyond_the_bound_on_towing_nothing_is_achieved(states_path: str) -> None:
    _, steps = untied(states_path, tow_limit=0.01)
    assert not steps[-1][2] and all(step[1] == 0.0 for step in steps)
    assert steps[-1][0]["achieved_goal"][0] == 0


@pytest.mark.parametrize("observation", ["pixels", "state", "symbolic"])
def test_the_rope_is_seen_alone(states_path: str, observation: str) -> None:
    settings: dict[str, Any] = {"nx": 2, "states": states_path, "observation": observation}
    settings["image_size"] = 16
    env, whole = goal_env("tie", **settings), KnotEnv("tie", **settings)
    seen, both = env.reset(seed=5)[0], whole.reset(seed=5)[0]
    assert seen in env.observation_space
    half = np.split(both, 2, axis=0 if both.ndim < 3 else 1)[0]  # left in a picture, else first
    assert np.array_equal(seen["observation"], half[0] if both.ndim == 2 else half)
    assert seen["desired_goal"][0] == 1 and seen["achieved_goal"].tolist() == [0] * 65


def test_ogbench_gets_goal_success_and_five_tasks(states_path: str) -> None:
    env: Any = gym.make("knotgym/visual-unknot-nx2-v0", states=states_path, image_size=16)
    assert isinstance(env.unwrapped, OGBenchEnv) and env.unwrapped.config.split == "test"
    tasks = env.unwrapped.task_infos
    assert [task["task_name"] for task in tasks] == [f"task{k}" for k in range(1, 6)]
    seen, info = env.reset(seed=0, options={"task_id": 2, "render_goal": True})
    assert seen in env.observation_space and seen.shape == (16, 16, 3)
    assert (info["start"], info["goal_row"]) == (tasks[1]["start"], tasks[1]["goal"])
    whole = KnotEnv("unknot", states=states_path, split="test", image_size=16)
    both = whole.reset(seed=0, options={"start": info["start"], "goal": info["goal_row"]})[0]
    assert np.array_equal(seen, both[:, :16]) and np.array_equal(info["goal"], both[:, 16:])
    assert np.array_equal(info["goal_rendered"], info["goal"])


def test_ogbench_is_told_of_success_in_numbers(states_path: str) -> None:
    env: Any = gym.make("knotgym/unknot-nx2-v0", states=states_path, nx=1, horizon=30)
    seen, info = env.reset(seed=2, options={"task_id": 1})
    assert seen.shape == env.observation_space.shape == (300,) == info["goal"].shape
    over = False
    while not over:
        seen, _, terminated, truncated, info = env.step(np.ones(6, np.float32))
        over = terminated or truncated
        assert bool(info["success"]) is terminated
        assert not any(isinstance(value, str) for value in info.values())
    assert env.render().shape == (128, 128, 3)
    with pytest.raises(InvalidInput, match="task_id must be a number from 1 to 5, got 6"):
        env.reset(options={"task_id": 6})
