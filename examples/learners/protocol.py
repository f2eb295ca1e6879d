"""What the scripts here share: their options, and how a learner is measured: in the episodes of
`knotgym evaluate`, into a file as it writes, which `benchmarks/results.py` reads.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from knotgym.cli.options import numbers, words
from knotgym.control.policy import Policy
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.minari_dataset import metadata_of
from knotgym.generate.episodes.learner_evaluation import evaluate_learner
from knotgym.tasks import TaskConfig


def parser(description: str, kinds: tuple[str, ...]) -> argparse.ArgumentParser:
    """The options of every script: what learns, from what, for how long, and where it is tried."""
    options = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("learner", choices=kinds)
    options.add_argument("datasets", nargs="+", help="Minari ids or folders, of the train split")
    options.add_argument("--steps", type=int, default=20_000, help="of gradient descent")
    options.add_argument("--batch", type=int, default=256)
    options.add_argument("--seed", type=int, default=0, help="of the training")
    options.add_argument("--out", type=Path, required=True, help="folder to make")
    options.add_argument("--task", default="unknot,tie,convert", help="to be tried at")
    options.add_argument("--nx", default="2-4", help="to be tried at")
    options.add_argument("--split", default="test")
    options.add_argument("--states", default=None, help="readable or random-walk")
    options.add_argument("--episodes", type=int, default=256, help="tried, of each set-up")
    return options


class Training:
    """What a training took, told beside the scores."""

    def __init__(self, library: str, given: argparse.Namespace, datasets: list[str]) -> None:
        self._began, self._spent = time.perf_counter(), time.process_time()
        given.out.mkdir(parents=True, exist_ok=True)
        readers = [EpisodeReader(source) for source in datasets]
        self._told: dict[str, Any] = {
            "library": library,
            "datasets": [_called(source) for source in datasets],
            "episodes": sum(len(reader) for reader in readers),
            "transitions": int(sum(reader.lengths.sum() for reader in readers)),
            "steps": given.steps,
            "batch": given.batch,
            "seed": given.seed,
        }
        for reader in readers:
            reader.close()

    def ended(self) -> dict[str, Any]:
        """All of it, with the seconds."""
        return {
            **self._told,
            "seconds": round(time.perf_counter() - self._began, 1),
            "cpu_seconds": round(time.process_time() - self._spent, 1),
        }


def _called(source: str) -> str:
    """The id of a dataset; of an episode file that has none, its name."""
    metadata = metadata_of(source)
    return Path(source).name if metadata is None else metadata.dataset_id


def measure(
    name: str, policy: Policy, given: argparse.Namespace, training: dict[str, Any], model: str
) -> dict[str, Any]:
    """Try a policy at every set-up asked for, episodes 0 to N - 1 of seed 0, on state observations.

    Writes `evaluation.json` and returns what it holds: that of `knotgym evaluate --out`, and how
    the learner was trained; `model` is the file of its weights in the folder.
    """
    return evaluate_learner(
        name,
        policy,
        given.out,
        training,
        files=[given.out / model],
        tasks=words(given.task),
        nx=numbers(given.nx),
        splits=words(given.split),
        episodes=given.episodes,
        task=TaskConfig(task="tie", states=given.states, observation="state"),
    )
