"""The learner as a policy: it observes nothing but pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.common.errors import InvalidPolicy
from knotgym.control.old_policies import make_policy
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import rollout
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.collect import EpisodeRecipe
from knotgym.generate.episodes.collect_config import CollectConfig
from knotgym.generate.episodes.evaluate import run
from knotgym.generate.episodes.evaluate_config import EvaluateConfig
from knotgym.runs.run_options import RunOptions

pytestmark = pytest.mark.clients
pytest.importorskip("torch")
pytest.importorskip("safetensors")


class PicturesAlone:
    """A stand-in for a batch of episodes that has only settings and pictures.

    Access to anything else fails.
    """

    def __init__(self, config: TaskConfig, pictures: list[NDArray[np.uint8]]) -> None:
        self.config, self._pictures = config, pictures

    def picture(self, index: int) -> NDArray[np.uint8]:
        return self._pictures[index]

    def __getattr__(self, name: str) -> Any:
        raise AssertionError(f"the learner accessed {name}")


@pytest.fixture(scope="module")
def shown(states_path: str) -> PicturesAlone:
    task = TaskConfig(task="unknot", nx=1, states=states_path, observation="pixels")
    batch = EpisodeBatch(task, 2)
    for index in range(2):
        batch.begin(index, np.random.default_rng(index))
    return PicturesAlone(task, [batch.picture(index).copy() for index in range(2)])


def actions(learner: Path, shown: Any, seed: int = 0) -> NDArray[np.float32]:
    policy = make_policy(PolicyConfig(policy=str(learner)))
    for index in range(2):
        policy.begin(shown, index, np.random.default_rng(seed))
    return np.stack([policy.act(shown, np.arange(2)).actions for _ in range(2)])


def test_it_acts_on_pictures_alone(learner: Path, shown: Any) -> None:
    acted = actions(learner, shown)
    assert acted.shape == (2, 2, 6) and acted.dtype == np.float32
    assert (np.abs(acted) <= 1).all()


def test_the_same_pictures_and_seed_give_the_same_actions(learner: Path, shown: Any) -> None:
    assert np.array_equal(actions(learner, shown), actions(learner, shown))


def test_its_networks_run_on_one_thread(
    learner: Path, shown: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    from knotgym.learn.bead_network import BeadNetwork

    threads, forward = [], BeadNetwork.forward

    def counted(network: BeadNetwork, inputs: torch.Tensor) -> torch.Tensor:
        threads.append(torch.get_num_threads())
        return forward(network, inputs)

    monkeypatch.setattr(BeadNetwork, "forward", counted)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        actions(learner, shown)
        assert set(threads) == {1} and torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"camera": "perspective"}, "camera perspective instead of orthographic"),
        ({"views": ("left",)}, "views left instead of top"),
        ({"views": ("top", "front")}, "views top,front instead of top"),
        ({"depth": True}, "depth True instead of False"),
        ({"image_size": 64}, "image_size 64 instead of 128"),
        ({"hold": 2}, "hold 2 instead of 1"),
    ],
)
def test_a_task_whose_pictures_are_others_is_refused_before_any_work(
    learner: Path, states_path: str, tmp_path: Path, setting: dict[str, Any], message: str
) -> None:
    policy = PolicyConfig(policy=str(learner))
    task = TaskConfig(task="unknot", nx=1, states=states_path, **setting)
    with pytest.raises(InvalidPolicy, match=message):
        rollout(task, make_policy(policy), [0], 0)
    with pytest.raises(InvalidPolicy, match=message):
        EpisodeRecipe(CollectConfig(task=task, policy=policy), RunOptions())
    config = EvaluateConfig(policies=(policy,), tasks=("unknot",), nx=(1,), task=task)
    with pytest.raises(InvalidPolicy, match=message):
        run(config, RunOptions(workers=1, quiet=True))
