"""Policies `recorded:DATASET` repeat the actions of a dataset's episodes.

An episode is recognized by where its rope lies after the reset and by its goal's code, so a
recording is replayed in every command that resets to the same starts, such as `knotgym evaluate`
with the seed that the episodes were recorded with.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import InvalidFile, InvalidPolicy
from knotgym.control.policy import Choice, UnplannedPolicy
from knotgym.datasets.episode_reader import EpisodeReader, episode_file
from knotgym.envs.episode_batch import EpisodeBatch

PREFIX = "recorded:"  # of a policy's name; a dataset's id or path follows

_Key = tuple[bytes, str]  # of `start_qpos`, and the goal's code


class RecordedPolicy(UnplannedPolicy):
    """Repeats recorded actions; once they are used up, the rope is left alone."""

    def __init__(self, actions: dict[_Key, NDArray[np.float32]], name: str) -> None:
        """Take the actions, float32 (T, 6), of each episode by its start and goal."""
        super().__init__(name)
        self._recorded = actions
        self._actions: dict[int, NDArray[np.float32]] = {}

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        """Find the recording of an episode that has just been reset.

        Raises:
            InvalidPolicy: no recorded episode has this start and goal.
        """
        super().begin(episodes, index, rng)
        start = episodes.simulation.qpos([index])[0]
        found = self._recorded.get(recording_key(start, str(episodes.goals[index])))
        if found is None:
            raise InvalidPolicy(
                f"{self._name} has {len(self._recorded)} episodes, but none with this start and"
                " goal; use the task, --states, --split and --seed that it was recorded with, and"
                " no more --episodes"
            )
        self._actions[index] = found

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        actions, moves = np.zeros((len(ids), 6), dtype=np.float32), []
        for row, index in enumerate(ids.tolist()):
            step, recorded = int(episodes.steps[index]), self._actions[index]
            if step < len(recorded):
                actions[row] = recorded[step]
            moves.append("recorded" if step < len(recorded) else "rest")
        return Choice(actions, moves)


def recording_key(start_qpos: NDArray[np.float64], goal: str) -> _Key:
    """Return what an episode is recognized by: the bytes of its start, and its goal's code."""
    return np.ascontiguousarray(start_qpos, dtype=np.float64).tobytes(), goal


def load_recording(name: str) -> RecordedPolicy:
    """Return the policy of a name `recorded:DATASET`.

    Raises:
        InvalidPolicy: there is no such dataset.
    """
    try:
        reader = EpisodeReader(name.removeprefix(PREFIX))
    except InvalidFile as error:
        raise InvalidPolicy(str(error)) from error
    recorded = {}
    for episode in reader:
        recorded[recording_key(episode.start_qpos, episode.goal_gauss_code)] = episode.actions
    reader.close()
    return RecordedPolicy(recorded, name)


def recording_files(name: str) -> dict[str, Path]:
    """Return the file that decides how a recorded policy acts."""
    path = episode_file(name.removeprefix(PREFIX))
    return {path.name: path}
