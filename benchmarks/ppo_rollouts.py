"""Steps a second of Stable-Baselines3's PPO on pictures: one batched simulation beside processes.

    python benchmarks/ppo_rollouts.py [--out ppo.json] [--envs 32] [--rollout 16] [--repeats 5]

`sb3_vec_env` beside `make_vec_env` with `SubprocVecEnv` (a process a rope), the same environment,
`CnnPolicy` with the paper's settings. The two take turns collecting rollouts, the policy's own
forward passes included, the median over the repeats counts. The gradient steps, alike for both, are
timed once, on some batches. Wall time on all cores. Needs stable-baselines3.
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
from knotgym.env import KnotEnv

BATCH, EPOCHS = 64, 10  # the paper's


def learners(envs: int, rollout: int, task: str, image_size: int) -> dict[str, Any]:
    """A PPO on each, by name, ready to collect."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import SubprocVecEnv, VecMonitor

    settings: dict[str, Any] = {"nx": 2, "observation": "pixels", "image_size": image_size}
    processes = make_vec_env(  # forked first, before this process has threads of its own
        KnotEnv, envs, seed=0, env_kwargs={"task": task, **settings}, vec_env_cls=SubprocVecEnv,
        vec_env_kwargs={"start_method": "fork"},
    )  # fmt: skip
    found = {}
    for name, raced in (
        ("sb3_vec_env", VecMonitor(sb3_vec_env(task, envs, **settings))),
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


def seconds(model: Any) -> float:
    """Wall time of collecting a rollout."""
    from stable_baselines3.common.callbacks import CallbackList

    nothing = CallbackList([])
    nothing.init_callback(model)
    began = time.perf_counter()
    model.collect_rollouts(model.env, nothing, model.rollout_buffer, model.n_steps)
    return time.perf_counter() - began


def measured(
    envs: int, rollout: int, repeats: int, task: str, image_size: int
) -> tuple[dict[str, float], float]:
    """Median steps a second of collecting; seconds of a gradient step."""
    raced = learners(envs, rollout, task, image_size)
    took: dict[str, list[float]] = {name: [] for name in raced}
    for model in raced.values():
        seconds(model)  # what is compiled and allocated once
    for _ in range(repeats):
        for name, model in raced.items():
            took[name].append(seconds(model))
    model = raced["sb3_vec_env"]
    began = time.perf_counter()
    model.train()
    step = (time.perf_counter() - began) / -(-envs * rollout // BATCH)
    for model in raced.values():
        model.env.close()
    rates = {name: envs * rollout / statistics.median(each) for name, each in took.items()}
    return rates, step


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path)
    parser.add_argument("--envs", type=int, default=32)
    parser.add_argument("--rollout", type=int, default=16, help="steps of each rope")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--task", default="unknot")
    parser.add_argument("--image-size", type=int, default=128)
    given = parser.parse_args()
    rates, step = measured(given.envs, given.rollout, given.repeats, given.task, given.image_size)
    table = Table("vector class", "collecting, steps a second", "times as slow", "with updates")
    whole = {name: 1 / (1 / rate + EPOCHS * step / BATCH) for name, rate in rates.items()}
    for name, rate in rates.items():
        ratio = rates["sb3_vec_env"] / rate
        table.add_row(name, f"{rate:.0f}", f"{ratio:.2f}", f"{whole[name]:.1f}")
    Console().print(table)
    if given.out:
        said = {
            "envs": given.envs,
            "cores": os.cpu_count(),
            "collecting_steps_a_second": rates,
            "gradient_step_seconds": step,
            "steps_a_second": whole,
        }
        given.out.write_text(json.dumps(said, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
