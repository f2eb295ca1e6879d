"""The learner from pictures as a policy: it observes nothing else."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.common import InvalidPolicy
from knotgym.control import PolicyConfig, make_policy
from knotgym.envs import EpisodeBatch, TaskConfig

pytestmark = pytest.mark.clients
TASK = TaskConfig(task="unknot", nx=1, engine="chain")


class PicturesAlone:
    """A stand-in for a batch that has only settings and pictures; any other access fails."""

    def __init__(self, batch: EpisodeBatch) -> None:
        self.task, self.count = batch.task, batch.count
        self._pictures = [batch.rgb(index) for index in range(batch.count)]
        self.simulation = self

    def rgb(self, index: int) -> NDArray[np.uint8]:
        return self._pictures[index]

    def read_actions(self, actions: Any, ids: Any) -> Any:
        """The engine finds the beads that named points pull; the learner isn't told."""
        self.actions = actions
        return np.zeros(len(ids), dtype=np.int64), None

    def __getattr__(self, name: str) -> Any:
        raise AssertionError(f"the learner accessed {name}")


@pytest.fixture(scope="module")
def shown() -> PicturesAlone:
    batch = EpisodeBatch(TASK, 2)
    batch.begin(np.arange(2), [0, 1])
    return PicturesAlone(batch)


def actions(learner: Path, shown: Any) -> NDArray[np.float32]:
    player = make_policy(PolicyConfig(policy=str(learner))).player(shown)
    player.begin(np.arange(2), [np.random.default_rng(0) for _ in range(2)])
    acted = []
    for _ in range(2):
        player.act(np.arange(2))
        acted.append(shown.actions)
    return np.stack(acted)


def test_it_acts_on_pictures_alone_and_the_same_every_time(learner: Path, shown: Any) -> None:
    acted = actions(learner, shown)
    assert acted.shape == (2, 2, 6) and acted.dtype == np.float32
    assert (np.abs(acted) <= 1).all()
    assert np.array_equal(acted, actions(learner, shown))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"views": ("top", "front")}, "views top,front instead of top"),
        ({"appearance": "photo"}, "appearance photo instead of published"),
        ({"hold": 2}, "hold 2 instead of 1"),
    ],
)
def test_other_pictures_are_refused(learner: Path, setting: dict[str, Any], message: str) -> None:
    policy = make_policy(PolicyConfig(policy=str(learner)))
    with pytest.raises(InvalidPolicy, match=message):
        policy.compatible_task(replace(TASK, **setting))
