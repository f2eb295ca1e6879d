"""Train PPO of Stable-Baselines3 with the settings of the paper, on pictures or on states.

    python baselines/ppo.py --task unknot --nx 2 --observation pixels --out ppo-unknot-nx2
    KNOTGYM_PPO=ppo-unknot-nx2 PYTHONPATH=baselines knotgym evaluate --policy ppo:act \\
        --task unknot --nx 2 --set task.observation=pixels --out evaluation.json

Needs stable-baselines3. Trains the unmodified `CnnPolicy` or `MlpPolicy` on the train split, in
`knotgym.adapters.sb3_vec_env`, and writes to --out:

    policy.pt    weights of the policy, without pickled objects
    ppo.json     settings, curve (success rate of the training episodes of each rollout) and times

`act` is a policy for `knotgym evaluate`: the deterministic action of the folder in KNOTGYM_PPO.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import knotgym

POLICIES = {"pixels": "CnnPolicy", "state": "MlpPolicy"}
WEIGHTS, SETTINGS = "policy.pt", "ppo.json"
# the paper's settings, as Stable-Baselines3 names them
PAPER = {
    **{"learning_rate": 1e-5, "batch_size": 64, "n_epochs": 10},
    **{"gamma": 0.99, "gae_lambda": 0.95, "clip_range": 0.2},
}
FEATURES = {"features_dim": 768}  # of CnnPolicy


def parser() -> argparse.ArgumentParser:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--task", default="unknot", choices=("unknot", "tie", "convert"))
    options.add_argument("--nx", type=int, default=2)
    options.add_argument("--states", help="readable (default), random-walk or a state file")
    options.add_argument("--observation", default="pixels", choices=tuple(POLICIES))
    options.add_argument("--image-size", type=int, default=128)
    options.add_argument("--engine", default="mujoco", choices=("mujoco", "chain"))
    options.add_argument("--tow-limit", type=float)
    options.add_argument("--endless", action="store_true", help="don't end episodes at the goal")
    options.add_argument("--steps", type=int, default=1_000_000, help="whole rollouts are made")
    # the paper gives no length of a rollout; 2,048 is the library's default
    options.add_argument("--envs", type=int, default=32)
    options.add_argument("--rollout", type=int, default=2048, help="steps of each environment")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--device", default="auto")
    options.add_argument("--out", type=Path, required=True, help="folder to create")
    return options


def model_of(settings: dict[str, Any], envs: int) -> Any:
    """Make an untrained model in its environments, from the settings that `ppo.json` holds."""
    from stable_baselines3 import PPO

    from knotgym.adapters import sb3_vec_env

    task = {name: settings[name] for name in ("task", "nx", "states", "engine", "endless")}
    task |= {"observation": settings["observation"], "image_size": settings["image_size"]}
    venv = sb3_vec_env(**task, tow_limit=settings["tow_limit"], num_envs=envs)
    pictures = settings["observation"] == "pixels"
    return PPO(
        POLICIES[settings["observation"]],
        venv,
        n_steps=settings["rollout"],
        policy_kwargs={"features_extractor_kwargs": FEATURES} if pictures else None,
        seed=settings["seed"],
        device=settings["device"],
        **PAPER,
    )


def train(given: argparse.Namespace) -> None:
    """Train, and write the weights and the report."""
    import torch
    from stable_baselines3.common.callbacks import BaseCallback

    settings = {**PAPER, **{name: one for name, one in vars(given).items() if name != "out"}}
    model, curve = model_of(settings, given.envs), list[dict[str, Any]]()
    began = time.perf_counter()

    class Curve(BaseCallback):
        """Counts the training episodes that succeed in each rollout."""

        def __init__(self) -> None:
            super().__init__()
            self.ended = self.succeeded = 0

        def _on_step(self) -> bool:
            for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
                self.ended += bool(done)
                self.succeeded += bool(done and info["is_success"])
            return True

        def _on_rollout_end(self) -> None:
            row = {"steps": self.num_timesteps, "episodes": self.ended}
            row |= {"successes": self.succeeded, "seconds": time.perf_counter() - began}
            curve.append(row)
            print(", ".join(f"{name} {value:.0f}" for name, value in row.items()), flush=True)
            self.ended = self.succeeded = 0

    model.learn(given.steps, callback=Curve())
    given.out.mkdir(parents=True, exist_ok=True)
    torch.save(model.policy.state_dict(), given.out / WEIGHTS)
    report = {"settings": settings, "knotgym": knotgym.__version__, "curve": curve}
    (given.out / SETTINGS).write_text(json.dumps(report, indent=1), encoding="utf-8")


@cache
def _trained() -> Any:
    import torch

    folder = Path(os.environ["KNOTGYM_PPO"])
    settings = json.loads((folder / SETTINGS).read_text(encoding="utf-8"))["settings"]
    model = model_of({**settings, "device": "cpu"}, 1)
    model.policy.load_state_dict(torch.load(folder / WEIGHTS, weights_only=True))
    return model


def act(observation: NDArray[Any]) -> NDArray[np.float32]:
    """Return the most likely action of the trained policy."""
    pull: NDArray[np.float32] = _trained().predict(observation, deterministic=True)[0]
    return pull


if __name__ == "__main__":
    train(parser().parse_args())
