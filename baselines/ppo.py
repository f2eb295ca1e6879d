"""Stable-Baselines3's PPO with the settings of the paper, on pictures or on states.

    python baselines/ppo.py --task unknot --nx 2 --observation pixels --out ppo-unknot-nx2
    python baselines/ppo.py --task unknot --nx 2 --observation pixels --out ppo-unknot-nx2 --resume
    knotgym evaluate --policy ppo-unknot-nx2/model.zip --task unknot --nx 2 --observation pixels

Needs stable-baselines3, and tensorboard for its log. Learns on the train split, `CnnPolicy` or
`MlpPolicy` unmodified, in `knotgym.adapters.sb3_vec_env`. Writes into --out:

    model.zip         the learner, for `knotgym evaluate`
    evaluation.json   how it did, greedily, for `benchmarks/results.py`
    curve.json, .png  how its training went
    checkpoints/      the learner every --every steps, between two rollouts
    tensorboard/      the log of Stable-Baselines3
    ppo.json          what was asked for, which --resume compares

A zip of Stable-Baselines3 holds pickles: reading one may run its code, so --resume only folders and
evaluate only models that you trust.

A run that was killed loses what came after its last checkpoint. --resume makes as many steps as an
unbroken run, but isn't the same to the bit: weights, optimizer and count of steps are kept, the
episodes under way and the states of the random generators are not. Ropes begin anew, with seeds
drawn from --seed and the steps made.
"""

from __future__ import annotations

import argparse
import importlib.util
import platform
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from baseline_script import InvalidBaseline, parser, require_folder, run, trials, write_json
from rich.console import Console

import knotgym
from knotgym.adapters import sb3_vec_env
from knotgym.atomic_files import atomic_write
from knotgym.configuration import as_json, check_numbers
from knotgym.control.learned_policies import ModelPolicy
from knotgym.errors import MissingExtra, one_line
from knotgym.generate.episodes.learner_evaluation import evaluate_learner
from knotgym.tasks import TaskConfig

REQUEST, MODEL = "ppo.json", "model.zip"
POLICIES = {"pixels": "CnnPolicy", "state": "MlpPolicy"}


@dataclass(frozen=True, kw_only=True)
class PpoConfig:
    """The paper's settings; where it names none, Stable-Baselines3's defaults (`rollout`).

    Attributes:
        learning_rate: of Adam, constant.
        features: that the convolutions of `CnnPolicy` end in; `MlpPolicy` has none.
        envs: ropes side by side.
        rollout: steps of each rope between two updates.
        batch: of the gradient steps; divides envs times rollout.
        epochs: passes over a rollout.
        gamma, gae_lambda, clip: as in PPO.
        seed: of everything.
    """

    learning_rate: float = 1e-5
    features: int = 768
    envs: int = 32
    rollout: int = 2048
    batch: int = 64
    epochs: int = 10
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    seed: int = 0

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("features", "envs", "rollout", "batch", "epochs"),
            whole=("seed",),
            positive=("learning_rate", "clip"),
            shares=("gamma", "gae_lambda"),
            error=InvalidBaseline,
        )
        steps = self.envs * self.rollout
        if self.batch < 2 or steps % self.batch:
            raise InvalidBaseline(
                f"batch must be at least 2 and divide the {steps} steps of a rollout (envs times"
                f" rollout), got {self.batch}"
            )


def options() -> argparse.ArgumentParser:
    """What can be asked for."""
    usual = PpoConfig()
    found = parser(__doc__ or "", "to the end of the rollout")
    found.add_argument("--observation", default="pixels", choices=tuple(POLICIES))
    found.add_argument("--every", type=int, default=250_000, help="steps between checkpoints")
    found.add_argument("--device", default="auto", help="cpu, cuda ...")
    found.add_argument("--threads", type=int, default=0, help="of the simulation; 0: every core")
    for name in ("learning_rate", "envs", "rollout", "batch", "epochs", "seed"):
        value = getattr(usual, name)
        word = f"--{name.replace('_', '-')}"
        found.add_argument(word, type=type(value), default=value, help=f"{value}")
    return found


