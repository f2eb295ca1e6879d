"""The bound on towing: which states exceed it, its reward, and which policies respect it."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.control import Policy, PolicyConfig, make_policy, rollouts
from knotgym.datasets import Episodes, write_episodes
from knotgym.envs import TaskConfig
from knotgym.generate import verify
from knotgym.rope.actions import TowBound

LIMIT = 0.04


def bounded(states_path: str, **settings: Any) -> TaskConfig:
    fields: dict[str, Any] = {"task": "unknot", "nx": 2, "states": states_path}
    return TaskConfig(**{**fields, "observation": "state", "tow_limit": LIMIT, **settings})


def policy(name: str) -> Policy:
    return make_policy(PolicyConfig(policy=name))


@pytest.fixture(scope="module")
def towed(states_path: str) -> Episodes:
    """Two episodes of the constant action, both towed beyond the limit."""
    return rollouts(policy("constant"), bounded(states_path), range(2))


def test_a_rope_is_as_far_as_its_centre() -> None:
    square = np.array([[[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]], dtype=np.float64)
    assert np.array_equal(TowBound.centres(square), [[1, 1, 0]])
    bound = TowBound(TowBound.centres(square)[0], 4.99)
    assert bound.exceeded(np.concatenate([square, square + [0, 3, 4]])).tolist() == [False, True]


def test_an_episode_ends_at_the_first_state_beyond_and_pays_for_failing(towed: Episodes) -> None:
    for number in range(2):
        steps = towed.select([number]).steps
        points = steps["observation"].astype(np.float64)
        far = TowBound(TowBound.centres(points[:1]), LIMIT).exceeded(points)
        assert not far[:-1].any() and far[-1] and len(far) < 50
        assert steps["truncated"][-2] and not steps["terminated"].any()
        assert steps["reward"].tolist() == [*[0.0] * (len(far) - 2), -5.0, 0.0]


def test_the_expert_s_plans_keep_to_the_bound(states_path: str) -> None:
    played = rollouts(policy("expert"), bounded(states_path, nx=1, engine="chain"), [1])
    points = played.steps["observation"].astype(np.float64)
    assert played.episodes["success"].all()
    assert not TowBound(TowBound.centres(points[:1]), LIMIT).exceeded(points).any()


def test_verify_knows_the_bound(towed: Episodes, states_path: str, tmp_path: Path) -> None:
    shutil.copy(states_path, tmp_path / "states.h5")
    random = rollouts(policy("random"), bounded(states_path), range(1))
    both = Episodes.merged([random, towed])
    write_episodes(tmp_path / "e.h5", [both], bounded(states_path))
    assert verify(tmp_path / "e.h5") == []
    write_episodes(tmp_path / "f.h5", [towed], bounded(states_path, tow_limit=LIMIT / 2))
    assert any("length differs" in fault for fault in verify(tmp_path / "f.h5"))
