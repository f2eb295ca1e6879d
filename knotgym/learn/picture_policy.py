"""The learner from pictures as a policy: it gets nothing of an episode but its pictures."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidPolicy
from knotgym.control import Player, Pulls
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.learn.agent import Agent
from knotgym.learn.checkpoint import PRETRAINED, Learned, load_reader
from knotgym.learn.colour_reading import BEADS, SIZE


class PicturePolicy:
    """Runs an agent on the pictures of its episodes.

    Its players read nothing of the batch but the horizon, when an episode begins, and the pictures.

    Attributes:
        name: of the policy.
    """

    def __init__(self, learned: Learned, name: str) -> None:
        self.name, self._learned = name, learned

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """Return the task; raise InvalidPolicy if the reader can't read its pictures."""
        return require_readable(task, self.name)

    def player(self, batch: EpisodeBatch) -> Player:
        """Return a player for the lanes of a batch."""
        starts = self._learned.starts.astype(np.float64)
        return _PicturePlayer(Agent(self._learned.reader, starts), batch)


class _PicturePlayer:
    def __init__(self, agent: Agent, batch: EpisodeBatch) -> None:
        self._agent, self._batch = agent, batch
        self.planned = np.zeros(batch.count, dtype=np.int64)

    def begin(self, ids: NDArray[np.int64], rngs: Sequence[np.random.Generator]) -> None:
        self.planned[ids] = 0
        for index, rng in zip(ids.tolist(), rngs, strict=True):
            self._agent.begin(index, rng, self._batch.task.horizon)

    def act(self, ids: NDArray[np.int64]) -> Pulls:
        actions = np.stack(
            [self._agent.act(index, self._batch.rgb(index)) for index in ids.tolist()]
        )
        self.planned[ids] = [self._agent.imagined(index) for index in ids.tolist()]
        # The agent names a point, as an action does: which bead that is, the simulation decides and
        # the agent must infer.
        beads, _ = self._batch.simulation.read_actions(actions, ids)
        return Pulls(ids, beads, actions[:, 3:])


def require_readable(task: TaskConfig, policy: str, action: str = "pull") -> TaskConfig:
    """Return the task if the reader can read its pictures, and it has an action view.

    Raises:
        InvalidPolicy: it doesn't.
    """
    differing = [
        f"{name} {given} instead of {needed}"
        for name, given, needed in (
            ("beads", task.beads, BEADS),
            ("views", ",".join(task.views), "top"),
            ("depth", task.depth, False),
            ("camera", task.camera, "orthographic"),
            ("appearance", task.appearance, "published"),
            ("image_size", task.image_size, SIZE),
            ("hold", task.hold, 1),
            ("action", task.action, action),
        )
        if given != needed
    ]
    if differing:
        raise InvalidPolicy(
            f"policy {policy} can't act in this task, which has {', '.join(differing)}"
        )
    return task


def load_picture_policy(folder: str) -> PicturePolicy:
    """Load the policy of a checkpoint folder, or "pretrained", which ships with the package.

    Raises:
        InvalidFile: there is no checkpoint that this version can read.
    """
    return PicturePolicy(load_reader(folder), PRETRAINED if folder == PRETRAINED else "learned")
