"""Shared by these scripts: their options, and evaluation with the protocol of `knotgym evaluate`.

Results are written in its format, which `benchmarks/results.py` reads.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from pathlib import Path
from typing import Any

from knotgym.cli import numbers
from knotgym.control import Policy, PolicyConfig, register_policy
from knotgym.datasets import open_episodes
from knotgym.envs import TaskConfig
from knotgym.generate import EvaluateConfig, evaluate
from knotgym.runs import RunOptions


def parser(description: str, kinds: tuple[str, ...]) -> argparse.ArgumentParser:
    """Return the options of every script: learner, datasets, training and evaluation."""
    options = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("learner", choices=kinds)
    options.add_argument("datasets", nargs="+", help="Minari ids or folders, of the train split")
    options.add_argument("--steps", type=int, default=20_000, help="gradient steps")
    options.add_argument("--batch", type=int, default=256)
    options.add_argument("--seed", type=int, default=0, help="seed of the training")
    options.add_argument("--out", type=Path, required=True, help="folder to create")
    options.add_argument("--task", default="unknot,tie,convert", help="tasks to evaluate")
    options.add_argument("--nx", default="2-4", help="crossing numbers to evaluate")
    options.add_argument("--split", default="test")
    options.add_argument("--states", default=None, help="readable, random-walk or bench")
    options.add_argument("--episodes", type=int, default=256, help="evaluated per setting")
    options.add_argument("--engine", default="mujoco", help="to evaluate in: mujoco or chain")
    return options


class Training:
    """Settings and cost of a training, reported with its scores."""

    def __init__(self, library: str, given: argparse.Namespace, datasets: list[str]) -> None:
        self._began, self._spent = time.perf_counter(), time.process_time()
        given.out.mkdir(parents=True, exist_ok=True)
        opened = [open_episodes(source) for source in datasets]
        self._report: dict[str, Any] = {
            "library": library,
            "datasets": [one.name for one in opened],
            "episodes": sum(one.episodes.episodes.rows for one in opened),
            "transitions": int(sum(one.episodes.episodes["length"].sum() for one in opened)),
            "steps": given.steps,
            "batch": given.batch,
            "seed": given.seed,
            "command": shlex.join(
                ["python", f"examples/learners/{Path(sys.argv[0]).name}", *sys.argv[1:]]
            ),
        }

    def ended(self) -> dict[str, Any]:
        """Return the report, with the time spent."""
        return {
            **self._report,
            "seconds": round(time.perf_counter() - self._began, 1),
            "cpu_seconds": round(time.process_time() - self._spent, 1),
        }


def measure(
    name: str, policy: Policy, given: argparse.Namespace, training: dict[str, Any], *models: str
) -> dict[str, Any]:
    """Evaluate a policy in every chosen setting, in episodes 0 to N - 1 of seed 0, on states.

    Args:
        name: of the policy, in the results.
        policy: to evaluate.
        given: options of the command line.
        training: report on the training.
        models: names of the weights' files in the output folder.

    Returns:
        The content of `evaluation.json`: as from `knotgym evaluate --out`, with the report on the
        training among `learners`.
    """
    files = [given.out / model for model in models]
    register_policy(name, lambda config: policy, files)
    config = EvaluateConfig(
        policies=(PolicyConfig(policy=name),),
        tasks=tuple(given.task.split(",")),
        nx=numbers(given.nx),
        splits=tuple(given.split.split(",")),
        episodes=given.episodes,
        task=TaskConfig(task="tie", states=given.states, observation="state", engine=given.engine),
    )
    out = given.out / "evaluation.json"
    # one process: the policy is known here alone
    evaluate(config, RunOptions(workers=1, overwrite=True), out=out)
    found: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    found["learners"][name] = training
    out.write_text(json.dumps(found, indent=1), encoding="utf-8")
    return found
