"""A Stable-Baselines3 VecEnv over one batched simulation; importing it needs that library."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from knotgym.adapters.goal_environment import GoalBatch
from knotgym.common import InvalidInput
from knotgym.envs import EpisodeBatch, KnotEnv, TaskConfig
from knotgym.rope import VIEWS

Indices = int | Iterable[int] | None


class BatchedVecEnv(VecEnv):
    """A VecEnv of ropes that are stepped together; see `sb3_vec_env`."""

    def __init__(
        self, task: str, num_envs: int, threads: int, goals: bool, settings: dict[str, Any]
    ) -> None:
        config = TaskConfig.of(task, {**({"failure_reward": 0.0} if goals else {}), **settings})
        self.render_mode = "rgb_array"
        self.num_envs = num_envs
        self.episodes = (GoalBatch if goals else EpisodeBatch)(config, num_envs, threads)
        self._rngs = [np.random.default_rng() for _ in range(num_envs)]
        self._actions: NDArray[Any] = np.empty(0)
        space, actions = self.episodes.space, VIEWS[config.action].space(config.beads)
        super().__init__(num_envs, space, actions)
        self.metadata = {**KnotEnv.metadata}  # how fast films are

    def reset(self) -> Any:
        """Restart every episode, with the seeds and options that were set."""
        for i, (seed, options) in enumerate(zip(self._seeds, self._options, strict=True)):
            if seed is not None:
                self._rngs[i] = np.random.default_rng(seed)
            self._begin(np.array([i]), options)
        self._reset_seeds()
        self._reset_options()
        return self.episodes.observations(np.arange(self.num_envs))

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Take the stored actions; episodes that end are restarted at once."""
        every = np.arange(self.num_envs)
        rewards, terminated, truncated = self.episodes.act(self._actions, every)
        dones, infos = terminated | truncated, self.episodes.info_rows(every)
        for i, info in enumerate(infos):
            info["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            if dones[i]:
                info["terminal_observation"] = self.episodes.observation(i)
        self._begin(np.flatnonzero(dones))
        return self.episodes.observations(every), rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Do nothing; there are no resources to release."""

    def get_images(self) -> Sequence[NDArray[np.uint8]]:
        """Return one picture per rope, uint8 (size, 2 size, 3)."""
        return [self.episodes.rgb(i) for i in range(self.num_envs)]

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute, which is the same for all ropes."""
        return [getattr(self, attr_name)] * len(self._which(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of all ropes; setting it for some of them is not supported."""
        if len(self._which(indices)) < self.num_envs:
            raise InvalidInput(f"{attr_name} is the same for all ropes: set it without indices")
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method once per index; `HerReplayBuffer` calls `compute_reward` this way."""
        method = getattr(self, method_name)
        return [method(*method_args, **method_kwargs) for _ in self._which(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Indices = None) -> list[bool]:
        """Return False for every rope; ropes are not wrapped individually."""
        return [False] * len(self._which(indices))

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """Compute rewards as `GoalBatch.reward`; `info` is not used."""
        if not isinstance(self.episodes, GoalBatch):
            raise InvalidInput("compute_reward needs goals: create the VecEnv with goals=True")
        return self.episodes.reward(achieved_goal, desired_goal)

    def _begin(self, ids: NDArray[np.int64], options: dict[str, Any] | None = None) -> None:
        self.episodes.begin(ids, [self._rngs[i] for i in ids], options)
        for index, info in zip(ids.tolist(), self.episodes.info_rows(ids), strict=True):
            self.reset_infos[index] = info

    def _which(self, indices: Indices) -> Sequence[int]:
        return list(self._get_indices(indices))
