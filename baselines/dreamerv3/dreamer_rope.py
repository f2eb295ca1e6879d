"""Adapt the environment to the official DreamerV3, and its agent to our policies."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.control.policy import Choice, UnplannedPolicy, checked
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig

BATCH = 8  # episodes that `knotgym evaluate` plays at once; a fixed size is compiled only once


class DreamerRope:
    """An environment with the interface of `embodied`.

    Observations and actions are dicts. An action with `reset` set, or the first one after an
    episode has ended, begins a new episode instead of acting. The picture is that of our
    environment, uint8 (size, 2 size, 3), rope left and goal right. `is_last` marks the end of any
    episode, `is_terminal` only success.
    """

    def __init__(self, config: TaskConfig, rng: np.random.Generator, space: Any) -> None:
        """Create an environment; all draws come from `rng`, and `space` is `elements.Space`."""
        self._episodes = EpisodeBatch(config)
        self._rng, self._space = rng, space
        self._ended = True

    @property
    def obs_space(self) -> dict[str, Any]:
        size = self._episodes.config.image_size
        flags = {name: self._space(bool) for name in ("is_first", "is_last", "is_terminal")}
        return {
            "image": self._space(np.uint8, (size, 2 * size, 3)),
            "reward": self._space(np.float32),
            **flags,
            "log/success": self._space(np.float32),
        }

    @property
    def act_space(self) -> dict[str, Any]:
        return {
            "action": self._space(np.float32, (6,), -1.0, 1.0),
            "reset": self._space(bool),
        }

    def step(self, action: dict[str, Any]) -> dict[str, Any]:
        """Act or begin an episode; return the observation."""
        begins = bool(action["reset"]) or self._ended
        reward, won, cut = 0.0, False, False
        if begins:
            self._episodes.begin(0, self._rng)
        else:
            row = np.asarray(action["action"], dtype=np.float32)[None]
            outcome = self._episodes.step(np.clip(row, -1, 1), np.array([0]))
            reward = float(outcome.rewards[0])
            won, cut = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        self._ended = won or cut
        return {
            "image": self._episodes.picture(0),
            "reward": np.float32(reward),
            "is_first": begins,
            "is_last": self._ended,
            "is_terminal": won,
            "log/success": np.float32(won),
        }

    def close(self) -> None:
        """Do nothing: no resource is open."""


class DreamerPolicy(UnplannedPolicy):
    """The official agent as a policy; it samples its actions, as in its own evaluation."""

    def __init__(self, agent: Any) -> None:
        super().__init__("dreamerv3")
        self._agent = agent
        self._first = np.ones(BATCH, dtype=bool)
        self._carry = agent.init_policy(BATCH)

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        super().begin(episodes, index, rng)
        self._first[index] = True

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        pictures = [episodes.picture(index) for index in ids.tolist()]
        seen = np.zeros((BATCH, *pictures[0].shape), dtype=np.uint8)
        seen[ids] = pictures
        never = np.zeros(BATCH, dtype=bool)
        observed = {
            "image": seen,
            "reward": np.zeros(BATCH, dtype=np.float32),
            "is_first": self._first.copy(),
            "is_last": never,
            "is_terminal": never,
        }
        self._carry, chosen, _ = self._agent.policy(self._carry, observed, mode="eval")
        self._first[:] = False
        actions = np.clip(np.asarray(chosen["action"])[ids], -1, 1)
        return checked(list(actions), episodes, ids, self._name)