def train(given: argparse.Namespace) -> None:
    """Refuse what can't be had, then train, write the model and try it."""
    chosen = {name: getattr(given, name) for name in vars(PpoConfig()) if hasattr(given, name)}
    config = PpoConfig(**chosen)
    task = TaskConfig(
        task=given.task,
        nx=given.nx,
        states=given.states,
        observation=given.observation,
        image_size=given.image_size,
    )
    tried_at = trials(given, task)
    check_numbers(given, counts=("steps", "every"), whole=("threads",), error=InvalidBaseline)
    _require_device(given.device)
    request = {"ppo": as_json(config), "task": as_json(task)}
    require_folder(given.out, REQUEST, request, given.resume)
    found = _newest(given.out) if given.resume else None
    envs = _envs(task, config, given.threads)
    model, course = _learner(given, config, envs, found)
    write_json(given.out / REQUEST, request)
    if model.num_timesteps < given.steps:
        left = given.steps - model.num_timesteps
        model.learn(left, course, reset_num_timesteps=False, tb_log_name="ppo")
        course.save()
    _copy_last(given.out)
    if tried_at is not None:
        evaluate_learner(
            f"sb3-ppo-{task.observation}",
            ModelPolicy(lambda seen: model.predict(seen, deterministic=True)[0], "ppo"),
            given.out,
            _told(model, course, config),
            files=[given.out / MODEL],
            quiet=given.quiet,
            **tried_at,
        )


def _require_device(device: str) -> None:
    for library in ("torch", "stable_baselines3"):
        if importlib.util.find_spec(library) is None:
            raise MissingExtra(library, "pip install stable-baselines3")
    import torch
    from stable_baselines3.common.utils import get_device

    try:
        torch.zeros(1, device=get_device(device))
    except (RuntimeError, AssertionError) as error:  # torch's own, of CUDA the latter
        raise InvalidBaseline(f"no device {device!r}: {one_line(error)[:200]}") from error


def _envs(task: TaskConfig, config: PpoConfig, threads: int) -> Any:
    from stable_baselines3.common.vec_env import VecMonitor

    settings = {name: getattr(task, name) for name in ("nx", "states", "observation", "image_size")}
    return VecMonitor(sb3_vec_env(task.task, config.envs, threads=threads, **settings))


def _learner(
    given: argparse.Namespace, config: PpoConfig, envs: Any, found: Path | None
) -> tuple[Any, Any]:
    """The learner, new or as it was saved, and the course of its training so far."""
    from stable_baselines3 import PPO
    from training_course import Course, read_rows

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
        return model, Course(given.out, given.every, [], [], console)
    try:
        model = PPO.load(found, envs, device=given.device)
        steps = model.num_timesteps
        rows, before = read_rows(given.out, steps)
    except Exception as error:  # pickle, zipfile, torch: each has its own for a broken file
        raise InvalidBaseline(f"{found} can't be gone on from: {one_line(error)[:200]}") from error
    if steps < given.steps:
        before = [*(one for one in before if one < steps), steps]
    model.tensorboard_log = log
    anew = np.random.SeedSequence([config.seed, steps]).generate_state(1, np.uint32)[0]
    model.set_random_seed(int(anew) // 2)  # seeds of ropes count on from it
    return model, Course(given.out, given.every, rows, before, console)


def _newest(out: Path) -> Path | None:
    from training_course import checkpoints

    return checkpoints(out)[-1] if checkpoints(out) else None


def _copy_last(out: Path) -> None:
    from training_course import checkpoints

    with atomic_write(out / MODEL) as part:
        shutil.copyfile(checkpoints(out)[-1], part)


def _told(model: Any, course: Any, config: PpoConfig) -> dict[str, Any]:
    """How it was trained, beside its scores."""
    import stable_baselines3
    import torch

    last = course.rows[-1]
    return {
        "library": f"stable-baselines3 {stable_baselines3.__version__}, torch {torch.__version__}",
        "knotgym": knotgym.__version__,
        "policy": type(model.policy).__name__,
        "parameters": sum(one.numel() for one in model.policy.parameters()),
        "steps": model.num_timesteps,
        "resumed_at": course.resumed_at,
        "settings": as_json(config),
        "seed": config.seed,
        "seconds": last.seconds,
        "cpu_seconds": last.cpu_seconds,
        "machine": f"{platform.system()} {platform.machine()}, {model.device}",
    }


if __name__ == "__main__":
    run(train, options())
