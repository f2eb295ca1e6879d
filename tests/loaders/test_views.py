"""Decisions and the canonical frame: what loaders make of pulls, policies make pulls of again."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from synthetic_episodes import TINY

from knotgym.common import InvalidPolicy, Threads
from knotgym.control import PolicyConfig, make_policy, rollouts
from knotgym.datasets import Episodes, open_episodes
from knotgym.envs import OBSERVATIONS, Frames, TaskConfig
from knotgym.loaders import Transitions, arrays, as_policy
from knotgym.topology import Symmetry, label

VIEWS = [("state", "canonical"), ("state", "world"), ("marked", "canonical"), ("marked", "world")]
own_policy: Any = None  # played as test_views:own_policy


@pytest.fixture
def played_back(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Play a policy from the starts of the expert's episodes."""
    stored = open_episodes(TINY["expert"])

    def play(policy: Any, lanes: int = 3) -> Episodes:
        monkeypatch.setattr(f"{__name__}.own_policy", policy)
        made = make_policy(PolicyConfig(policy=f"{__name__}:own_policy"))
        return rollouts(made, stored.task, stored.episodes.episodes, lanes=lanes)

    return play


def nearest(known: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return np.abs(seen[:, None] - known).max(axis=2).argmin(axis=1)


@pytest.mark.parametrize(("observation", "frame"), VIEWS)
@pytest.mark.parametrize("action", ["decision", "pull", "macro"])
def test_what_is_acted_out_are_the_pulls(
    observation: str, frame: str, action: str, played_back: Any
) -> None:
    data = arrays(TINY["expert"], observation=observation, action=action, frame=frame)

    def remember(seen: np.ndarray) -> Any:
        return data["actions"][nearest(data["observations"], seen)]

    found = played_back(as_policy(remember, action, frame, observation)).steps
    stored = open_episodes(TINY["expert"]).episodes.steps
    assert np.array_equal(found["bead"], stored["bead"])
    np.testing.assert_allclose(found["force"], stored["force"], atol=1e-5)


def test_a_bead_may_be_chosen_by_logits(played_back: Any) -> None:
    data = arrays(TINY["expert"], observation="marked", action="decision", frame="canonical")

    def remember(seen: np.ndarray) -> Any:
        row = nearest(data["observations"], seen)
        rows = np.zeros((len(row), 100, 41))
        rows[np.arange(len(row)), data["beads"][row]] = np.insert(data["actions"][row, 3:], 0, 1, 1)
        return rows

    found = played_back(as_policy(remember)).steps
    assert np.array_equal(found["bead"], open_episodes(TINY["expert"]).episodes.steps["bead"])


def test_decisions_are_whole_or_say_that_they_are_not() -> None:
    stored = open_episodes(TINY["expert"])
    opened = Transitions(stored, observation="state", action="decision")
    batch, steps = opened.batch(np.arange(len(opened))), stored.episodes.steps
    own = opened._segments
    for k, (before, after) in enumerate(zip(own.before, own.after, strict=True)):
        made = batch["actions"][k, 33:] > 0
        count = int(made.sum())
        assert made[:count].all() and batch["whole"][k] == (count in (after - before, 10))
        forces = batch["actions"][k, 3:33].reshape(10, 3)
        np.testing.assert_array_equal(forces[:count], steps["force"][before : before + count])
        assert not forces[count:].any() and batch["beads"][k] == steps["bead"][before]
        vertices = steps["observation"][before].astype(np.float64)
        place = vertices[steps["bead"][before]] - vertices.mean(axis=0)
        np.testing.assert_allclose(batch["actions"][k, :3], 3 * place, atol=1e-6)


def test_a_model_acts_the_same_in_any_lanes_and_may_reuse_its_array(played_back: Any) -> None:
    weights, kept = np.random.default_rng(0).normal(size=(609, 43)), np.zeros((32, 43))

    def linear(seen: np.ndarray) -> Any:
        kept[:] = np.tanh(seen @ weights)
        seen[:] = 0
        return kept

    one, three = (played_back(as_policy(linear), lanes) for lanes in (1, 3))
    assert np.array_equal(one.steps["observation"], three.steps["observation"])


@pytest.mark.parametrize("observation", ["state", "marked"])
@pytest.mark.parametrize("action", ["decision", "pull", "macro"])
def test_an_environment_takes_the_same_two_words(observation: str, action: str) -> None:
    words: dict[str, Any] = {"observation": observation, "action": action, "frame": "canonical"}
    data = arrays(TINY["expert"], **words)
    stored = open_episodes(TINY["expert"])
    env: Any = gym.make("knotgym/Tie-v0", **{**vars(stored.task), **words})
    seed = int(stored.episodes.episodes["seed"][0])
    seen, _ = env.reset(seed=seed)
    np.testing.assert_allclose(seen, data["observations"][0], atol=1e-6)
    end = Transitions(stored, **words).starts[1]
    for k in range(int(end)):
        seen, _, terminated, truncated, _ = env.step(data["actions"][k])
        np.testing.assert_allclose(seen, data["next_observations"][k], atol=1e-4)
    assert terminated or truncated


def test_the_canonical_frame_shows_all_images_of_a_state_alike() -> None:
    stored = open_episodes(TINY["expert"]).episodes
    rope = stored.steps["observation"][:1].astype(np.float64)
    goal = stored.episodes["goal_points"][:1].astype(np.float64)
    task = TaskConfig(task="tie", observation="state", frame="canonical")
    seen = []
    for turn, mirror, switch in ((0.0, False, False), (2.0, True, False), (1.0, False, True)):
        image = Symmetry(turn, mirror, switch, False)
        points, wanted = image.vertices(rope), image.vertices(goal)
        visits = np.array([label(wanted[0]).visits], np.int16)
        frames = Frames(
            points, visits, wanted, visits, lambda ids: np.zeros(0, np.uint8), Threads()
        )
        ids = np.arange(2)
        seen.append(OBSERVATIONS["state"].observe(task, frames, ids[:1], ids[1:]))
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-6)
    np.testing.assert_allclose(seen[2], seen[0], atol=1e-6)


def test_what_is_no_model_or_acts_wrongly_is_one_line(played_back: Any) -> None:
    with pytest.raises(InvalidPolicy, match="must give 43 finite numbers in"):
        played_back(as_policy(lambda seen: np.zeros((len(seen), 6))))
    for shape in ((32, 6), (32, 7, 41), (32, 100, 6)):
        rows = np.zeros(shape, np.float32)
        with pytest.raises(InvalidPolicy, match="give 43 finite|of each bead are .100, 41"):
            played_back(as_policy(partial(lambda rows, seen: rows, rows)))
    with pytest.raises(InvalidPolicy, match=r"a row for each observation: 32 gave \(1, 43\)"):
        played_back(as_policy(lambda seen: np.zeros((1, 43))))
