"""A wrong call in Python is one line that says what was wrong, and what would be right."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from synthetic_episodes import TINY

import knotgym
from knotgym.adapters import goal_env
from knotgym.common.errors import KnotgymError
from knotgym.datasets import open_episodes
from knotgym.loaders import (
    GoalSampling,
    Sequences,
    Transitions,
    Window,
    arrays,
    images,
    multiplied,
)

DATA = TINY["expert"]
STEPS: dict[str, Any] = {"steps": 3}


def make(**settings: Any) -> Any:
    return gym.make("knotgym/Tie-v0", **settings)


def started() -> Any:
    env = make(observation="state", engine="chain")
    env.reset(seed=0)
    return env


def batch(rows: Any, **opening: Any) -> Any:
    return Transitions(DATA, **opening).batch(rows)


WRONG: list[tuple[Callable[[], Any], str]] = [
    (lambda: make(nx="3"), "nx must be a whole number or a list, got '3'"),
    (lambda: make(nx=0), "nx must be at least 1 or a list, got 0"),
    (lambda: make(nx=12), "nx must be from 1 to 11 on 100 beads, got 12"),
    (lambda: make(nx=7), "no states with nx = 7 in split 'train'"),
    (lambda: make(task="plait"), "task must be one of unknot, tie, convert"),
    (lambda: make(states="nope.h5"), "no knotgym-states file at nope.h5"),
    (lambda: make(split="val"), "split must be one of train, test, train-code, test-code, got"),
    (lambda: make(observation="rgb"), "observation must be one of pixels, state, both"),
    (lambda: make(action="push"), "action must be one of pull, bead, macro, got 'push'"),
    (lambda: make(views=["below"]), "views must be a list of top, left, front"),
    (lambda: make(crossings=3), "unexpected keyword argument 'crossings'; there is nx, split"),
    (lambda: make(engine="bullet"), "engine must be one of mujoco, chain, got 'bullet'"),
    (lambda: make(render_mode="ansi"), "no render_mode 'ansi'; there is \"rgb_array\""),
    (lambda: started().reset(options={"start": 9999}), "start must be a row with nx = 0"),
    (lambda: started().reset(options={"begin": 3}), "no reset option 'begin'; use start or goal"),
    (lambda: started().step(np.full(6, 2.0)), "an action's numbers must be in [-1, 1], got [2.0"),
    (lambda: started().step([0, 0, 0]), "an action is 6 numbers (x, y, z, fx, fy, fz); got"),
    (lambda: make().unwrapped.step(np.zeros(6)), "reset the environment before its first step"),
    (lambda: gym.make_vec("knotgym/Tie-v0", num_envs=0), "num_envs must be at least 1, got 0"),
    (lambda: knotgym.shipped("best"), "no shipped set of states 'best'; there are readable"),
    (lambda: knotgym.verify("nope"), "no such file: nope, nor a Minari dataset of this id"),
    (lambda: knotgym.States.from_points([]), "points must have shape (n, beads, 3), got (0,)"),
    (lambda: knotgym.register_task("tie", lambda nx: (0, nx)), "a new lower-case word, got 'tie'"),
    (lambda: goal_env("tie", goals=3), "unexpected keyword argument 'goals'; there is nx, split"),
    (lambda: open_episodes("nope.h5"), "no such file: nope.h5, nor a Minari dataset of this id"),
    (lambda: arrays(3), "a dataset is an id, a folder or a file, got 3"),
    (lambda: arrays([]), "nothing to merge: give at least one set of episodes"),
    (lambda: batch([0], window=5), "window must be such as Window(n_step=5), got 5"),
    (lambda: arrays(DATA, cache="c", observation="state"), "a cache keeps pictures"),
    (lambda: arrays(DATA, reward=lambda *_: 1), "reward must return 18 numbers for an episode"),
    (lambda: Window(**STEPS), "Window has no field 'steps'; it has n_step, discount, chunk"),
    (lambda: Window(discount=1.5), "discount must be at most 1, got 1.5"),
    (lambda: GoalSampling(p_currgoal=1.0), "must be probabilities that sum to 1, got"),
    (lambda: batch([0], window=Window(goals=GoalSampling())), "goals are drawn: hand a generator"),
    (lambda: Sequences(DATA, 0), "length must be at least 1, got 0"),
    (lambda: multiplied(arrays(DATA), 0, np.random.default_rng(0)), "multiplied at least once"),
    (lambda: images("nope", kind="jax"), "kind must be one of torch, huggingface, got 'jax'"),
]


@pytest.mark.parametrize(("call", "message"), WRONG, ids=[message for _, message in WRONG])
def test_a_wrong_call_is_one_clear_line(
    call: Callable[[], Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises((KnotgymError, gym.error.ResetNeeded)) as raised:
        call()
    said = str(raised.value)
    assert message in said and said.isprintable() and not list(tmp_path.iterdir())
