"""A learner as a policy: the only thing that it is handed of an episode is its picture."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from knotgym.control.policy import Choice, Effort, InvalidPolicy, Policy
from knotgym.control.transition_graph import TransitionGraphConfig, shipped_transition_graph
from knotgym.episode_batch import EpisodeBatch
from knotgym.learn.agent import Agent, AgentConfig
from knotgym.learn.checkpoint import PRETRAINED, load_policy
from knotgym.learn.colour_reading import SIZE
from knotgym.learn.rope_model import Dynamics
from knotgym.tasks import TaskConfig


class PicturePolicy(Policy):
    """Shows an agent the pictures of its episodes; a `policy.Policy`.

    Of the batch of episodes nothing is asked but the task's settings, when an episode begins, and
    pictures.
    """

    def __init__(self, agent: Agent, name: str) -> None:
        self._agent, self._name = agent, name
        self._seconds: dict[int, float] = {}

    def suited(self, task: TaskConfig) -> TaskConfig:
        apart = [
            f"{name} {given} instead of {needed}"
            for name, given, needed in (
                ("views", ",".join(task.views), "top"),
                ("depth", task.depth, False),
                ("camera", task.camera, "orthographic"),
                ("image_size", task.image_size, SIZE),
                ("hold", task.hold, 1),
            )
            if given != needed
        ]
        if apart:
            raise InvalidPolicy(
                f"policy {self._name} can't act in this task, which has {', '.join(apart)}"
            )
        return task

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        self._agent.begin(index, rng, episodes.config.horizon)
        self._seconds[index] = 0.0

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        actions, moves = [], []
        for index in ids.tolist():
            began = time.perf_counter()
            action, move = self._agent.act(index, episodes.picture(index))
            self._seconds[index] += time.perf_counter() - began
            actions.append(action)
            moves.append(move)
        return Choice(np.stack(actions), moves)

    def name(self, index: int) -> str:
        return self._name

    def effort(self, index: int) -> Effort:
        return Effort(self._agent.imagined(index), self._seconds[index])


def learned_policy(folder: str, config: AgentConfig | None = None) -> PicturePolicy:
    """The policy of a learner's folder, or of the one that ships ("pretrained").

    Raises:
        InvalidCheckpoint: there is none that this version can read.
    """
    learned = load_policy(folder)
    graph = shipped_transition_graph(TransitionGraphConfig())
    agent = Agent(
        learned.reader, Dynamics(learned.rope), graph, learned.places.astype(np.float64), config
    )
    return PicturePolicy(agent, PRETRAINED if folder == PRETRAINED else "learned")
