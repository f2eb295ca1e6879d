"""Sets that Minari recorded in a user's environment load like ours, with the user's own rewards."""

import json
import pickle
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
from minari.data_collector.episode_buffer import EpisodeBuffer

from knotgym.common import InvalidFile, InvalidInput, MissingFile
from knotgym.datasets import locate
from knotgym.loaders import GoalSampling, Transitions, Window, arrays

NAME = "mine/fewer-v0"


class Fewer(gym.Wrapper[Any, Any, Any, Any]):
    """A reward of the user's own: the fewer crossings, the better."""

    def step(self, action: Any) -> Any:
        seen, _, terminated, truncated, info = super().step(action)
        return seen, -float(info["crossings"]), terminated, truncated, info


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What `minari.DataCollector` writes, without jax, which it needs."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    settings: dict[str, Any] = {"observation": "state", "engine": "chain", "horizon": 4}
    env = Fewer(gym.make("knotgym/Unknot-v0", nx=2, **settings))
    buffers = []
    for seed in range(3):
        env.action_space.seed(seed)
        rows = [(env.reset(seed=seed)[0], None, None, None, None)]
        while not any(rows[-1][3:]):
            action = env.action_space.sample()
            seen, reward, *ends, _ = env.step(action)
            rows.append((seen, action, reward, *ends))
        seen, *others = (list(column) for column in zip(*rows, strict=True))
        names = ("actions", "rewards", "terminations", "truncations")
        own = {name: column[1:] for name, column in zip(names, others, strict=True)}
        buffers.append(EpisodeBuffer(id=seed, seed=seed, observations=seen, **own))
    minari.create_dataset_from_buffers(NAME, buffers, env=env, eval_env=env)
    return tmp_path / NAME / "data"


def test_own_rewards_reach_the_loaders(folder: Path) -> None:
    recorded = minari.load_dataset(NAME)
    loaded, every = arrays(NAME), [*recorded.iterate_episodes()]
    for ours, theirs in (("rewards", "rewards"), ("actions", "actions")):
        expected = np.concatenate([getattr(one, theirs) for one in every])
        assert np.array_equal(loaded[ours], expected)
    expected = np.concatenate([one.observations[1:] for one in every])
    assert np.array_equal(loaded["next_observations"], expected) and loaded["rewards"].min() < 0
    second = arrays(recorded.filter_episodes(lambda one: one.id == 1))
    assert np.array_equal(second["rewards"], every[1].rewards)
    windows = arrays(NAME, observation="symbolic", window=Window(goals=GoalSampling()))
    assert windows["observations"].shape == (len(expected), 2, 64)
    both = pickle.loads(pickle.dumps(Transitions([NAME, recorded], observation="state")))
    assert len(both) == 2 * len(expected)


def test_what_is_not_there_is_named(folder: Path) -> None:
    with pytest.raises(InvalidInput, match="doesn't record macro-actions"):
        arrays(NAME, action="macro")
    metadata = json.loads((folder / "metadata.json").read_text())
    with h5py.File(folder / "main_data.hdf5", "r+") as file:
        del file["episode_0/observations"]
        file["episode_0/observations"] = np.zeros((5, 128, 256, 3), np.uint8)
    with pytest.raises(InvalidFile, match="no vertices: record with observation='state' or"):
        arrays(NAME)
    spec = json.loads(metadata["env_spec"]) | {"id": "CartPole-v1"}
    (folder / "metadata.json").write_text(json.dumps({**metadata, "env_spec": json.dumps(spec)}))
    with pytest.raises(InvalidFile, match="CartPole-v1, no environment of knotgym"):
        arrays(NAME)


def test_what_can_not_be_checked_or_read_is_said_as_such(folder: Path) -> None:
    with pytest.raises(InvalidInput, match="recorded can be loaded, but not checked"):
        locate(NAME)
    (folder / "main_data.hdf5").unlink()
    (folder / "0").mkdir()
    (folder / "0" / "part-0.arrow").touch()
    with pytest.raises(MissingFile, match="Minari's format arrow: record it with"):
        arrays(NAME)
