"""Stable-Baselines3's trainers over one batched simulation."""

from __future__ import annotations

from typing import Any

from knotgym.common.errors import MissingExtra


def sb3_vec_env(
    task: str, num_envs: int = 8, *, threads: int = 0, goals: bool = False, **settings: Any
) -> Any:
    """Make a `stable_baselines3.common.vec_env.VecEnv` of ropes that are stepped together.

    Rope i of a VecEnv seeded with s does what `KnotEnv` seeded with s + i does. An episode that
    ends starts over at once, as in Stable-Baselines3's own classes: its last observation is in
    `infos[i]["terminal_observation"]`, `infos[i]["TimeLimit.truncated"]` says whether it was cut
    off. Wrap it in `VecMonitor` for returns and lengths.

    Args:
        task: "unknot", "tie" or "convert".
        num_envs: ropes.
        threads: of the simulation, 0 for every core.
        goals: observations as `goal_env`'s, for `HerReplayBuffer`.
        settings: as `KnotEnv`.

    Raises:
        MissingExtra: Stable-Baselines3 isn't installed.
        InvalidSetting: a setting that can't be had.
    """
    try:
        from knotgym.adapters.batched_vec_env import BatchedVecEnv
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name), "pip install stable-baselines3") from error
    return BatchedVecEnv(task, num_envs, threads, goals, settings)
