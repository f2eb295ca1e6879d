"""The recipes of `knotgym train`: read or make data, train, write a checkpoint folder.

Demonstrations are calls of a run, see `knotgym.runs`, so workers make them and its journal keeps
them; a training that is interrupted continues from its one checkpoint.
"""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

import knotgym
from knotgym.common import InvalidInput, Table, by_name, sha256
from knotgym.datasets import EpisodeDataset, columns_of
from knotgym.envs import TaskConfig
from knotgym.learn.card import CARD
from knotgym.learn.checkpoint import save_network
from knotgym.learn.clone_training import CloneTraining
from knotgym.learn.colour_reading import BEADS
from knotgym.learn.reader_training import ReaderTraining
from knotgym.learn.train_config import CloneConfig, ReaderConfig
from knotgym.learn.training import Log, Training, fit
from knotgym.learn.training_data import TOGETHER, Examples, TrainingData, demonstrate
from knotgym.learn.trials import Trials
from knotgym.rope import CHAIN, RopeConfig
from knotgym.runs import Call, Progress, Recipe, RunOptions, identity, run

_MADE = ("demonstrations", "copies", "task", "nx", "split", "states")  # fields of a clone


def train(
    datasets: Sequence[Any],
    out: Path,
    config: ReaderConfig | CloneConfig,
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
    if getattr(config, "device", "cpu") == "cuda" and not torch.cuda.is_available():
        raise InvalidInput("device cuda needs a GPU that torch can use; there is none, so use cpu")
    if not options.shard.is_whole:
        raise InvalidInput("a training can't be divided: leave out run.shard")
    opened = [columns_of(one) for one in datasets]
    for one in opened:
        _require_trainable(one)
    demonstrations = getattr(config, "demonstrations", 0)
    if not opened and not demonstrations:
        raise InvalidInput(
            "nothing to learn from: name datasets, as in --data FOLDER, or let demonstrations be"
            " made for a clone, as in --set clone.demonstrations=1000"
        )
    parts = [part for one in opened for part in one.parts or [one]]
    whole = identity(
        config,
        {
            "data": [part.path for part in parts],
            "columns": [Table.digest(table) for one in opened for table in one.episodes],
        },
    )
    card = {
        "knotgym": knotgym.__version__,
        # without what says how demonstrations are made, where none are
        "config": {n: v for n, v in whole["config"].items() if demonstrations or n not in _MADE},
        "data": by_name((part.name, sha256(part.path)) for part in parts),
        "updates": config.steps,
        "trained_on": _trained_on(opened, config),
        "identity": whole,
    }

    def _recipe(place: Path) -> Recipe[str]:
        trials = Trials(_tasks(opened, config), config.trials, config.seed)
        training = yield from _training(opened, config, trials)
        made = fit(training, place, config.save_every, progress, log)
        save_network(place, made.network, training.LEARNER, {**card, **made.facts}, made.others)
        trials.draw(place, training.LOSSES, training.losses, made.kept)
        return made.summary

    compiles = {"engine": CHAIN} if demonstrations else None
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


def _trained_on(
    opened: Sequence[EpisodeDataset], config: ReaderConfig | CloneConfig
) -> dict[str, list[Any]]:
    """Return the setups of the datasets and of demonstrations: the values of each setting."""
    tasks = [one.task for one in opened]
    setups = [(one.task, one.nx, one.states or "readable", one.engine) for one in tasks]
    if isinstance(config, CloneConfig) and config.demonstrations:
        setups += [(*setup, config.states, CHAIN) for setup in product(config.task, config.nx)]
    columns = zip(*dict.fromkeys(setups), strict=True)
    values = [sorted(set(column), key=str) for column in columns]
    return dict(zip(("tasks", "nx", "states", "engine"), values, strict=True))


def _training(
    opened: Sequence[EpisodeDataset], config: ReaderConfig | CloneConfig, trials: Trials
) -> Recipe[Training]:
    """Return the training of a learner, with what it is trained on."""
    if isinstance(config, ReaderConfig):
        # a recipe yields calls at least once; this one has none to make
        yield []
        return ReaderTraining(TrainingData.of([one.episodes for one in opened]), config)
    parts, count = list[Examples](), 0
    for one in opened:
        if "macro_start" not in one.episodes.steps:
            raise InvalidInput(
                f"{one.name} doesn't say which macro-actions its policy chose, so the clone can't"
                " learn them; use a set of expert or noisy"
            )
        parts.append(Examples.of(one.episodes, count))
        count += one.episodes.episodes.rows
    calls = list[Call]()
    for task, nx in product(config.task, config.nx):
        for first in range(0, config.demonstrations, TOGETHER):
            few = min(TOGETHER, config.demonstrations - first)
            name, arguments = f"demonstrations of {task} {nx} {first}", (config, task, nx, first)
            calls.append(Call(name, demonstrate, arguments, few))
    for own in (Examples(**columns) for columns in (yield calls)):
        # searches are numbered from 0 for each task and nx
        # unique over all parts: held-out episodes are drawn by their numbers
        parts.append(own._replace(episodes=own.episodes % TOGETHER + count))
        count += TOGETHER
    data = Examples(*(np.concatenate(own) for own in zip(*parts, strict=True)))
    if not data.worked.any():
        raise InvalidInput("no episode reached its goal, so there is nothing to imitate")
    return CloneTraining(config, data, trials)


def _tasks(
    opened: Sequence[EpisodeDataset], config: ReaderConfig | CloneConfig
) -> list[TaskConfig]:
    """Return the tasks of the datasets, or of the demonstrations if there are none."""
    if opened or isinstance(config, ReaderConfig):
        return [one.task for one in opened]
    return [
        TaskConfig(task=task, nx=nx, split=config.split, states=config.states, engine=CHAIN)
        for task, nx in product(config.task, config.nx)
    ]
