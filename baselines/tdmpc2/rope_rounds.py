"""Environments that reset all at once, as the official TD-MPC2 expects; its agent as a policy."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.control.policy import Choice, UnplannedPolicy, checked
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig


class Step(NamedTuple):
    """The outcome of one step of n environments.

    Attributes:
        pictures: uint8 (n, 3, size, 2 size), rope left and goal right.
        rewards: float32 (n,).
        terminated: bool (n,), whether the goal has been reached in this round.
        over: whether the round is over, for all environments.
    """

    pictures: NDArray[np.uint8]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    over: bool


class RopeRounds:
    """Parallel episodes that begin together and wait for each other.

    An environment whose episode has ended keeps its state, with reward 0, until the round is over:
    once all have ended, and after `least` steps, the length of a training sequence.

    Attributes:
        acted: actions taken, not counting environments that wait.
    """

    def __init__(
        self, config: TaskConfig, count: int, rng: np.random.Generator, least: int, threads: int = 0
    ) -> None:
        """Create `count` environments; all draws come from `rng`."""
        self._episodes = EpisodeBatch(config, count, threads)
        self._rng, self._least = rng, least
        self._pictures = np.zeros((0,), dtype=np.uint8)
        self._terminated = self._ended = np.zeros(count, dtype=bool)
        self._steps = self.acted = 0

    def reset(self) -> NDArray[np.uint8]:
        """Begin a round; return the pictures, as in `Step`."""
        everyone = range(self._episodes.count)
        for index in everyone:
            self._episodes.begin(index, self._rng)
        self._terminated = np.zeros(len(everyone), dtype=bool)
        self._ended = self._terminated.copy()
        self._steps = 0
        self._pictures = np.stack([channels_first(self._episodes.picture(i)) for i in everyone])
        return self._pictures.copy()

    def step(self, actions: NDArray[np.float32]) -> Step:
        """Step the environments whose episodes continue; actions are float32 (n, 6) in [-1, 1]."""
        going = np.flatnonzero(~self._ended)
        rewards = np.zeros(len(self._ended), dtype=np.float32)
        if len(going):
            rewards[going], won, cut = self._episodes.step(np.clip(actions[going], -1, 1), going)
            self._terminated[going] = won
            self._ended[going] = won | cut
            for index in going.tolist():
                self._pictures[index] = channels_first(self._episodes.picture(index))
        self.acted += len(going)
        self._steps += 1
        over = bool(self._ended.all()) and self._steps >= self._least
        return Step(self._pictures.copy(), rewards, self._terminated.copy(), over)


def channels_first(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Transpose uint8 (size, 2 size, 3) to (3, size, 2 size)."""
    return np.ascontiguousarray(picture.transpose(2, 0, 1))


class TdMpcPolicy(UnplannedPolicy):
    """The official agent as a policy: it replans at each step, without exploration noise.

    Planning is warm-started from the previous plan of the same episode.
    """

    def __init__(self, agent: Any, torch: Any) -> None:
        super().__init__("tdmpc2")
        self._agent, self._torch = agent, torch
        self._plans: dict[int, Any] = {}

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        super().begin(episodes, index, rng)
        self._plans[index] = self._torch.zeros_like(self._agent._prev_mean[0])

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        agent, numbers = self._agent, ids.tolist()
        seen = np.stack([channels_first(episodes.picture(index)) for index in numbers])
        agent.cfg.num_envs = len(numbers)
        agent._prev_mean = self._torch.stack([self._plans[index] for index in numbers])
        actions = agent.act(self._torch.from_numpy(seen), eval_mode=True).numpy()
        self._plans.update(zip(numbers, agent._prev_mean.clone(), strict=True))
        return checked(list(actions), episodes, ids, self._name)
