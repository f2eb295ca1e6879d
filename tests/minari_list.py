"""Everything that Minari does with a dataset, done with one: load, show, list, iterate, sample,
recover the environment, every frame compared.
"""

from pathlib import Path
from typing import Any

import minari
import minari.cli
import numpy as np
import pytest
from typer.testing import CliRunner

from knotgym.datasets import Episodes, columns_of
from knotgym.generate import verify


def check_minari(root: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assert that Minari finds, under `root`, the dataset `name`, and in it what was written."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    for command in (["show", name], ["list", "local"]):
        shown = CliRunner().invoke(minari.cli.app, command, env={"COLUMNS": "200"})
        assert shown.exit_code == 0 and name in shown.output
    assert verify(root / name) == []
    dataset, opened = minari.load_dataset(name), columns_of(root / name)
    count, steps = opened.episodes.episodes.rows, int(opened.episodes.episodes["length"].sum())
    assert (dataset.total_episodes, dataset.total_steps) == (count, steps)
    env: Any = dataset.recover_environment()
    assert env.unwrapped.config == opened.task
    assert env.observation_space == dataset.observation_space
    assert env.action_space == dataset.action_space
    every = list(dataset.iterate_episodes())
    assert [episode.id for episode in every] == list(range(count))
    assert len(list(dataset.sample_episodes(min(3, count)))) == min(3, count)
    for read in every:
        _act_out(env, read, opened.episodes.select([read.id]))


def _act_out(env: Any, read: Any, stored: Episodes) -> None:
    """Compare what Minari reads with the columns, and act it out in the recovered environment,
    which shows every stored frame; an episode that no reset begins is left to `verify`.
    """
    names = {"action": "actions", "reward": "rewards", "terminated": "terminations"}
    for name, of_minari in {**names, "truncated": "truncations"}.items():
        assert np.array_equal(stored.steps[name][:-1], getattr(read, of_minari))
    own = {name: stored.episodes[name][0] for name in ("seed", "start", "goal")}
    if own["seed"] < 0:
        assert env.observation_space.contains(env.reset(seed=0)[0])
        return
    options = {"start": int(own["start"]), "goal": int(own["goal"])}
    shown = [env.reset(seed=int(own["seed"]), options=options)[0]]
    shown += [env.step(action)[0] for action in read.actions]
    if isinstance(shown[0], dict):
        for name in shown[0]:
            assert np.array_equal([one[name] for one in shown], read.observations[name])
    else:
        assert np.array_equal(shown, read.observations)
