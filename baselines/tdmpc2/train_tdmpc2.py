"""Train the official TD-MPC2 with the settings and the encoder of the paper, on pictures.

    git clone https://github.com/nicklashansen/tdmpc2 && git -C tdmpc2 checkout 97c14471997d
    python baselines/tdmpc2/train_tdmpc2.py --checkout tdmpc2 --task unknot --nx 2 \\
        --out tdmpc-unknot-nx2
    python baselines/tdmpc2/train_tdmpc2.py --checkout tdmpc2 --task unknot --nx 2 \\
        --out tdmpc-unknot-nx2 --resume

Needs torch, tensordict, torchrl, hydra-core, pandas and termcolor. The commit is on the branch with
vectorized environments; its trainer, agent and buffer run on our environment. Writes to --out:

    model.pt          agent, in the official format, and its optimizers
    losses.jsonl      one line per round of episodes
    evaluation.json   results, for `benchmarks/results.py`
    progress.json     steps and time spent
    tdmpc2.json       settings, which --resume compares

The agent is saved every `eval_freq` steps, when the official trainer evaluates it, and at the end.
The official code can't resume. --resume loads weights, optimizers and scale, but not the buffer,
which isn't saved (98 kB a step): the agent, instead of a random policy, refills it for `seed_steps`
steps, after which as many updates follow, as at the start of the official training.
"""

from __future__ import annotations

import argparse
import importlib
import json
import platform
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from official_patches import patch
from rope_rounds import RopeRounds, TdMpcPolicy

sys.path.append(str(Path(__file__).resolve().parents[1]))  # modules that all baselines share

from baseline_script import Progress, evaluation_settings, parser, require_folder, run, write_json
from official_code import (
    OfficialCode,
    Settings,
    add_options,
    import_from,
    read_settings,
    require_checkout,
)

import knotgym
from knotgym.common.atomic_files import atomic_write
from knotgym.common.configuration import as_json, check_numbers
from knotgym.common.errors import InvalidInput, one_line
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.learner_evaluation import evaluate_learner

TDMPC = OfficialCode(
    name="TD-MPC2",
    repository="github.com/nicklashansen/tdmpc2",
    commit="97c14471997d5e58420d05d0fd6a5bd0195410dd",
    files=("tdmpc2/tdmpc2.py", "tdmpc2/config.yaml", "tdmpc2/envs/wrappers/vectorized.py"),
    root="tdmpc2",
    libraries=("torch", "tensordict", "torchrl", "hydra", "omegaconf", "pandas", "termcolor"),
)
REQUEST, MODEL, LOSSES = "tdmpc2.json", "model.pt", "losses.jsonl"
SETTINGS = Path(__file__).with_name("settings.toml")
OURS = ("device", "seed_steps")  # settings of ours, not of the official config.yaml
DEVICES = ("cuda:0", "cpu")
LEAST_SIZE = 79  # the encoder's five convolutions reduce this to one pixel


def options() -> argparse.ArgumentParser:
    """Return the command-line options."""
    found = parser(__doc__ or "", "environment steps, rounded up to whole rounds of episodes")
    found.add_argument(
        "--threads", type=int, default=0, help="threads of the simulation; 0 for all cores"
    )
    add_options(found, TDMPC)
    return found


def train(given: argparse.Namespace) -> None:
    """Check the options, then train, save the agent and evaluate it."""
    task = TaskConfig(
        task=given.task, nx=given.nx, states=given.states, image_size=given.image_size
    )
    if given.image_size < LEAST_SIZE:
        raise InvalidInput(
            f"image_size must be at least {LEAST_SIZE} for the encoder, got {given.image_size}"
        )
    check_numbers(given, counts=("steps",), whole=("seed", "threads"), error=InvalidInput)
    settings = read_settings(SETTINGS, given.settings, given.set)
    check_settings(settings, task.horizon)
    evaluation = evaluation_settings(given, task)
    commit = require_checkout(TDMPC, given.checkout)
    request = {"settings": settings, "task": as_json(task), "seed": given.seed, "commit": commit}
    require_folder(given.out, REQUEST, request, given.resume)
    progress = Progress(given.out, given.resume)
    progress.resume(given.steps)
    import_from(TDMPC, given.checkout)
    agent = _agent(given, task, settings, progress)
    write_json(given.out / REQUEST, request)
    if progress.steps < given.steps:
        _learn(given, task, agent, progress)
    if evaluation is not None:
        torch = importlib.import_module("torch")
        torch.manual_seed(given.seed)
        agent._plan_val = agent._plan  # not compiled: the batch shrinks as episodes end
        report = {**_report(agent, commit, settings, given.seed), **progress.as_json()}
        policy = TdMpcPolicy(agent, torch)
        files = [given.out / MODEL]
        evaluate_learner(
            "tdmpc2", policy, given.out, report, files=files, quiet=given.quiet, **evaluation
        )


