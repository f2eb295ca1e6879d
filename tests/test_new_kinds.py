"""A stranger adds a record to a table: it is right everywhere, or refused where it can't be."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
import pytest
from minari import MinariDataset
from pydantic import PositiveInt
from pytest_types import Patch
from synthetic_episodes import TINY

import knotgym
from knotgym.adapters import goal_env
from knotgym.common import InvalidInput, Mark, configuration
from knotgym.control import PolicyConfig
from knotgym.datasets import open_episodes
from knotgym.envs import OBSERVATIONS, TaskConfig
from knotgym.generate import CollectConfig, collect
from knotgym.loaders import Symmetries, Transitions, Window, arrays
from knotgym.quality import Limits, Quality
from knotgym.rope import CHAIN, ENGINES, VIEWS, ChainSimulation, simulation
from knotgym.runs import RunOptions
from knotgym.states import SPLITS, States, read_states, shipped, write_states

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
            Symmetries.drawn(len(held["actions"]), np.random.default_rng(0)).applied(held)


def test_when_a_goal_is_shown(tmp_path: Path, monkeypatch: Patch) -> None:
    """Any diagram with as many crossings as the goal's."""
    monkeypatch.setattr(
        "knotgym.envs.reward.asked",
        lambda task, visits: np.count_nonzero(visits, axis=1, keepdims=True).astype(np.int16),
    )
    made = collected(tmp_path, "scripted", nx=2, horizon=80)
    own, steps = open_episodes(made).episodes
    last = open_episodes(made).episodes.last()
    other = (steps["visits"][last] != own["goal_visits"]).any(axis=1)
    assert (own["success"] & other).any() and (
        own["success"] == (steps["crossings"][last] == 2)
    ).all()
    held, parts = arrays(made, relabel="all"), np.split(steps["crossings"], last[:-1] + 1)
    assert (held["rewards"] == 5.0 * held["terminals"]).all()
    assert held["terminals"].sum() == sum(len({*one.tolist()} - {one[0]}) for one in parts)
    env = goal_env("tie", nx=2, observation="state", engine="chain")
    k = int(np.flatnonzero(own["success"] & other)[0])
    seen, _ = env.reset(seed=int(own["seed"][k]))
    for action in steps["action"][last[k] - own["length"][k] : last[k]]:
        seen, reward, *_ = env.step(action)
        made_again = env.compute_reward(seen["achieved_goal"], seen["desired_goal"], {})
        assert made_again == max(reward, 0)
    assert reward == 5


def test_a_reward_of_the_state_before(tmp_path: Path, monkeypatch: Patch) -> None:
    def moved(task: TaskConfig, seen: Any) -> np.ndarray:
        width = min(seen.before.shape[1], seen.visits.shape[1])
        return (seen.before[:, :width] != seen.visits[:, :width]).any(axis=1).astype(np.float64)

    monkeypatch.setattr("knotgym.envs.reward.reward", moved)
    made = collected(tmp_path, "expert", nx=2, horizon=30)
    steps = open_episodes(made).episodes.steps
    changes = (steps["visits"][1:] != steps["visits"][:-1]).any(axis=1)
    inside = np.delete(np.arange(steps.rows), open_episodes(made).episodes.last())
    held = arrays(made)
    assert held["rewards"].tolist() == changes[inside].tolist() and held["rewards"].any()
    hind = arrays(made, relabel="last")
    assert hind["rewards"].tolist() == held["rewards"][: len(hind["rewards"])].tolist()
    env = goal_env("tie", nx=2, observation="state", engine="chain", horizon=5)
    seen, _ = env.reset(seed=0)
    with pytest.raises(InvalidInput, match="reward depends on the code before a pull"):
        env.compute_reward(seen["achieved_goal"], seen["desired_goal"], {})


def test_a_third_split(tmp_path: Path, monkeypatch: Patch) -> None:
    known = read_states(shipped(), images=False)
    rows = np.flatnonzero(known.nx <= 1)
    words = {"points": known.points[rows], "split": "val"}
    with pytest.raises(InvalidInput, match="split must be train or test"):
        States.from_points(**words)
    monkeypatch.setitem(SPLITS, "val", SPLITS["test"]._replace(base="val", is_made=False))
    write_states(tmp_path / "states.h5", States.from_points(**words))
    made = collected(tmp_path, states=str(tmp_path / "states.h5"), split="val")
    assert "-val-" in made.name
    with pytest.raises(InvalidInput, match="no states with nx = . in split 'train'"):
        gym.make("knotgym/Tie-v0", nx=1, states=str(tmp_path / "states.h5"))


@pytest.mark.parametrize(
    ("kind", "faults"), [("at most", ["writhe"]), ("at least", []), ("", None)]
)
def test_a_limit_is_a_maximum_if_its_type_says_so(kind: str, faults: list[str] | None) -> None:
    @configuration
    class More(Limits):
        writhe: Annotated[float, Mark(kind)] | None = 1.0

    state = Quality(*[100.0] * len(fields(Quality)))
    if faults is None:
        with pytest.raises(InvalidInput, match="More.writhe must be AtLeast or AtMost"):
            More.only(writhe=1.0).faults(state, 0)
    else:
        assert More.only(writhe=1.0).faults(state, 0) == faults


def test_a_stride_of_windows(monkeypatch: Patch) -> None:
    """Stacks of every second observation: every loader reads them by one function."""

    @configuration
    class Strided(Window):
        stride: PositiveInt = 1

    def stacked(self: Transitions, states: np.ndarray, segments: np.ndarray) -> np.ndarray:
        window, first = self.window, (self.starts[segments] + segments)[:, None]
        assert isinstance(window, Strided) and window.stack
        return np.maximum(states[:, None] + window.stride * np.arange(1 - window.stack, 1), first)

    plain = arrays(TINY["random"], observation="state")
    monkeypatch.setattr(Transitions, "_stack", stacked)
    opening: Any = {"observation": "state", "window": Strided(stack=2, stride=2)}
    held = arrays(TINY["random"], **opening)
    begins = np.append(0, np.flatnonzero(plain["terminals"] | plain["timeouts"]) + 1)
    rows = np.arange(len(plain["rewards"]))
    first = begins[np.searchsorted(begins, rows, side="right") - 1]
    for k, row in enumerate((np.maximum(rows - 2, first), rows)):
        np.testing.assert_array_equal(held["observations"][:, k], plain["observations"][row])
    again = Transitions(TINY["random"], **opening).batch(rows)
    for name, own in held.items():
        np.testing.assert_array_equal(again[name], own)
