"""Actions as pulls, as beads and bins, or as macro-actions: one rope, one data set, three views."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from knotgym.common import InvalidInput
from knotgym.control import PolicyConfig, make_policy, rollouts
from knotgym.datasets import open_episodes, write_episodes
from knotgym.envs.environment import KnotEnv
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import Transitions, arrays
from knotgym.rope import ActionView, quantized

VIEWS = ("bead", "macro")


@pytest.fixture(scope="module")
def task(states_path: str) -> TaskConfig:
    return TaskConfig(
        task="tie", nx=3, states=states_path, observation="state", action="macro", horizon=24
    )


@pytest.fixture(scope="module")
def played(task: TaskConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes of random macro-actions."""
    path = tmp_path_factory.mktemp("macro") / "episodes.h5"
    write_episodes(path, [rollouts(make_policy(PolicyConfig()), task, range(4))], task)
    return path


def settings(task: TaskConfig, **changes: Any) -> dict[str, Any]:
    return {"nx": task.nx, "states": task.states, "observation": "state", **changes}


@pytest.mark.parametrize("view, size", [("bead", [100, 11, 11, 11]), ("macro", [100, 100, 2])])
def test_a_view_has_its_space(view: str, size: list[int], task: TaskConfig) -> None:
    one = gym.make("knotgym/Tie-v0", **settings(task, action=view))
    assert isinstance(one.action_space, gym.spaces.MultiDiscrete)
    assert one.action_space.nvec.tolist() == size
    many = gym.make_vec("knotgym/Tie-v0", num_envs=2, **settings(task, action=view))
    assert many.action_space.sample().shape == (2, len(size))


def test_bins_have_a_zero_and_lie_on_the_grid_of_quantized_pulls() -> None:
    forces = ActionView.chosen_forces(np.arange(11))
    assert forces[5] == 0 and forces[[0, -1]].tolist() == [-1, 1]
    assert np.array_equal(quantized(forces), forces)
    assert ActionView.force_choices(forces).tolist() == list(range(11))


def test_a_bead_action_pulls_that_bead(task: TaskConfig) -> None:
    env = KnotEnv("tie", **settings(task, action="bead"))
    env.reset(seed=0)
    *_, info = env.step(np.array([42, 0, 5, 10]))
    assert info["bead"] == 42 and "macro_pulls" not in info
    largest = env.episodes.simulation.max_force
    assert info["force"] == pytest.approx(info["applied_share"] * largest * np.array([-1, 0, 1]))


def test_the_horizon_counts_pulls(task: TaskConfig) -> None:
    env = KnotEnv("tie", **settings(task, action="macro", horizon=3))
    env.reset(seed=0)
    # the far side of the rope is more than three pulls away
    _, reward, terminated, truncated, info = env.step(np.array([0, 50, 1]))
    assert (reward, terminated, truncated, info["macro_pulls"]) == (-5.0, False, True, 3)


def test_a_macro_action_of_an_endless_task_is_paid_for_all_of_its_pulls(task: TaskConfig) -> None:
    env = KnotEnv("tie", **settings(task, action="macro", endless=True))
    env.reset(seed=0)
    env.episodes.wanted[0] = env.episodes.visits[0]  # the goal is what the rope shows now
    pulls, paid = 0, 0.0
    while not paid:
        _, reward, *_, info = env.step(np.array([0, 50, 1]))
        pulls, paid = pulls + info["macro_pulls"], paid + reward
    assert paid == env.episodes.held[0] * task.success_reward and pulls > 3


def test_one_dataset_has_the_transitions_of_every_view(played: Path) -> None:
    pull, bead, macro = (arrays(played, action=view) for view in ("pull", *VIEWS))
    assert np.array_equal(arrays(played)["actions"], macro["actions"])  # the environment's view
    assert np.array_equal(bead["actions"][:, 1:], ActionView.force_choices(pull["actions"][:, 3:]))
    stored = open_episodes(played).episodes
    pulled = np.delete(stored.steps["bead"], stored.last())
    assert np.array_equal(bead["actions"][:, 0], pulled)
    for name in ("observations", "rewards", "terminals"):
        assert np.array_equal(bead[name], pull[name])
    stops = np.cumsum(macro["pulls"])
    starts = stops - macro["pulls"]
    assert stops[-1] == len(pull["actions"]) and macro["pulls"].max() <= ActionView.LONGEST
    assert np.array_equal(macro["actions"][:, 0], bead["actions"][starts, 0])
    assert np.array_equal(macro["observations"], pull["observations"][starts])
    assert np.array_equal(macro["next_observations"], pull["next_observations"][stops - 1])
    assert macro["rewards"].sum() == pull["rewards"].sum()
    for name in ("rewards", "terminals", "timeouts"):
        assert np.array_equal(macro[name], pull[name][stops - 1])
    assert (macro["terminals"] | macro["timeouts"]).sum() == 4


def test_hindsight_cuts_macro_actions_where_the_goal_is_reached(played: Path) -> None:
    macro, pull = (Transitions(played, action=view, relabel="all") for view in ("macro", "pull"))
    assert macro.segments == pull.segments > 0
    assert macro.rewards.sum() == pull.rewards.sum() and macro.terminals.sum() == macro.segments
    ends = [0, *np.cumsum(macro.pulls[: macro.starts[1]])]  # of the first segment
    assert np.array_equal(macro.observations(0), pull.observations(0)[ends])


def test_labels_are_pulls(played: Path) -> None:
    with pytest.raises(InvalidInput, match="the expert's actions are pulls"):
        arrays(played, labels=True)