def check_settings(settings: Settings, horizon: int) -> None:
    """Check the settings that the official trainer doesn't check itself.

    Raises:
        InvalidInput: a setting would make it crash or skip evaluation or training.
    """
    if settings["device"] not in DEVICES:
        raise InvalidInput(f"device must be {' or '.join(DEVICES)}, got {settings['device']!r}")
    ropes = settings["num_envs"]
    if ropes < 1:
        raise InvalidInput(f"num_envs must be at least 1, got {ropes}")
    for name in ("eval_freq", "seed_steps"):
        if settings[name] < 1 or settings[name] % ropes:
            raise InvalidInput(
                f"{name} must be a multiple of num_envs, {ropes}, got {settings[name]}"
            )
    if settings["seed_steps"] < ropes * horizon:
        raise InvalidInput(
            f"seed_steps must be at least {ropes * horizon}, a round of num_envs episodes, got"
            f" {settings['seed_steps']}"
        )


def _config(given: argparse.Namespace, task: TaskConfig, settings: Settings, begun_at: int) -> Any:
    """Make the official configuration with the official parser."""
    omegaconf = importlib.import_module("omegaconf").OmegaConf
    hydra = importlib.import_module("hydra")
    config = omegaconf.load(given.checkout / TDMPC.root / "config.yaml")
    del config["defaults"]
    official = {name: value for name, value in settings.items() if name not in OURS}
    if not official["model_size"]:
        del official["model_size"]
    config.merge_with(
        official,
        {
            "task": f"{task.task}-nx{task.nx}",
            "obs": "rgb",
            "episodic": True,
            "steps": given.steps - begun_at,
            "eval_episodes": official["num_envs"],
            "seed": given.seed,
            "enable_wandb": False,
            "save_video": False,
            "save_agent": False,
        },
    )
    with mock.patch.object(hydra.utils, "get_original_cwd", lambda: str(given.out)):
        parsed = importlib.import_module("common.parser").parse_cfg(config)
    parsed.obs_shape = {"rgb": (3, task.image_size, 2 * task.image_size)}
    parsed.action_dim = 6
    parsed.episode_length = task.horizon
    parsed.seed_steps = settings["seed_steps"]
    return parsed


def _agent(
    given: argparse.Namespace, task: TaskConfig, settings: Settings, progress: Progress
) -> Any:
    """Create the official agent, or load the one to resume."""
    torch = importlib.import_module("torch")
    importlib.import_module("common.seed").set_seed(given.seed + progress.steps)
    config = _config(given, task, settings, progress.steps)
    try:
        torch.zeros(1, device=settings["device"])
    except (RuntimeError, AssertionError) as error:  # torch raises the latter for CUDA
        reason = one_line(error)[:200]
        raise InvalidInput(f"device {settings['device']!r} is not available: {reason}") from error
    patch(config.latent_dim, settings["device"])
    agent = importlib.import_module("tdmpc2").TDMPC2(config)
    optimizers = {"optim": agent.optim, "pi_optim": agent.pi_optim}
    if progress.steps:
        try:
            saved = torch.load(given.out / MODEL, map_location=agent.device, weights_only=True)
            agent.load({"model": saved["model"]})
            for name, one in {**optimizers, "scale": agent.scale}.items():
                one.load_state_dict(saved[name])
        except (
            Exception
        ) as error:  # pickle, zipfile and torch each raise their own for a corrupted file
            reason = one_line(error)[:200]
            raise InvalidInput(f"can't resume from {given.out / MODEL}: {reason}") from error
    for one in optimizers.values():
        for group in one.param_groups:
            group["capturable"] = agent.device.type == "cuda"
    return agent


