"""What a vision-language model did, once more: the actions of its transcripts, in the episodes that
they are of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.configuration import as_json, differences
from knotgym.control.policy import Choice, InvalidPolicy, UnplannedPolicy
from knotgym.episode_batch import EpisodeBatch
from knotgym.prompting.transcripts import InvalidTranscript, read_transcripts, transcripts_at
from knotgym.streams import Stream, generator
from knotgym.tasks import TaskConfig

# of a task, what makes no episode another one
_SEEN = ("observation", "image_size", "views", "depth", "camera", "renderer")


class TranscriptPolicy(UnplannedPolicy):
    """Acts as transcripts say. An episode is known by the first draw of its generator."""

    def __init__(self, transcripts: Sequence[Mapping[str, Any]], name: str) -> None:
        super().__init__(f"prompt:{name}")
        self._transcripts: dict[float, Mapping[str, Any]] = {}
        for one in transcripts:
            own = generator(Stream.EVALUATION_POLICY, one["config"]["seed"], one["number"])
            self._transcripts[own.random()] = one
        self._actions: dict[int, NDArray[np.float32]] = {}

    def suited(self, task: TaskConfig) -> TaskConfig:
        here = _seen(as_json(task))
        for one in self._transcripts.values():
            there = _seen(one["config"]["task"])
            apart = [f"--{told.replace('_', '-', 1)}" for told in differences(there, here)]
            if apart:
                raise InvalidPolicy(f"{self._name} is of another task: {'; '.join(apart)}")
        return task

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        """Take up an episode.

        Raises:
            InvalidPolicy: no transcript is of this episode.
        """
        super().begin(episodes, index, rng)
        one = self._transcripts.get(rng.random())
        if one is None:
            some = next(iter(self._transcripts.values()))
            raise InvalidPolicy(
                f"{self._name} has {len(self._transcripts)} episodes of seed"
                f" {some['config']['seed']}, and this is another: give --episodes"
                f" {len(self._transcripts)} --seed {some['config']['seed']}"
            )
        info = episodes.info(index)
        rows = {"start": one["start"], "goal": one["goal"]}
        apart = list(differences(rows, {name: info[name] for name in rows}))
        if apart:
            raise InvalidPolicy(f"{self._name} is of another task: {'; '.join(apart)}")
        self._actions[index] = np.array(one["actions"], dtype=np.float32).reshape(-1, 6)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        actions = [self._actions[index][episodes.steps[index]] for index in ids.tolist()]
        return Choice(np.stack(actions), [""] * len(ids))


def _seen(task: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a task without those that show the same episode in another way."""
    return {name: value for name, value in task.items() if name not in _SEEN}


def load_transcripts(named: Path) -> list[dict[str, Any]]:
    """The transcripts of episodes that a file, or a run's folder, holds.

    Raises:
        InvalidPolicy: there are none.
    """
    path = transcripts_at(named)
    if path is None:
        raise InvalidPolicy(f"no transcripts at {named}: give a .jsonl that knotgym prompt wrote")
    try:
        found = read_transcripts(path)
    except InvalidTranscript as error:
        raise InvalidPolicy(str(error)) from error
    if not found or not all("actions" in one for one in found):
        raise InvalidPolicy(f"{path} holds no episodes")
    return found
