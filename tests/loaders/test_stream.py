"""Streams: batches of episodes that are played as they are needed."""

from __future__ import annotations

import pickle
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common import InvalidInput
from knotgym.control import PolicyConfig
from knotgym.datasets import open_episodes
from knotgym.envs import TaskConfig
from knotgym.generate import CollectConfig, collect
from knotgym.loaders import EpisodeStream, Transitions, Window, stream
from knotgym.runs import RunOptions

TASK = TaskConfig(task="tie", nx=1, engine="chain", observation="state", horizon=6)
CONFIG = CollectConfig(task=TASK, policy=PolicyConfig(policy="random"), episodes=8, form="columns")


def made(**words: Any) -> EpisodeStream:
    return stream(CONFIG, 3, **{"batch": 8, "episodes": 4, **words})


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(
        np.array_equal(np.asarray(one[name]), np.asarray(other[name])) for name in one
    )


def test_the_first_blocks_are_the_episodes_of_a_collection(tmp_path: Path) -> None:
    folder = collect(CollectConfig(**{**vars(CONFIG), "seed": 3}), tmp_path, RunOptions(workers=1))
    stored = open_episodes(folder).episodes
    for block in (0, 1):
        numbers = range(4 * block, 4 * block + 4)
        played, right = CONFIG.played(numbers, 3), stored.select(np.array(numbers))
        assert np.array_equal(played.steps["observation"], right.steps["observation"])
        assert np.array_equal(played.steps["action"], right.steps["action"])
    held = Transitions(folder).batch(np.arange(len(Transitions(folder))))
    for batch in islice(made(), 2):
        for seen in batch["observations"]:
            assert (held["observations"] == seen).all(axis=1).any()


def test_a_stream_goes_on_where_another_was() -> None:
    whole = [*islice(made(), 4)]
    first = made()
    for k, batch in enumerate(islice(first, 2)):
        assert same(batch, whole[k])
        state = pickle.loads(pickle.dumps(first.state_dict()))
        again = made()
        again.load_state_dict(state)
        assert same(next(iter(again)), whole[k + 1])
    # another iterator of the same stream goes on, too
    assert same(next(iter(first)), whole[2])
    with pytest.raises(InvalidInput, match="had seed 3, this one has 4"):
        stream(CONFIG, 4, batch=8, episodes=4).load_state_dict(first.state_dict())


def test_windows_relabelling_and_own_rewards_reach_a_stream() -> None:
    batch = next(iter(made(window=Window(n_step=2, stack=2))))
    assert batch["observations"].shape == (8, 2, 600)
    own = made(reward=lambda episode, steps: np.full(int(episode["length"]), -0.5))
    rewards = next(iter(own))["rewards"]
    assert (rewards == -0.5).all()


def test_what_makes_no_batch_is_one_line() -> None:
    with pytest.raises(InvalidInput, match="at least 1, got 0 and 4"):
        made(batch=0)
    with pytest.raises(InvalidInput, match="use action 'pull' or 'bead'"):
        made(action="decision")


@pytest.mark.clients
@pytest.mark.parametrize("workers", [1, 2])
def test_workers_give_the_batches_of_a_single_process(workers: int) -> None:
    pytest.importorskip("torch")
    from torch.utils.data import DataLoader

    right = [*islice(made(), 5)]
    loader = DataLoader(made(), batch_size=None, num_workers=workers)
    for batch, wanted in zip(islice(loader, 5), right, strict=True):
        assert same(batch, wanted)
