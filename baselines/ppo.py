"""Train PPO of Stable-Baselines3 with the settings of the paper, on pictures or on states.

    python baselines/ppo.py --task unknot --nx 2 --observation pixels --out ppo-unknot-nx2
    python baselines/ppo.py --task unknot --nx 2 --observation pixels --out ppo-unknot-nx2 --resume
    cd ppo-unknot-nx2; knotgym evaluate --policy model:act --task unknot --nx 2 --observation pixels

Needs stable-baselines3, and tensorboard for its log. Trains the unmodified `CnnPolicy` or
`MlpPolicy` on the train split, in `knotgym.adapters.sb3_vec_env`. Writes to --out:

    model.zip, .py    the trained model, and its policy for `knotgym evaluate`
    evaluation.json   results of its deterministic policy, for `benchmarks/results.py`
    curve.json, .png  learning curve
    checkpoints/      models saved every --every steps, between rollouts
    tensorboard/      log of Stable-Baselines3
    ppo.json          settings, which --resume compares

Stable-Baselines3's zip files hold pickles, and loading one may run code from it: --resume only
folders and evaluate only models that you trust.

A killed run loses the steps after its last checkpoint. A resumed training makes as many steps as an
uninterrupted one but isn't the same to the bit: weights, optimizer and step count are restored; the
current episodes and random states are not. Episodes start afresh, with seeds drawn from --seed and
the number of steps so far.
"""

from __future__ import annotations

import argparse
import importlib.util
import platform
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from baseline_script import evaluation_settings, parser, require_folder, run, write_json
from rich.console import Console

import knotgym
from knotgym.adapters import sb3_vec_env
from knotgym.common.atomic_files import atomic_write
from knotgym.common.configuration import Count, Positive, Seed, Share, as_json, configuration
from knotgym.common.errors import InvalidInput, MissingExtra, one_line
from knotgym.control.basic_policies import NetworkPolicy
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.learner_evaluation import evaluate_learner
from knotgym.rope.engines import ENGINES, MUJOCO

REQUEST, MODEL = "ppo.json", "model.zip"
MODULE = '''"""The policy of model.zip: knotgym evaluate --policy model:act, in this folder."""

import torch
from stable_baselines3 import PPO

FILES = [__file__[:-3] + ".zip"]
torch.set_num_threads(1)
model = PPO.load(FILES[0], device="cpu")


def act(observation):
    return model.predict(observation, deterministic=True)[0]
'''
POLICIES = {"pixels": "CnnPolicy", "state": "MlpPolicy"}


@configuration
class PpoConfig:
    """The paper's settings; where it gives none (`rollout`), Stable-Baselines3's default.

    Attributes:
        learning_rate: constant learning rate of Adam.
        features: width of the convolutional features of `CnnPolicy`; unused by `MlpPolicy`.
        envs: parallel environments.
        rollout: steps per environment between updates.
        batch: minibatch size; must divide envs times rollout.
        epochs: passes over each rollout.
        gamma, gae_lambda, clip: parameters of PPO.
        seed: seed of all random draws.
    """

    learning_rate: Positive = 1e-5
    features: Count = 768
    envs: Count = 32
    rollout: Count = 2048
    batch: Count = 64
    epochs: Count = 10
    gamma: Share = 0.99
    gae_lambda: Share = 0.95
    clip: Positive = 0.2
    seed: Seed = 0

    def __post_init__(self) -> None:
        steps = self.envs * self.rollout
        if self.batch < 2 or steps % self.batch:
            raise InvalidInput(
                f"batch must be at least 2 and divide the {steps} steps of a rollout (envs times"
                f" rollout), got {self.batch}"
            )


def options() -> argparse.ArgumentParser:
    """Return the command-line options."""
    usual = PpoConfig()
    found = parser(__doc__ or "", "environment steps, rounded up to whole rollouts")
    found.add_argument("--observation", default="pixels", choices=tuple(POLICIES))
    found.add_argument("--engine", default=MUJOCO, choices=ENGINES)
    found.add_argument("--tow-limit", type=float, help="see the environment's tow_limit")
    found.add_argument("--every", type=int, default=250_000, help="steps between checkpoints")
    found.add_argument("--device", default="auto", help="cpu, cuda, ...")
    found.add_argument(
        "--threads", type=int, default=0, help="threads of the simulation; 0 for all cores"
    )
    for name in ("learning_rate", "envs", "rollout", "batch", "epochs", "seed"):
        value = getattr(usual, name)
        word = f"--{name.replace('_', '-')}"
        found.add_argument(word, type=type(value), default=value, help=f"default {value}")
    return found


