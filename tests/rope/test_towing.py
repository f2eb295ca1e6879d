"""The bound on towing: which states exceed it, its reward, and which policies respect it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common.errors import InvalidInput
from knotgym.control.expert import Expert
from knotgym.control.old_basic_policies import ConstantPolicy
from knotgym.control.old_policies import make_policy
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import rollout
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_verification import verify_episodes
from knotgym.datasets.episode_writer import EpisodeWriter
from knotgym.datasets.trajectory import Episode, goals_reached, relabel_all
from knotgym.datasets.trajectory import relabelled as cut_at
from knotgym.envs.environment import KnotEnv
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.loaders import arrays
from knotgym.rope.towing import TowBound, centres, distances_towed

LIMIT = 0.04
TOW = np.ones(6, dtype=np.float32)


def bounded(states_path: str, **settings: Any) -> TaskConfig:
    fields: dict[str, Any] = {"task": "unknot", "nx": 2, "states": states_path}
    return TaskConfig(**{**fields, "observation": "state", "tow_limit": LIMIT, **settings})


@pytest.fixture(scope="module")
def towed(states_path: str) -> list[Episode]:
    """Return two episodes of the constant action, both towed beyond the limit."""
    policy = make_policy(PolicyConfig(policy="constant"))
    return [one.episode for one in rollout(bounded(states_path), policy, range(2), 0)]


def test_a_rope_is_as_far_as_its_centre() -> None:
    square = np.array([[[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]], dtype=np.float64)
    assert np.array_equal(centres(square), [[1, 1, 0]])
    assert distances_towed(square + [0, 3, 4], centres(square)) == 5
    bound = TowBound(centres(square)[0], 4.0)
    assert bound.exceeded(np.concatenate([square, square + [0, 3, 4]])).tolist() == [False, True]


def test_an_episode_ends_at_the_first_state_beyond_and_pays_for_failing(
    towed: list[Episode],
) -> None:
    for episode in towed:
        far = distances_towed(episode.points, centres(episode.points[:1]))
        assert (far[:-1] <= LIMIT).all() and far[-1] > LIMIT and len(episode) < 50
        assert episode.truncations[-1] and not episode.terminations.any()
        assert episode.rewards.tolist() == [0.0] * (len(episode) - 1) + [-5.0]


def test_beyond_the_bound_no_state_counts_as_the_goal(states_path: str) -> None:
    env = KnotEnv("unknot", nx=1, states=states_path, observation="state", tow_limit=1e-6)
    env.reset(seed=0)
    goal_is_shown(env.episodes, 0)  # shown already, and after a small step too
    *_, terminated, truncated, info = env.step(np.array([0, 0, 0, 0, 0, 0.1], dtype=np.float32))
    assert info["gauss_code"] == info["goal_gauss_code"]
    assert truncated and not terminated and not info["is_success"]


def test_without_a_bound_a_rope_is_towed_anywhere(states_path: str) -> None:
    episodes = EpisodeBatch(bounded(states_path, tow_limit=None))
    episodes.begin(0, np.random.default_rng(0))
    for _ in range(8):
        _, _, truncated = episodes.step(TOW[None], np.array([0]))
        assert not truncated[0]
    assert distances_towed(episodes.simulation.points, episodes.origins)[0] > LIMIT
    assert episodes.tow_bound(0) is None


def test_the_bound_is_laid_anew_at_every_reset(states_path: str) -> None:
    env = KnotEnv("unknot", nx=2, states=states_path, observation="state", tow_limit=LIMIT)
    lengths = []
    for _ in range(2):
        env.reset(seed=3)
        lengths.append(0)
        truncated = False
        while not truncated:
            truncated = env.step(TOW)[3]
            lengths[-1] += 1
    assert lengths[0] == lengths[1] > 1


def test_the_expert_s_plans_keep_to_the_bound(states_path: str) -> None:
    expert = Expert(PlannerConfig(budget=400, batch_size=4))
    (played,) = rollout(bounded(states_path, nx=1), expert, [1], 0)
    points = played.episode.points
    assert played.success and distances_towed(points, centres(points[:1])).max() <= LIMIT


def test_a_dataset_with_a_bound_is_verified_and_hindsight_keeps_to_it(
    states_path: str, tmp_path: Path
) -> None:
    task = bounded(states_path, horizon=12)
    played = rollout(task, make_policy(PolicyConfig(policy="random")), range(2), 0)
    own = [one.episode for one in (*played, *rollout(task, ConstantPolicy(), range(2, 4), 0))]
    with EpisodeWriter(tmp_path / "own.h5", task) as writer:
        for episode in own:
            writer.add(episode)
    assert verify_episodes(tmp_path / "own.h5", act_out=True) == []
    hindsight = list(relabel_all(own, "all", tow_limit=LIMIT))
    with EpisodeWriter(tmp_path / "hindsight.h5", task) as writer:
        for episode in hindsight:
            writer.add(episode)
    assert verify_episodes(tmp_path / "hindsight.h5", pyknotid=False) == []
    loaded = arrays(tmp_path / "own.h5", relabel="all")
    assert (
        loaded["terminals"].sum() == len(hindsight) == len(EpisodeReader(tmp_path / "hindsight.h5"))
    )


def test_a_state_beyond_the_bound_is_no_goal_in_hindsight(towed: list[Episode]) -> None:
    for episode in towed:
        last = len(episode)
        if last in goals_reached(episode.gauss_code):
            with pytest.raises(InvalidInput, match="goal_step"):
                cut_at(episode, last, tow_limit=LIMIT)
        assert all(len(cut) < last for cut in relabel_all([episode], "all", tow_limit=LIMIT))


def test_verify_names_an_episode_that_went_on_beyond_the_bound(
    towed: list[Episode], states_path: str, tmp_path: Path
) -> None:
    with EpisodeWriter(tmp_path / "e.h5", bounded(states_path, tow_limit=LIMIT / 2)) as writer:
        writer.add(towed[0])
    assert any("truncations" in fault for fault in verify_episodes(tmp_path / "e.h5"))


@pytest.mark.parametrize("limit", [0, -0.1, float("nan")])
def test_bounds_that_cannot_be_had_are_refused_in_one_line(limit: float) -> None:
    with pytest.raises(InvalidInput, match="tow_limit must be ") as no:
        TaskConfig(task="unknot", tow_limit=limit)
    assert "\n" not in str(no.value)
