"""The learner as a policy: it gets nothing of an episode but its pictures."""

import time

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import InvalidPolicy
from knotgym.control.policy import Choice, Effort, Policy
from knotgym.control.transition_graph import TransitionGraphConfig, shipped_transition_graph
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.learn.agent import Agent, AgentConfig
from knotgym.learn.checkpoint import PRETRAINED, load_policy
from knotgym.learn.colour_reading import BEADS, SIZE


class PicturePolicy(Policy):
    """Run an agent on the pictures of its episodes.

    Reads nothing of the episode batch but the horizon, when an episode begins, and the pictures.
    """

    def __init__(self, agent: Agent, name: str) -> None:
        self._agent, self._name = agent, name
        self._seconds: dict[int, float] = {}

    def suited(self, task: TaskConfig) -> TaskConfig:
        require_readable(task, self._name)
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


def require_readable(task: TaskConfig, policy: str, action: str = "pull") -> None:
    """Require pictures that the reader can read, and an action view; raise InvalidPolicy if not."""
    differing = [
        f"{name} {given} instead of {needed}"
        for name, given, needed in (
            ("beads", task.beads, BEADS),
            ("views", ",".join(task.views), "top"),
            ("depth", task.depth, False),
            ("camera", task.camera, "orthographic"),
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


def learned_policy(folder: str, config: AgentConfig | None = None) -> PicturePolicy:
    """Load the policy of a checkpoint folder, or "pretrained", which ships with the package.

    Raises:
        InvalidFile: there is no checkpoint that this version can read.
    """
    learned = load_policy(folder)
    graph = shipped_transition_graph(TransitionGraphConfig())
    agent = Agent(learned.reader, graph, learned.starts.astype(np.float64), config)
    return PicturePolicy(agent, PRETRAINED if folder == PRETRAINED else "learned")
