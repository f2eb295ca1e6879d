"""Training data: the states and actions of episode datasets of the train split."""

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import InvalidInput
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.learn.imagination import BEADS
from knotgym.rope.model import RopeConfig


class TrainingData(NamedTuple):
    """States and actions of all episodes, one after the other.

    Attributes:
        frames: float32 (n, BEADS, 3), every state of every episode, metres.
        beads: int64 (n,), bead pulled by the action that led to each state; -1 for a first state.
        forces: float64 (n, 3), force of that action, newtons.
        starts: int64 (episodes,), index of each episode's first state.
        digest: SHA-256 of all states and actions in order, hexadecimal.
    """

    frames: NDArray[np.float32]
    beads: NDArray[np.int64]
    forces: NDArray[np.float64]
    starts: NDArray[np.int64]
    digest: str


def read_training_data(datasets: Sequence[Any], engine: str) -> TrainingData:
    """Read datasets of one engine, given as ids or folders.

    Raises:
        InvalidInput: no dataset, or one that is not of the train split, has no episodes or
            was made with another rope or engine.
        InvalidFile, MissingFile: a dataset is missing or not of this version.
    """
    if not datasets:
        raise InvalidInput("name at least one dataset to train on, as in --data FOLDER")
    frames: list[NDArray[np.float32]] = []
    beads: list[NDArray[np.int64]] = []
    forces: list[NDArray[np.float64]] = []
    digest = hashlib.sha256()
    for dataset in datasets:
        reader = EpisodeReader(dataset)
        require_trainable(reader, dataset, engine)
        for index in range(len(reader)):
            episode = reader.episode(index)
            digest.update(episode.points.tobytes())
            digest.update(episode.actions.tobytes())
            frames.append(episode.points.astype(np.float32))
            beads.append(np.concatenate([[-1], episode.bead[1:]]))
            forces.append(episode.force)
        reader.close()
    return TrainingData(
        np.concatenate(frames),
        np.concatenate(beads),
        np.concatenate(forces),
        np.cumsum([0, *map(len, frames[:-1])]),
        digest.hexdigest(),
    )


def require_trainable(reader: EpisodeReader, dataset: Any, engine: str) -> None:
    """Require episodes of the train split, of an engine, with the rope that learners know.

    Raises:
        InvalidInput: they are not.
    """
    if not reader.task.split.startswith("train"):
        raise InvalidInput(
            f"{dataset} is of the {reader.task.split} split, which is held out for evaluation;"
            " train on datasets of the train split"
        )
    if not len(reader):
        raise InvalidInput(f"{dataset} has no episodes; collect some with knotgym collect")
    if reader.task.engine != engine:
        raise InvalidInput(
            f"{dataset} was made with engine {reader.task.engine}, and this training is for engine"
            f" {engine}; give --engine {reader.task.engine} to train on it"
        )
    if reader.rope != RopeConfig().fingerprint or reader.task.integrator_steps != 24:
        raise InvalidInput(
            f"{dataset} was made with rope {reader.rope} and {reader.task.integrator_steps}"
            f" integrator steps; the learner supports only {RopeConfig().fingerprint} and 24"
        )
    shape = reader.column(0, "points").shape
    if shape[1:] != (BEADS, 3):
        raise InvalidInput(f"{dataset} has ropes of {shape[1]} beads; {BEADS} are needed")
