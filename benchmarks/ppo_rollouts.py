"""Steps a second of Stable-Baselines3's PPO on pictures: one batched simulation beside processes.

    python benchmarks/ppo_rollouts.py [--out ppo.json] [--envs 32] [--rollout 16] [--repeats 5]

`sb3_vec_env` beside `make_vec_env` with `SubprocVecEnv` (a process a rope), the same environment,
`CnnPolicy` with the paper's settings. The two take turns collecting rollouts, the policy's own
forward passes included, the median over the repeats counts: by the clock on all cores, and by the
CPU seconds of all processes, which others on the machine disturb less (Linux). The gradient steps,
alike for both, are timed once, on some batches. Needs stable-baselines3.
"""

import argparse
import json
import os
import statistics
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from knotgym.adapters import sb3_vec_env
from knotgym.envs.environment import KnotEnv

BATCH, EPOCHS = 64, 10  # the paper's


def learners(envs: int, rollout: int, image_size: int, start: str) -> dict[str, Any]:
    """A PPO on each, by name, ready to collect."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import SubprocVecEnv, VecMonitor

    settings: dict[str, Any] = {"nx": 2, "observation": "pixels", "image_size": image_size}
    processes = make_vec_env(  # first, for a fork may not have threads of its own
        KnotEnv, envs, seed=0, env_kwargs={"task": "unknot", **settings}, vec_env_cls=SubprocVecEnv,
        vec_env_kwargs={"start_method": start},
    )  # fmt: skip
    found = {}
    for name, raced in (
        ("sb3_vec_env", VecMonitor(sb3_vec_env("unknot", envs, **settings))),
        ("SubprocVecEnv", processes),
    ):
        model = PPO(
            "CnnPolicy",
            raced,
            learning_rate=1e-5,
            n_steps=rollout,
            batch_size=BATCH,
            n_epochs=1,
            policy_kwargs={"features_extractor_kwargs": {"features_dim": 768}},
            device="cpu",
            seed=0,
        )
        model._setup_learn(1)
        found[name] = model
    return found


def seconds(model: Any) -> tuple[float, float]:
    """Wall time and CPU time of collecting a rollout."""
    from stable_baselines3.common.callbacks import CallbackList

    nothing = CallbackList([])
    nothing.init_callback(model)
    began, spent = time.perf_counter(), cpu_seconds(model)
    model.collect_rollouts(model.env, nothing, model.rollout_buffer, model.n_steps)
    return time.perf_counter() - began, cpu_seconds(model) - spent


def cpu_seconds(model: Any) -> float:
    """Spent so far by this process and by those that the learner's ropes live in."""
    ticks = 0
    for process in getattr(model.env.unwrapped, "processes", ()):
        told = Path(f"/proc/{process.pid}/stat").read_text(encoding="utf-8").rpartition(")")[2]
        ticks += sum(map(int, told.split()[11:13]))  # user and system
    return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")


def measured(
    envs: int, rollout: int, repeats: int, image_size: int, start: str
) -> dict[str, dict[str, float]]:
    """Medians, by the clock and by CPU seconds: steps a second of collecting for each vector
    class, and seconds of a gradient step.
    """
    raced = learners(envs, rollout, image_size, start)
    took: dict[str, list[tuple[float, float]]] = {name: [] for name in raced}
    for model in raced.values():
        seconds(model)  # what is compiled and allocated once
    for _ in range(repeats):
        for name, model in raced.items():
            took[name].append(seconds(model))
    model = raced["sb3_vec_env"]
    began, spent = time.perf_counter(), time.process_time()
    model.train()
    steps = -(-envs * rollout // BATCH)
    train = ((time.perf_counter() - began) / steps, (time.process_time() - spent) / steps)
    for model in raced.values():
        model.env.close()
    return {
        clock: {
            **{
                name: envs * rollout / statistics.median(one[k] for one in each)
                for name, each in took.items()
            },
            "gradient step": train[k],
        }
        for k, clock in enumerate(("clock", "CPU"))
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path)
    parser.add_argument("--envs", type=int, default=32)
    parser.add_argument("--rollout", type=int, default=16, help="steps of each rope")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--image-size", type=int, default=128)
    parser.add_argument("--start", default="fork", help="of the processes: fork, forkserver, spawn")
    given = parser.parse_args()
    found = measured(given.envs, given.rollout, given.repeats, given.image_size, given.start)
    table = Table("by", "vector class", "collecting, steps/s", "times as slow", "with updates")
    for clock, rates in found.items():
        for name in ("sb3_vec_env", "SubprocVecEnv"):
            ratio = rates["sb3_vec_env"] / rates[name]
            whole = 1 / (1 / rates[name] + EPOCHS * rates["gradient step"] / BATCH)
            table.add_row(clock, name, f"{rates[name]:.1f}", f"{ratio:.2f}", f"{whole:.2f}")
    Console().print(table)
    if given.out:
        said = {"envs": given.envs, "cores": os.cpu_count(), **found}
        given.out.write_text(json.dumps(said, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