def _save(out: Path, agent: Any, torch: Any) -> None:
    """Save what the official code saves, and what it lacks to resume."""
    out.mkdir(parents=True, exist_ok=True)
    state = {
        "model": agent.model.state_dict(),
        "optim": agent.optim.state_dict(),
        "pi_optim": agent.pi_optim.state_dict(),
        "scale": agent.scale.state_dict(),
    }
    with atomic_write(out / MODEL) as part:
        torch.save(state, part)


class _TensorRopes:
    """`RopeRounds` with the tensor interface of the official vectorized environments."""

    def __init__(self, rounds: RopeRounds, count: int, torch: Any, actor: Any) -> None:
        """Wrap rounds of `count` environments.

        `actor` maps pictures, and whether they begin a round, to the actions that fill the buffer;
        None for uniform random actions, as in the official code.
        """
        self._rounds, self._count, self._torch, self._actor = rounds, count, torch, actor
        self._seen: Any = None
        self._first = True

    def rand_act(self) -> Any:
        if self._actor is None:
            return 2 * self._torch.rand(self._count, 6) - 1
        return self._actor(self._seen, self._first)

    def reset(self) -> Any:
        self._seen, self._first = self._torch.from_numpy(self._rounds.reset()), True
        return self._seen

    def step(self, actions: Any) -> tuple[Any, Any, Any, dict[str, Any]]:
        torch = self._torch
        step = self._rounds.step(actions.numpy())
        self._seen, self._first = torch.from_numpy(step.pictures), False
        terminated = torch.from_numpy(step.terminated).float()
        info = {"success": terminated, "terminated": terminated}
        over = torch.full((self._count,), step.over)
        return self._seen, torch.from_numpy(step.rewards), over, info


def _learn(given: argparse.Namespace, task: TaskConfig, agent: Any, progress: Progress) -> None:
    """Run the official trainer from the current progress on."""
    torch = importlib.import_module("torch")
    trainers: Any = importlib.import_module("trainer.online_trainer")
    loggers: Any = importlib.import_module("common.logger")
    buffers: Any = importlib.import_module("common.buffer")
    config, begun_at = agent.cfg, progress.steps

    class Trainer(trainers.OnlineTrainer):
        def common_metrics(self) -> dict[str, Any]:
            return {**super().common_metrics(), "step": begun_at + self._step}

        def eval(self) -> dict[str, Any]:
            if self._step:
                self.save()
            return super().eval()

        def save(self) -> None:
            _save(given.out, agent, torch)
            progress.write(begun_at + self._step)

    class Logger(loggers.Logger):
        def log(self, metrics: dict[str, Any], category: str = "train") -> None:
            super().log(metrics, category)
            line = {"category": category, **{name: float(one) for name, one in metrics.items()}}
            with (given.out / LOSSES).open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")

    class Buffer(buffers.Buffer):
        def __init__(self, cfg: Any) -> None:
            super().__init__(cfg)
            least: int = cfg.num_envs * (cfg.episode_length + 1)
            self._capacity: int = max(self._capacity, least)

        def _init(self, episodes: Any) -> Any:
            if self._device.type == "cuda":
                return super()._init(episodes)
            return self._reserve_buffer(buffers.LazyTensorStorage(self._capacity))

    def acting(seen: Any, first: bool) -> Any:
        return agent.act(seen, t0=first)

    rng = np.random.default_rng([given.seed, begun_at])  # a resumed run draws other episodes
    rounds = RopeRounds(task, config.num_envs, rng, config.horizon + 1, given.threads)
    env = _TensorRopes(rounds, config.num_envs, torch, acting if begun_at else None)
    trainer = Trainer(
        cfg=config, env=env, agent=agent, buffer=Buffer(config), logger=Logger(config)
    )
    try:
        trainer.train()
    except KeyboardInterrupt:
        trainer.save()
        raise
    trainer.save()


def _report(agent: Any, commit: str, settings: Settings, seed: int) -> dict[str, Any]:
    """Describe the training, for the evaluation file."""
    torch = importlib.import_module("torch")
    return {
        "library": f"{TDMPC.repository} at {commit[:12]}, torch {torch.__version__}",
        "knotgym": knotgym.__version__,
        "parameters": int(agent.model.total_params),
        "settings": settings,
        "seed": seed,
        "machine": f"{platform.system()} {platform.machine()}, {agent.device}",
    }


if __name__ == "__main__":
    run(train, options())
