"""Everything that Minari does with a dataset, done with one: load, show, list, iterate, sample,
recover the environment, every frame compared.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import minari
import minari.cli
import numpy as np
import pytest
from typer.testing import CliRunner

from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_verification import verify_episodes


def check_minari(root: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that Minari finds, under `root`, the dataset `name`, and in it what was written."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    for command in (["show", name], ["list", "local"]):
        shown = CliRunner().invoke(minari.cli.app, command, env={"COLUMNS": "200"})
        assert shown.exit_code == 0 and name in shown.output
    assert verify_episodes(root / name, frames=None, act_out=True) == []
    dataset, reader = minari.load_dataset(name), EpisodeReader(root / name)
    assert (dataset.total_episodes, dataset.total_steps) == (len(reader), int(reader.lengths.sum()))
    every = list(dataset.iterate_episodes())
    assert [episode.id for episode in every] == list(range(len(reader)))
    assert all(_same(read, reader, read.id) for read in every)
    sampled = list(dataset.sample_episodes(min(3, len(reader))))
    assert len(sampled) == min(3, len(reader)) and all(
        _same(read, reader, read.id) for read in sampled
    )
    env: Any = dataset.recover_environment()
    assert env.unwrapped.config == reader.task
    assert (env.observation_space, env.action_space) == (
        dataset.observation_space,
        dataset.action_space,
    )
    for read in every:
        _play(env, read, reader.episode(read.id))


def _same(read: Any, reader: EpisodeReader, index: int) -> bool:
    """Whether Minari reads what our own reader reads."""
    episode = reader.episode(index)
    names = ("actions", "rewards", "terminations", "truncations")
    columns = all(np.array_equal(getattr(read, name), getattr(episode, name)) for name in names)
    return columns and _equal(read.observations, reader.observations(index))


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return sorted(one) == sorted(other) and all(
            np.array_equal(one[name], other[name]) for name in one
        )
    return np.array_equal(one, other)


def _play(env: Any, read: Any, episode: Any) -> None:
    """Act an episode out in the recovered environment, which shows every stored frame; one that no
    reset begins is left to `verify_episodes`.
    """
    if episode.seed is None or episode.relabelled:
        seen, _ = env.reset(seed=0)
        assert env.observation_space.contains(seen)
        return
    shown = [
        env.reset(seed=episode.seed, options=dict(episode.options))[0],
        *(env.step(action)[0] for action in read.actions),
    ]
    stacked = (
        {name: np.array([one[name] for one in shown]) for name in shown[0]}
        if isinstance(shown[0], dict)
        else np.array(shown)
    )
    assert _equal(stacked, read.observations)
