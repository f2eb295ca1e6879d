"""Environments in threads, in processes and copied in the middle of an episode: the numbers of one
alone.
"""

import copy
import threading
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from knotgym.envs import KnotEnv, KnotVectorEnv

from .envs.test_env import same
from .envs.test_vector_env import actions

STEPS = 3
Settings = dict[str, Any]


@pytest.fixture
def settings(states_path: str) -> Settings:
    return {"nx": 1, "states": states_path, "observation": "state", "horizon": 9}


def test_vector_environments_in_threads_give_the_numbers_of_one_alone(settings: Settings) -> None:
    def play(seed: int, into: dict[int, list[Any]]) -> None:
        envs = KnotVectorEnv("tie", 2, **settings)
        into[seed] = [envs.reset(seed=seed), *(envs.step(one) for one in actions(2, STEPS, seed))]

    alone: dict[int, list[Any]] = {}
    together: dict[int, list[Any]] = {}
    for seed in (0, 5):
        play(seed, alone)
    threads = [threading.Thread(target=play, args=(seed, together)) for seed in (0, 5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert same([together[0], together[5]], [alone[0], alone[5]])


@pytest.mark.parametrize(
    "context",
    [
        "fork",
        pytest.param("forkserver", marks=pytest.mark.slow),
        pytest.param("spawn", marks=pytest.mark.slow),
    ],
)
def test_processes_give_the_numbers_of_one_process(settings: Settings, context: str) -> None:
    makers = [partial(KnotEnv, "tie", **settings)] * 2
    results = []
    for envs in (SyncVectorEnv(makers), AsyncVectorEnv(makers, context=context)):
        seen = [envs.reset(seed=3), *(envs.step(one) for one in actions(2, STEPS))]
        results.append(copy.deepcopy(seen))
        envs.close()
    assert same(*results)


def test_what_happens_to_a_copy_does_not_happen_to_the_first(settings: Settings) -> None:
    env, other = (KnotEnv("tie", **settings) for _ in range(2))
    for one in (env, other):
        one.reset(seed=0)
    copied = copy.deepcopy(env)
    copied.step(np.ones(6, dtype=np.float32))
    copied.reset(seed=9)
    action = actions(1, 1)[0, 0]
    assert same(env.step(action), other.step(action))