def train(given: argparse.Namespace) -> None:
    """Check the options, then train, save the model and evaluate it."""
    chosen = {name: getattr(given, name) for name in vars(PpoConfig()) if hasattr(given, name)}
    config = PpoConfig(**chosen)
    task = TaskConfig(
        task=given.task,
        nx=given.nx,
        states=given.states,
        observation=given.observation,
        image_size=given.image_size,
        engine=given.engine,
        tow_limit=given.tow_limit,
    )
    evaluation = evaluation_settings(given, task)
    for name, least in {"steps": 1, "every": 1, "threads": 0}.items():
        if getattr(given, name) < least:
            raise InvalidInput(f"{name} must be at least {least}, got {getattr(given, name)}")
    _require_device(given.device)
    request = {"ppo": as_json(config), "task": as_json(task)}
    require_folder(given.out, REQUEST, request, given.resume)
    found = _newest(given.out) if given.resume else None
    envs = _envs(task, config, given.threads)
    model, training_log = _learner(given, config, envs, found)
    write_json(given.out / REQUEST, request)
    if model.num_timesteps < given.steps:
        left = given.steps - model.num_timesteps
        model.learn(left, training_log, reset_num_timesteps=False, tb_log_name="ppo")
        training_log.save()
    _copy_last(given.out)
    if evaluation is not None:
        evaluate_learner(
            f"sb3-ppo-{task.observation}",
            NetworkPolicy(lambda seen: model.predict(seen, deterministic=True)[0], "ppo"),
            given.out,
            _report(model, training_log, config),
            files=[given.out / MODEL],
            quiet=given.quiet,
            **evaluation,
        )


def _require_device(device: str) -> None:
    for library in ("torch", "stable_baselines3"):
        if importlib.util.find_spec(library) is None:
            raise MissingExtra(library, "pip install stable-baselines3")
    import torch
    from stable_baselines3.common.utils import get_device

    try:
        torch.zeros(1, device=get_device(device))
    except (RuntimeError, AssertionError) as error:  # torch raises the latter for CUDA
        raise InvalidInput(
            f"device {device!r} is not available: {one_line(error)[:200]}"
        ) from error


def _envs(task: TaskConfig, config: PpoConfig, threads: int) -> Any:
    from stable_baselines3.common.vec_env import VecMonitor

    names = ("nx", "states", "observation", "image_size", "engine", "tow_limit")
    settings = {name: getattr(task, name) for name in names}
    return VecMonitor(sb3_vec_env(task.task, config.envs, threads=threads, **settings))


def _learner(
    given: argparse.Namespace, config: PpoConfig, envs: Any, found: Path | None
) -> tuple[Any, Any]:
    """Return the model, new or from checkpoint `found`, and the callback with its history."""
    from stable_baselines3 import PPO
    from training_log import TrainingLog, read_rows

    extra = {"features_extractor_kwargs": {"features_dim": config.features}}
    log = str(given.out / "tensorboard") if importlib.util.find_spec("tensorboard") else None
    console = Console(stderr=True, quiet=given.quiet)
    if found is None:
        model = PPO(
            POLICIES[given.observation],
            envs,
            learning_rate=config.learning_rate,
            n_steps=config.rollout,
            batch_size=config.batch,
            n_epochs=config.epochs,
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
            clip_range=config.clip,
            policy_kwargs=extra if given.observation == "pixels" else None,
            tensorboard_log=log,
            device=given.device,
            seed=config.seed,
        )
        return model, TrainingLog(given.out, given.every, [], [], console)
    try:
        model = PPO.load(found, envs, device=given.device)
        steps = model.num_timesteps
        rows, before = read_rows(given.out, steps)
    except (
        Exception
    ) as error:  # pickle, zipfile and torch each raise their own for a corrupted file
        raise InvalidInput(f"can't resume from {found}: {one_line(error)[:200]}") from error
    if steps < given.steps:
        before = [*(one for one in before if one < steps), steps]
    model.tensorboard_log = log
    fresh = np.random.SeedSequence([config.seed, steps]).generate_state(1, np.uint32)[0]
    model.set_random_seed(int(fresh) // 2)  # episodes take this and the following seeds
    return model, TrainingLog(given.out, given.every, rows, before, console)


def _newest(out: Path) -> Path | None:
    from training_log import checkpoints

    return checkpoints(out)[-1] if checkpoints(out) else None


def _copy_last(out: Path) -> None:
    from training_log import checkpoints

    with atomic_write(out / MODEL) as part:
        shutil.copyfile(checkpoints(out)[-1], part)
    (out / MODEL).with_suffix(".py").write_text(MODULE, encoding="utf-8")


def _report(model: Any, training_log: Any, config: PpoConfig) -> dict[str, Any]:
    """Describe the training, for the evaluation file."""
    import stable_baselines3
    import torch

    last = training_log.rows[-1]
    return {
        "library": f"stable-baselines3 {stable_baselines3.__version__}, torch {torch.__version__}",
        "knotgym": knotgym.__version__,
        "policy": type(model.policy).__name__,
        "parameters": sum(one.numel() for one in model.policy.parameters()),
        "steps": model.num_timesteps,
        "resumed_at": training_log.resumed_at,
        "settings": as_json(config),
        "seed": config.seed,
        "seconds": last.seconds,
        "cpu_seconds": last.cpu_seconds,
        "machine": f"{platform.system()} {platform.machine()}, {model.device}",
    }


if __name__ == "__main__":
    run(train, options())
