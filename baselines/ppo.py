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
import json
import platform
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from rich.console import Console

import knotgym
from knotgym.adapters import sb3_vec_env
from knotgym.atomic_files import atomic_write, require_writable
from knotgym.cli.options import words
from knotgym.configuration import as_json, check_numbers, differences
from knotgym.control.learned_policies import ModelPolicy
from knotgym.control.policies import PolicyConfig
from knotgym.episode_batch import state_origins
from knotgym.errors import KnotgymError, MissingExtra, one_line
from knotgym.generate.episodes.evaluate import EvaluateConfig
from knotgym.generate.episodes.learner_evaluation import evaluate_learner
from knotgym.tasks import TaskConfig

REQUEST, MODEL = "ppo.json", "model.zip"
POLICIES = {"pixels": "CnnPolicy", "state": "MlpPolicy"}


class InvalidBaseline(KnotgymError, ValueError):
    """A training that can't be done as asked."""


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


class _OneLine(argparse.ArgumentParser):
    """Says in one line what is wrong."""

    def error(self, message: str) -> NoReturn:
        raise InvalidBaseline(f"{message}; see --help")


def options() -> argparse.ArgumentParser:
    """What can be asked for."""
    usual = PpoConfig()
    parser = _OneLine(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="unknot", help="unknot, tie or convert")
    parser.add_argument("--nx", type=int, default=2)
    parser.add_argument("--states", help="readable (default), random-walk or a state file")
    parser.add_argument("--observation", default="pixels", choices=tuple(POLICIES))
    parser.add_argument("--image-size", type=int, default=128)
    parser.add_argument("--steps", type=int, default=1_000_000, help="to the end of the rollout")
    parser.add_argument("--every", type=int, default=250_000, help="steps between checkpoints")
    parser.add_argument("--out", type=Path, required=True, help="folder to make")
    parser.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    parser.add_argument("--split", default="train,test", help="to be tried on")
    parser.add_argument("--episodes", type=int, default=384, help="tried of each split; 0: not")
    parser.add_argument("--device", default="auto", help="cpu, cuda ...")
    parser.add_argument("--threads", type=int, default=0, help="of the simulation; 0: every core")
    parser.add_argument("--quiet", action="store_true")
    for name in ("learning_rate", "envs", "rollout", "batch", "epochs", "seed"):
        value = getattr(usual, name)
        word = f"--{name.replace('_', '-')}"
        parser.add_argument(word, type=type(value), default=value, help=f"{value}")
    return parser


def main() -> None:
    try:
        train(options().parse_args())
    except KnotgymError as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("stopped; --resume goes on from the last checkpoint", file=sys.stderr)
        sys.exit(130)


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
    trials = _trials(given, task)
    check_numbers(given, counts=("steps", "every"), whole=("threads",), error=InvalidBaseline)
    _require_device(given.device)
    request = {"ppo": as_json(config), "task": as_json(task)}
    found = _begun(given.out, request, given.resume)
    envs = _envs(task, config, given.threads)
    model, course = _learner(given, config, envs, found)
    if not given.resume:
        given.out.mkdir(parents=True, exist_ok=True)
    with atomic_write(given.out / REQUEST) as part:
        part.write_text(json.dumps(request, indent=1) + "\n", encoding="utf-8")
    if model.num_timesteps < given.steps:
        left = given.steps - model.num_timesteps
        model.learn(left, course, reset_num_timesteps=False, tb_log_name="ppo")
        course.save()
    _copy_last(given.out)
    if trials is not None:
        evaluate_learner(
            f"sb3-ppo-{task.observation}",
            ModelPolicy(lambda seen: model.predict(seen, deterministic=True)[0], "ppo"),
            given.out,
            _told(model, course, config),
            quiet=given.quiet,
            **trials,
        )


def _trials(given: argparse.Namespace, task: TaskConfig) -> dict[str, Any] | None:
    """What the learner will be tried at, with which all states are there; None for nothing."""
    state_origins(task)
    if given.episodes == 0:
        return None
    settings: dict[str, Any] = {
        "tasks": (task.task,),
        "nx": (task.nx,),
        "splits": words(given.split),
        "episodes": given.episodes,
        "task": task,
    }
    for _, setup in EvaluateConfig(policies=(PolicyConfig(),), **settings).setups():
        state_origins(setup)
    return settings


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


def _begun(out: Path, request: dict[str, Any], resume: bool) -> Path | None:
    """The checkpoint to go on from; None to begin. Refuses a folder that holds something else."""
    from training_course import checkpoints

    if not resume:
        require_writable(out / REQUEST)
        if out.is_file() or (out.is_dir() and any(out.iterdir())):
            raise InvalidBaseline(
                f"{out} holds something already; name a new folder, or --resume a training in it"
            )
        return None
    try:
        before = json.loads((out / REQUEST).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidBaseline(
            f"no training of this script in {out}; leave --resume out to begin one"
        ) from error
    if found := list(differences(before, request)):
        raise InvalidBaseline(f"{out} was begun otherwise: {'; '.join(found)}")
    return checkpoints(out)[-1] if checkpoints(out) else None


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
    main()
