"""The recipes of `knotgym train`: read or make data, train, write a checkpoint folder.

Demonstrations are calls of a run, see `knotgym.runs`, so workers make them and its journal keeps
them; a training that is interrupted continues from its one checkpoint.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

import knotgym
from knotgym.common import InvalidInput, Table, by_name, sha256
from knotgym.datasets import EpisodeDataset, columns_of
from knotgym.envs import TaskConfig
from knotgym.learn.card import CARD
from knotgym.learn.checkpoint import save_network
from knotgym.learn.colour_reading import BEADS
from knotgym.learn.learners import LEARNERS
from knotgym.learn.train_config import TrainConfig
from knotgym.learn.training import Log, Training, fit
from knotgym.learn.trials import Trials
from knotgym.rope import CHAIN, RopeConfig
from knotgym.runs import Progress, Recipe, RunOptions, identity, run

# fields of a clone that say how demonstrations are made: not on its card where none are
_MADE = ("demonstrations", "copies", "task", "nx", "split", "states")


def train(
    datasets: Sequence[Any],
    out: Path,
    config: TrainConfig,
    options: RunOptions,
    progress: Progress | None = None,
    log: Log | None = None,
) -> Path:
    """Train a learner on datasets and write its checkpoint folder.

    Args:
        datasets: ids or folders of train-split episodes; for a clone, of policies that choose
            macro-actions.
        out: folder to create.
        config: which learner, and its settings.
        options: of the run; its workers make demonstrations.
        progress: where to show progress.
        log: see `training.fit`.

    Raises:
        InvalidInput: the datasets are unsuitable, there is no such device, or the training to
            resume has other settings.
        Occupied: `out` exists, holds an interrupted training, or is used by another process.
        InvalidFile, MissingFile: a dataset, or the training to resume, is missing or invalid.
    """
    progress = progress or Progress(options.quiet)
    kind, learner = next(row for row in LEARNERS.items() if isinstance(config, row[1].config))
    begun: type[Training] = learner.loaded(learner.training)
    if getattr(config, "device", "cpu") == "cuda" and not torch.cuda.is_available():
        raise InvalidInput("device cuda needs a GPU that torch can use; there is none, so use cpu")
    if not options.shard.is_whole:
        raise InvalidInput("a training can't be divided: leave out run.shard")
    opened = [columns_of(dataset) for dataset in datasets]
    for dataset in opened:
        _require_trainable(dataset)
    if not (tasks := [dataset.task for dataset in opened] or config.demonstrated):
        raise InvalidInput(
            "nothing to learn from: name datasets, as in --data FOLDER, or let demonstrations be"
            " made for a clone, as in --set clone.demonstrations=1000"
        )
    parts = [part for dataset in opened for part in dataset.parts or [dataset]]
    whole = identity(
        config,
        {
            "data": [part.path for part in parts],
            "columns": [Table.digest(table) for dataset in opened for table in dataset.episodes],
        },
    )
    unused = () if config.demonstrated else _MADE
    card = {
        "knotgym": knotgym.__version__,
        "config": {name: value for name, value in whole["config"].items() if name not in unused},
        "data": by_name((part.name, sha256(part.path)) for part in parts),
        "updates": config.steps,
        "trained_on": _trained_on([*(dataset.task for dataset in opened), *config.demonstrated]),
        "identity": whole,
    }

    def _recipe(place: Path) -> Recipe[str]:
        trials = Trials(tasks, config.trials, config.seed)
        training = yield from begun.begun(opened, config, trials)
        made = fit(training, place, config.save_every, progress, log)
        save_network(place, made.network, kind, {**card, **made.facts}, made.others)
        trials.draw(place, training.LOSSES, training.losses, made.kept)
        return made.summary

    compiles = {"engine": CHAIN} if config.demonstrated else None
    return run(_recipe, out, whole, options, progress, compiles=compiles, identity_in=CARD)


def _require_trainable(dataset: EpisodeDataset) -> None:
    """Require episodes of the train split, with the rope that learners know.

    Raises:
        InvalidInput: they are not.
    """
    name, task, rope = dataset.name, dataset.task, dataset.attributes.get("rope")
    if not task.split.startswith("train"):
        raise InvalidInput(
            f"{name} is of the {task.split} split, which is held out for evaluation; train on"
            " datasets of the train split"
        )
    if not dataset.episodes.episodes.rows:
        raise InvalidInput(f"{name} has no episodes; collect some with knotgym collect")
    if rope != RopeConfig().fingerprint or task.integrator_steps != 24:
        raise InvalidInput(
            f"{name} was made with rope {rope} and {task.integrator_steps} integrator steps; the"
            f" learner supports only {RopeConfig().fingerprint} and 24"
        )
    beads = dataset.episodes.steps["observation"].shape[1]
    if beads != BEADS:
        raise InvalidInput(f"{name} has ropes of {beads} beads; {BEADS} are needed")


def _trained_on(tasks: Sequence[TaskConfig]) -> dict[str, list[Any]]:
    """Return the setups of the datasets and of demonstrations: the values of each setting."""
    setups = dict.fromkeys(
        (task.task, task.nx, task.states or "readable", task.engine) for task in tasks
    )
    values = [sorted(set(column), key=str) for column in zip(*setups, strict=True)]
    return dict(zip(("tasks", "nx", "states", "engine"), values, strict=True))
