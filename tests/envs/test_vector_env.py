"""Ropes of a vector environment behave like single environments, in every autoreset mode; in
threads, in processes and pickled they have the numbers of one alone.
"""

import copy
import inspect
import pickle
import runpy
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from numpy.typing import NDArray

from knotgym.common import InvalidInput
from knotgym.envs.environment import KnotEnv, KnotVectorEnv

from ..conftest import blow_up
from .test_env import goal_is_shown, same

AutoresetMode: Any = getattr(gym.vector, "AutoresetMode", None)  # Gymnasium 1.0 has none
MODES = ["NextStep", "SameStep", "Disabled"]
both_modes = pytest.mark.parametrize(
    "mode", ["NextStep", "SameStep"] if AutoresetMode else ["NextStep"]
)
MakeVec = Callable[..., KnotVectorEnv]


def actions(count: int, steps: int, seed: int = 0) -> NDArray[np.float32]:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, count, 6)).astype(np.float32)


@pytest.fixture
def make(states_path: str) -> MakeVec:
    """Create a vector environment on the small state file."""
    return partial(KnotVectorEnv, num_envs=3, states=states_path, observation="state")


@pytest.fixture
def synced(states_path: str) -> Callable[..., SyncVectorEnv]:
    """Create Gymnasium's vector of single environments on the small state file."""

    def made(
        task: str = "tie", num_envs: int = 3, autoreset_mode: str = "NextStep", **settings: Any
    ) -> SyncVectorEnv:
        wanted = {"states": states_path, "observation": "state", **settings}
        modes: dict[str, Any] = {"autoreset_mode": autoreset_mode} if AutoresetMode else {}
        return SyncVectorEnv([lambda: KnotEnv(task, **wanted)] * num_envs, **modes)

    return made


def test_threads_change_no_byte_of_observations_codes_and_rewards(make: MakeVec) -> None:
    """Seven ropes on three threads aren't divided evenly; episodes end and begin again."""
    told = {"observation": "both", "views": ["top", "left"], "engine": "chain", "horizon": 2}
    one, three = (make("tie", num_envs=7, threads=count, **told) for count in (1, 3))
    assert same(one.reset(seed=0), three.reset(seed=0))
    for pull in actions(7, 4):
        assert same(one.step(pull), three.step(pull))


def test_make_vec_gives_one_batched_simulation(states_path: str) -> None:
    envs = gym.make_vec("knotgym/Tie-v0", num_envs=4, nx=3, states=states_path, observation="both")
    assert isinstance(envs.unwrapped, KnotVectorEnv)
    assert envs.unwrapped.episodes.simulation.count == 4
    observations, _ = envs.reset()
    assert observations in envs.observation_space
    assert len({one.tobytes() for one in observations["state"]}) == 4


@both_modes
@pytest.mark.parametrize(
    ("task", "seed", "settings"),
    [
        ("tie", [5, None, 7], {"observation": "state", "action": "bead"}),
        ("convert", 7, {"observation": "both", "views": ["left", "top", "front"], "depth": True}),
        ("unknot", np.int64(5), {"observation": "pixels"}),
        ("tie", 5, {"action": "macro", "horizon": 4}),
    ],
    ids=["bead", "convert", "unknot", "macro"],
)
def test_steps_and_autoresets_are_those_of_single_environments(
    make: MakeVec,
    synced: Callable[..., SyncVectorEnv],
    mode: str,
    task: str,
    seed: Any,
    settings: dict[str, Any],
) -> None:
    settings = {"nx": 1, "horizon": 2, "autoreset_mode": mode, "image_size": 16, **settings}
    envs, singles = make(task, **settings), synced(task, **settings)
    assert envs.observation_space == singles.observation_space
    if isinstance(seed, list):  # rope 1 draws anew
        assert not same(envs.reset(seed=seed)[0][1], envs.reset(seed=seed)[0][1])
        seed = [5, 6, 7]
    assert same(envs.reset(seed=seed), singles.reset(seed=np.array(seed).tolist()))
    ended = 0
    envs.action_space.seed(1)
    for _ in range(6):
        each = envs.action_space.sample()
        ours, theirs = envs.step(each), singles.step(each)
        assert same(ours, theirs)
        ended += int((ours[2] | ours[3]).sum())
    assert ended >= 6


def test_ropes_end_and_start_alone(make: MakeVec, synced: Callable[..., SyncVectorEnv]) -> None:
    envs, singles = make("tie", horizon=3), synced(horizon=3)
    second: Any = singles.envs[1]
    envs.reset(seed=0), singles.reset(seed=0)
    for step, each in enumerate(actions(3, 10)):
        if step in (0, 4):  # rope 1 succeeds out of turn
            goal_is_shown(envs.episodes, 1)
            goal_is_shown(second.episodes, 0)
            each[1] = 0.0
        ours = envs.step(each)
        assert same(ours, singles.step(each))
        if step == 0:
            assert ours[1].tolist() == [0, 5, 0] and ours[2].tolist() == [False, True, False]


