"""Steps a second for Stable-Baselines3: one batched simulation beside its own vector classes.

    python benchmarks/adapters.py [--out adapters.json] [--envs 8] [--steps 40] [--repeats 5]

`sb3_vec_env` against `DummyVecEnv` (one rope after another) and `SubprocVecEnv` (a process a rope)
of the same environments with the same seeds; the three take turns, `--steps` vector steps each, and
the median over the repeats counts. Wall time on all cores. Needs stable-baselines3.
"""

import argparse
import json
import os
import statistics
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from knotgym.adapters import sb3_vec_env
from knotgym.envs.environment import KnotEnv


def vec_envs(count: int, settings: dict[str, Any]) -> dict[str, Any]:
    """The three, by name."""
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    single = partial(KnotEnv, "tie", **settings)
    return {
        "sb3_vec_env": sb3_vec_env("tie", count, **settings),
        "DummyVecEnv": DummyVecEnv([single] * count),
        "SubprocVecEnv": SubprocVecEnv([single] * count),
    }


def seconds(envs: Any, actions: Any) -> float:
    """Wall time of vector steps with these actions."""
    began = time.perf_counter()
    for each in actions:
        envs.step(each)
    return time.perf_counter() - began


def measured(count: int, steps: int, repeats: int, observation: str) -> dict[str, float]:
    """Median steps a second, all ropes together."""
    settings = {"nx": 2, "observation": observation}
    raced, rng = vec_envs(count, settings), np.random.default_rng(0)
    took: dict[str, list[float]] = {name: [] for name in raced}
    for envs in raced.values():
        envs.seed(0)
        envs.reset()
    for _ in range(repeats):
        actions = rng.uniform(-1, 1, (steps, count, 6)).astype(np.float32)
        for name, envs in raced.items():
            took[name].append(seconds(envs, actions))
    for envs in raced.values():
        envs.close()
    return {name: count * steps / statistics.median(each) for name, each in took.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path)
    parser.add_argument("--envs", type=int, default=8)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    table = Table("observation", "vector class", "steps a second", "times as slow")
    rates: dict[str, dict[str, float]] = {}
    for observation in ("state", "pixels"):
        rates[observation] = measured(options.envs, options.steps, options.repeats, observation)
        ours = rates[observation]["sb3_vec_env"]
        for name, rate in rates[observation].items():
            table.add_row(observation, name, f"{rate:.0f}", f"{ours / rate:.2f}")
    Console().print(table)
    if options.out:
        said = {"envs": options.envs, "cores": os.cpu_count(), "steps_a_second": rates}
        options.out.write_text(json.dumps(said, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
