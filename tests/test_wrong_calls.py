"""A wrong call in Python is one line that says what was wrong, and what would be right."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from synthetic_episodes import TINY

import knotgym
from knotgym.adapters import goal_env, sb3_vec_env
from knotgym.common import KnotgymError
from knotgym.control import PolicyConfig, PolicyFamily, make_policy, register_policy
from knotgym.datasets import read_table, select
from knotgym.drawing import drawn_curve
from knotgym.envs import KnotEnv, KnotVectorEnv, TaskConfig
from knotgym.generate import CollectConfig, ImagesConfig
from knotgym.loaders import (
    GoalSampling,
    Sequences,
    Symmetries,
    Transitions,
    Window,
    arrays,
    as_policy,
    images,
    statistics,
    stream,
    to_d3rlpy,
    to_tensordict,
    torch_dataset,
)
from knotgym.rendering import draw
from knotgym.rope import RopeConfig
from knotgym.runs import executor
from knotgym.topology import GaussCode, label

DATA = TINY["expert"]
RNG, SEEN = np.random.default_rng(0), {"observations": np.zeros((3, 600))}
MINE = {**SEEN, "actions": np.zeros((3, 6)), "mine": np.zeros(3)}
BEADS = TaskConfig(task="tie", action="bead", endless=True)
PLAYED: Any = CollectConfig(task=TaskConfig(task="tie", engine="chain"), policy=PolicyConfig())


def make(**settings: Any) -> Any:
    return gym.make("knotgym/Tie-v0", **settings)


def many(**settings: Any) -> Any:
    envs = KnotVectorEnv("tie", 3, observation="state", engine="chain", **settings)
    envs.reset(seed=0)
    return envs


def started(**settings: Any) -> Any:
    env = make(observation="state", engine="chain", **settings)
    env.reset(seed=0)
    return env


def batch(rows: Any, **opening: Any) -> Any:
    return Transitions(DATA, **opening).batch(rows)


WRONG: list[tuple[Callable[[], Any], str]] = [
    (lambda: make(nx=12), "nx must be from 1 to 11 on 100 beads, got 12"),
    (lambda: make(engine="chain", integrator_steps=20), "integrator_steps are steps of MuJoCo"),
    (lambda: make(depth=True, renderer="mujoco"), "depth needs renderer 'opencv'"),
    (lambda: make(crossings=3), "unexpected keyword argument 'crossings'; there is nx, split"),
    (lambda: make(render_mode="ansi"), "no render_mode 'ansi'; there is \"rgb_array\""),
    (lambda: started().reset(options={"start": 9999}), "start must be a row with nx = 0"),
    (lambda: started().reset(options={"begin": 3}), "no reset option 'begin'; use start or goal"),
    (lambda: started().step([0, 0, 0]), "an action is 6 numbers in [-1, 1] (x, y, z"),
    (lambda: many().step(np.zeros((2, 6))), "must have shape (3, 6), got (2, 6)"),
    (lambda: make().unwrapped.step(np.zeros(6)), "reset the environment before its first step"),
    (lambda: many(autoreset_mode="never"), "no autoreset_mode 'never'; there is next_step, same"),
    (lambda: many().reset(seed=[1, 2]), "one for each of 3 ropes, got 2"),
    (lambda: many().reset(options={"reset_mask": np.array([1, 0, 1])}), "must be 3 booleans"),
    (lambda: make(rope={"damping": 0.1}), "rope may set density, joint_damping, length, "),
    (lambda: make(rope={"radius": 0.004}), "for rope = {'radius': 0.004}"),
    (lambda: RopeConfig(sub_chains=1), "sub-chains"),
    (lambda: knotgym.verify("nope"), "no such file: nope, nor a Minari dataset of this id"),
    (lambda: knotgym.States.from_points(np.zeros((1, 100, 3))), "rope 0: a closed rope needs"),
    (lambda: draw(np.eye(3)[[0, 1, 2, 0]]), "point 3 and the next are on one spot"),
    (lambda: goal_env("tie", hold=2), "hold must be 1 and failure_reward 0, got 2 and 0.0"),
    (lambda: arrays(3), "a dataset is an id, a folder or a file, got 3"),
    (lambda: arrays(DATA, cache="c", observation="state"), "a cache keeps pictures"),
    (lambda: batch([0], window=Window(goals=GoalSampling())), "goals are drawn: hand a generator"),
    (lambda: Sequences(DATA, 99), "has 99 states; the longest has 19"),
    (lambda: statistics(DATA, observation="pixels"), "pictures need no statistics"),
    (lambda: as_policy(3), "such as model.predict, a torch module or an ONNX"),
    (lambda: stream(PLAYED, action="macro"), "use action 'pull' or 'bead'"),
    (lambda: stream(ImagesConfig(), action="bead"), "a stream of pictures takes no action"),
    (lambda: stream(cast(Any, BEADS)), "streams are of a CollectConfig or an ImagesConfig, got"),
    (lambda: Symmetries.drawn(3, RNG).applied(SEEN), "this one hasn't"),
    (lambda: Symmetries.drawn(3, RNG).applied(MINE), "no symmetry is known for 'mine'"),
    (lambda: batch([0], relabel="first"), "'last' or 'all'"),
    (lambda: batch([0], labels=True), "no expert actions"),
    (lambda: Window(discount=1, goals=GoalSampling()), "geometrically"),
    (lambda: label(1e200 * np.eye(3)), "coordinates reach 1e+200; scale them to between 1e-30 and"),
    (lambda: drawn_curve(GaussCode.parse("1+,2-,1-,2+"), RNG), "1+,2-,1-,2+"),
    (lambda: PolicyConfig(shares=(0.0, 0.0, 0.0, 0.0)), "shares"),
    (lambda: register_policy(PolicyFamily(form="expert", make=make_policy)), "expert"),
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


NEEDED: list[tuple[str, Callable[[], Any], str]] = [
    ("polars", lambda: select("readable", "no.h5", where="nx = 3"), ".[select]"),
    ("pygame", lambda: KnotEnv("tie", render_mode="human"), "pygame"),
    ("pyarrow", lambda: read_table(DATA), ".[huggingface]"),
    ("torch", lambda: images(DATA, kind="torch"), ".[torch]"),
    ("datasets", lambda: images(DATA, kind="huggingface"), ".[huggingface]"),
    ("torch", lambda: torch_dataset(DATA), ".[torch]"),
    ("d3rlpy", lambda: to_d3rlpy(DATA), "d3rlpy"),
    ("tensordict", lambda: to_tensordict(DATA), ".[torchrl]"),
    ("distributed", lambda: executor(1, "tcp://127.0.0.1:9").__enter__(), ".[dask]"),
    ("stable_baselines3", lambda: sb3_vec_env("tie"), "stable-baselines3"),
]


@pytest.mark.parametrize(("library", "call", "words"), NEEDED, ids=[one[0] for one in NEEDED])
def test_a_library_that_is_missing_is_named_with_what_installs_it(
    library: str, call: Callable[[], Any], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [library, *(name for name in sys.modules if name.startswith(f"{library}."))]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "knotgym.adapters.batched_vec_env", raising=False)
    with pytest.raises(KnotgymError, match="pip install") as raised:
        call()
    assert library in str(raised.value) and words in str(raised.value)
