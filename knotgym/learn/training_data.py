"""What is learned from: the states and actions of episode datasets of the train split."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.errors import KnotgymError
from knotgym.learn.fitting import Stretches
from knotgym.learn.rope_model import BEADS
from knotgym.rope import RopeConfig

STRETCH = 4  # actions from the beginning of an episode that the rope's model is fitted to


class InvalidTrainingData(KnotgymError, ValueError):
    """Datasets that a learner can't be trained on."""


class TrainingData(NamedTuple):
    """All that is learned from.

    Attributes:
        frames: float32 (n, BEADS, 3), metres: every state of every episode.
        beads: int64 (n,), pulled on the way to each; -1 where an episode begins.
        forces: float64 (n, 3), newtons, that they were pulled with.
        starts: int64 (episodes,), the frame that each episode begins with.
        stretches: the first actions of every episode that has so many.
        digest: of the frames and actions, in order.
    """

    frames: NDArray[np.float32]
    beads: NDArray[np.int64]
    forces: NDArray[np.float64]
    starts: NDArray[np.int64]
    stretches: Stretches
    digest: str


def read_training_data(datasets: Sequence[Any]) -> TrainingData:
    """Read datasets, ids or folders.

    Raises:
        InvalidTrainingData: none, of the test split, without episodes, or of another rope.
        InvalidEpisodeFile, MissingFile: no dataset of this version.
    """
    if not datasets:
        raise InvalidTrainingData("name at least one dataset to train on, as in --data FOLDER")
    frames: list[NDArray[np.float32]] = []
    beads: list[NDArray[np.int64]] = []
    forces: list[NDArray[np.float64]] = []
    first = list[Stretches]()
    digest = hashlib.sha256()
    for dataset in datasets:
        reader = EpisodeReader(dataset)
        _check(reader, dataset)
        for index in range(len(reader)):
            episode = reader.episode(index)
            digest.update(episode.points.tobytes())
            digest.update(episode.actions.tobytes())
            frames.append(episode.points.astype(np.float32))
            beads.append(np.concatenate([[-1], episode.bead[1:]]))
            forces.append(episode.force)
            if len(episode) >= STRETCH:
                first.append(
                    Stretches(
                        episode.points[: STRETCH + 1],
                        episode.bead[1 : STRETCH + 1],
                        episode.force[1 : STRETCH + 1],
                    )
                )
        reader.close()
    if not first:
        raise InvalidTrainingData(
            f"no episode of {', '.join(map(str, datasets))} has {STRETCH} actions; collect longer"
            " ones, as with knotgym collect --policy scripted"
        )
    return TrainingData(
        np.concatenate(frames),
        np.concatenate(beads),
        np.concatenate(forces),
        np.cumsum([0, *map(len, frames[:-1])]),
        Stretches(*(np.stack(column, axis=1) for column in zip(*first, strict=True))),
        digest.hexdigest(),
    )


def _check(reader: EpisodeReader, dataset: Any) -> None:
    if not reader.task.split.startswith("train"):
        raise InvalidTrainingData(
            f"{dataset} is of the {reader.task.split} split, which is kept for evaluation; train on"
            " datasets of the train split"
        )
    if not len(reader):
        raise InvalidTrainingData(f"{dataset} has no episodes; collect some with knotgym collect")
    if reader.rope != RopeConfig().fingerprint or reader.task.integrator_steps != 24:
        raise InvalidTrainingData(
            f"{dataset} was made with rope {reader.rope} and {reader.task.integrator_steps}"
            f" integrator steps; the learner knows {RopeConfig().fingerprint} and 24"
        )
    shape = reader.column(0, "points").shape
    if shape[1:] != (BEADS, 3):
        raise InvalidTrainingData(f"{dataset} has ropes of {shape[1]} beads; {BEADS} are needed")
