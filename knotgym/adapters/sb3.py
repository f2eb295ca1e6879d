"""Adapter to Stable-Baselines3."""

from typing import Any

from knotgym.common import MissingExtra


def sb3_vec_env(
    task: str, num_envs: int = 8, *, threads: int = 0, goals: bool = False, **settings: Any
) -> Any:
    """Make a `stable_baselines3.common.vec_env.VecEnv` of ropes that are stepped together.

    Rope i of a VecEnv seeded with s behaves as `KnotEnv` seeded with s + i. As in
    Stable-Baselines3's own classes, an episode that ends is restarted at once: its last observation
    is `infos[i]["terminal_observation"]`, and `infos[i]["TimeLimit.truncated"]` says whether it was
    truncated. It is wrapped in `VecMonitor`, so learners report returns and lengths of episodes.

    Args:
        task: "unknot", "tie" or "convert".
        num_envs: number of ropes.
        threads: that share stepping, codes and pictures; 0 for every core. They change no byte.
        goals: whether observations are those of `goal_env`, for `HerReplayBuffer`.
        settings: keywords of `KnotEnv`.

    Raises:
        MissingExtra: Stable-Baselines3 isn't installed.
        InvalidInput: a setting is invalid.
    """
    envs = MissingExtra.imported(
        "stable_baselines3.common.vec_env", "pip install stable-baselines3"
    )
    from knotgym.adapters.batched_vec_env import BatchedVecEnv

    return envs.VecMonitor(BatchedVecEnv(task, num_envs, threads, goals, settings))
