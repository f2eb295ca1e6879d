"""Train the official DreamerV3 with the settings of the paper, on pictures.

    git clone https://github.com/danijar/dreamerv3 && git -C dreamerv3 checkout e3f02248693a
    python baselines/dreamerv3/train_dreamerv3.py --checkout dreamerv3 --task unknot --nx 2 \\
        --out dreamer-unknot-nx2
    python baselines/dreamerv3/train_dreamerv3.py --checkout dreamerv3 --task unknot --nx 2 \\
        --out dreamer-unknot-nx2 --resume

Needs jax and the other libraries of the official requirements. Runs the official `main` on our
environment; logs, checkpoints, replay and resuming are the official code's. Writes to --out:

    official/         files of the official code: ckpt/, replay/, metrics.jsonl, config.yaml
    evaluation.json   results, for `benchmarks/results.py`
    progress.json     steps and time spent, of all runs that ended
    dreamerv3.json    settings, which --resume compares

The official code counts the first observation of an episode as a step. It saves every
`run.save_every` seconds and when it ends; a killed training loses what came after. Its checkpoints
hold pickles: --resume only folders that you trust.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import platform
import sys
from pathlib import Path
from typing import Any

import numpy as np
from dreamer_rope import DreamerPolicy, DreamerRope

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
from knotgym.common.configuration import as_json, check_numbers
from knotgym.common.errors import InvalidInput
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.learner_evaluation import evaluate_learner

DREAMER = OfficialCode(
    name="DreamerV3",
    repository="github.com/danijar/dreamerv3",
    commit="e3f02248693a79dc8b0ebd62c93683888ddaccfe",
    files=("dreamerv3/main.py", "dreamerv3/configs.yaml", "embodied/run/train.py"),
    libraries=("jax", "elements", "ninjax", "portal", "granular", "optax", "chex", "einops"),
)
REQUEST, OFFICIAL = "dreamerv3.json", "official"
SETTINGS = Path(__file__).with_name("settings.toml")
NETWORKS = ("enc/", "dyn/", "dec/", "rew/", "con/", "pol/", "val/")


def options() -> argparse.ArgumentParser:
    """Return the command-line options."""
    found = parser(__doc__ or "", "environment steps as the official code counts them")
    add_options(found, DREAMER)
    return found


def train(given: argparse.Namespace) -> None:
    """Check the options, then train, save the agent and evaluate it."""
    task = TaskConfig(
        task=given.task, nx=given.nx, states=given.states, image_size=given.image_size
    )
    if given.image_size not in range(48, 129, 16):
        raise InvalidInput(
            f"image_size must be 48, 64, 80, 96, 112 or 128, to be halved four times; got"
            f" {given.image_size}"
        )
    check_numbers(given, counts=("steps",), whole=("seed",), error=InvalidInput)
    settings = read_settings(SETTINGS, given.settings, given.set)
    evaluation = evaluation_settings(given, task)
    commit = require_checkout(DREAMER, given.checkout)
    _require_platform(settings["jax.platform"])
    request = {"settings": settings, "task": as_json(task), "seed": given.seed, "commit": commit}
    require_folder(given.out, REQUEST, request, given.resume)
    progress = Progress(given.out, given.resume)
    progress.resume(given.steps)
    import_from(DREAMER, given.checkout)
    write_json(given.out / REQUEST, request)
    agent = _trained(given, task, settings, progress)
    if evaluation is not None:
        report = {**_report(agent, commit, settings, given.seed), **progress.as_json()}
        saved = sorted((given.out / OFFICIAL / "ckpt").rglob("agent*"))  # in folders by date
        files = [path for path in saved if path.is_file()][-1:]
        evaluate_learner(
            "dreamerv3",
            DreamerPolicy(agent),
            given.out,
            report,
            files=files,
            quiet=given.quiet,
            **evaluation,
        )


def _require_platform(platform: str) -> None:
    """Refuse CUDA where jax has no plugin for it.

    Asking jax itself would initialize it before the official code configures it.
    """
    plugins = ("jax_cuda12_plugin", "jax_cuda13_plugin")
    if platform == "cuda" and not any(map(importlib.util.find_spec, plugins)):
        raise InvalidInput(
            "jax has no CUDA here, which --settings paper needs; install jax[cuda12], or give"
            " --set jax.platform=cpu"
        )


def flags(given: argparse.Namespace, settings: Settings) -> list[str]:
    """Build the command line of the official code."""
    words = ["--configs", *settings["configs"]]
    ours: Settings = {
        "logdir": str((given.out / OFFICIAL).resolve()),
        "task": f"knotgym_{given.task}-nx{given.nx}",
        "seed": given.seed,
        "run.steps": float(given.steps),
        "logger.outputs": "jsonl",
    }
    for name, value in {**settings, **ours}.items():
        if name != "configs":
            words += [f"--{name}", str(value)]
    return words


def _trained(
    given: argparse.Namespace, task: TaskConfig, settings: Settings, progress: Progress
) -> Any:
    """Train by the official code; save and return the agent."""
    elements = importlib.import_module("elements")
    official = importlib.import_module("dreamerv3.main")
    made: dict[str, Any] = {}
    begun_at = progress.steps

    def keeping(name: str) -> Any:
        make = getattr(official, f"make_{name}")

        def keep(*words: Any) -> Any:
            made[name] = make(*words)
            return made[name]

        return keep

    def make_env(config: Any, index: int, **_: Any) -> Any:
        rng = np.random.default_rng(
            [given.seed, begun_at, index]
        )  # a resumed run draws other episodes
        return official.wrap_env(DreamerRope(task, rng, elements.Space), config)

    # the official main looks these functions up by name; everything else is left alone
    names = vars(official)
    names |= {f"make_{name}": keeping(name) for name in ("agent", "replay", "logger")}
    names["make_env"] = make_env
    try:
        official.main(flags(given, settings))
    except KeyboardInterrupt:
        if len(made) == 3:
            _save(given.out, made, progress)
        raise
    _save(given.out, made, progress)
    return made["agent"]


def _save(out: Path, made: dict[str, Any], progress: Progress) -> None:
    """Save a last checkpoint in the official format; the official code doesn't save at its end."""
    steps = int(made["logger"].step)
    if steps == progress.steps:
        return
    elements = importlib.import_module("elements")
    checkpoint = elements.Checkpoint(elements.Path(str((out / OFFICIAL).resolve())) / "ckpt")
    checkpoint.step, checkpoint.agent = made["logger"].step, made["agent"]
    checkpoint.replay = made["replay"]
    checkpoint.save()
    progress.write(steps)


def _report(agent: Any, commit: str, settings: Settings, seed: int) -> dict[str, Any]:
    """Describe the training, for the evaluation file."""
    jax = importlib.import_module("jax")
    weights = {name: one for name, one in agent.params.items() if name.startswith(NETWORKS)}
    return {
        "library": f"{DREAMER.repository} at {commit[:12]}, jax {jax.__version__}",
        "knotgym": knotgym.__version__,
        "parameters": int(sum(one.size for one in weights.values())),
        "settings": settings,
        "seed": seed,
        "machine": f"{platform.system()} {platform.machine()}, {jax.default_backend()}",
    }


if __name__ == "__main__":
    run(train, options())