@pytest.mark.skipif(AutoresetMode is None, reason="Gymnasium 1.0 knows no other mode")
def test_without_autoreset_masked_resets_are_those_of_single_environments(
    make: MakeVec, synced: Callable[..., SyncVectorEnv]
) -> None:
    settings: dict[str, Any] = {"horizon": 2, "autoreset_mode": "Disabled"}
    envs, singles = make("tie", **settings), synced(**settings)
    third: Any = singles.envs[2]
    masked = 0
    assert same(envs.reset(seed=0), singles.reset(seed=0))
    for step, each in enumerate(actions(3, 6)):
        if step == 0:  # rope 2 ends a step before the others
            envs.episodes.steps[2] = third.episodes.steps[0] = 1
        ours = envs.step(each)
        assert same(ours, singles.step(each))
        if (done := ours[2] | ours[3]).any():
            assert same(
                envs.reset(options={"reset_mask": done.copy()}),
                singles.reset(options={"reset_mask": done.copy()}),
            )
            masked += 1
    assert masked >= 2


def test_a_blown_up_rope_ends_alone_and_starts_over(make: MakeVec) -> None:
    envs, others = make("tie"), make("tie")
    envs.reset(seed=0), others.reset(seed=0)
    blow_up(envs.episodes.simulation, 1)
    each = actions(3, 2)
    ours, theirs = envs.step(each[0]), others.step(each[0])
    assert not ours[1].any() and not ours[2].any()
    assert ours[3].tolist() == ours[4]["simulation_failed"].tolist() == [False, True, False]
    assert np.isfinite(ours[0]).all() and np.array_equal(ours[0][[0, 2]], theirs[0][[0, 2]])
    ours, theirs = envs.step(each[1]), others.step(each[1])
    assert ours[4]["simulation_failed"].tolist() == [False] * 3 and ours[4]["bead"][1] == -1
    assert np.array_equal(ours[0][[0, 2]], theirs[0][[0, 2]])


def test_a_step_needs_every_rope_to_have_been_reset(make: MakeVec) -> None:
    envs = make("tie", horizon=1, autoreset_mode="disabled")
    envs.reset(seed=0)
    envs.step(np.zeros((3, 6), np.float32))
    with pytest.raises(InvalidInput, match=r"episodes \[0, 1, 2\] have ended"):
        envs.step(np.zeros((3, 6), np.float32))
    envs = make("tie")
    envs.reset(options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(ResetNeeded, match="before its first step"):
        envs.step(np.zeros((3, 6), np.float32))


def test_a_pickled_vector_environment_goes_on_and_infos_are_copies(make: MakeVec) -> None:
    envs = make("tie", horizon=3)
    envs.reset(seed=0)
    first = envs.step(actions(3, 1)[0])
    kept, again = pickle.loads(pickle.dumps((first, envs)))
    for each in actions(3, 5, seed=1):
        assert same(again.step(each), envs.step(each))
    assert same(first, kept)


def test_render_gives_one_picture_a_rope(make: MakeVec) -> None:
    envs = make("tie", observation="pixels")
    observations = envs.reset(seed=0)[0]
    pictures = envs.render()
    assert pictures is not None and np.array_equal(np.stack(pictures), observations)
    assert make("tie", render_mode=None).render() is None


def test_gymnasium_1_0_is_enough(states_path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(gym.vector, "AutoresetMode", raising=False)
    own = runpy.run_path(str(inspect.getsourcefile(KnotVectorEnv)))  # its lines, run once more
    envs = own["KnotVectorEnv"]("tie", states=states_path, observation="state")
    assert envs.metadata["autoreset_mode"] == "NextStep" and envs.reset(seed=0)[0].shape == (1, 600)


def test_vector_environments_in_threads_give_the_numbers_of_one_alone(make: MakeVec) -> None:
    def play(seed: int, into: dict[int, list[Any]]) -> None:
        envs = make("tie", num_envs=2, nx=1)
        into[seed] = [envs.reset(seed=seed), *(envs.step(one) for one in actions(2, 3, seed))]

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
def test_processes_give_the_numbers_of_one_process(states_path: str, context: str) -> None:
    makers = [partial(KnotEnv, "tie", states=states_path, observation="state")] * 2
    results = []
    for envs in (SyncVectorEnv(makers), AsyncVectorEnv(makers, context=context)):
        seen = [envs.reset(seed=3), *(envs.step(one) for one in actions(2, 3))]
        results.append(copy.deepcopy(seen))
        envs.close()
    assert same(*results)
