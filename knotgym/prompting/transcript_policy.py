"""Replay the actions of transcripts in the episodes that they were recorded in.

`knotgym.control.policies` finds the names `prompt:FILE` through the entry point `prompt`.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import as_json, differences
from knotgym.common.errors import InvalidFile, InvalidPolicy
from knotgym.common.streams import Stream, generator
from knotgym.control.policies import PolicyFamily
from knotgym.control.policy import Choice, Policy, UnplannedPolicy
from knotgym.control.policy_config import PolicyConfig
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.prompting.transcripts import read_transcripts, transcripts_at

PREFIX = "prompt:"  # of a policy's name; the path of transcripts follows

# settings of a task that change how an episode is shown but not what happens in it
_SHOWN = ("observation", "image_size", "views", "depth", "camera", "renderer")


class TranscriptPolicy(UnplannedPolicy):
    """Repeats the actions of transcripts.

    A policy doesn't know the number of an episode, so it recognizes one by the first draw of the
    generator that the episode's policy gets.
    """

    def __init__(self, transcripts: Sequence[Mapping[str, Any]], name: str) -> None:
        super().__init__(PREFIX + name)
        self._transcripts: dict[float, Mapping[str, Any]] = {}
        for one in transcripts:
            rng = generator(Stream.EVALUATION_POLICY, one["config"]["seed"], one["number"])
            self._transcripts[rng.random()] = one
        self._actions: dict[int, NDArray[np.float32]] = {}

    def suited(self, task: TaskConfig) -> TaskConfig:
        here = _episode_settings(as_json(task))
        for one in self._transcripts.values():
            there = _episode_settings(one["config"]["task"])
            changed = [f"--{one.replace('_', '-', 1)}" for one in differences(there, here)]
            if changed:
                raise InvalidPolicy(
                    f"{self._name} was recorded in another task: {'; '.join(changed)}"
                )
        return task

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        """Find the episode's transcript.

        Raises:
            InvalidPolicy: there is none, or its start or goal differs.
        """
        super().begin(episodes, index, rng)
        one = self._transcripts.get(rng.random())
        if one is None:
            count = len(self._transcripts)
            seed = next(iter(self._transcripts.values()))["config"]["seed"]
            raise InvalidPolicy(
                f"{self._name} holds {count} episodes of seed {seed}, but not this one: use"
                f" --episodes {count} --seed {seed}"
            )
        info = episodes.info(index)
        rows = {"start": one["start"], "goal": one["goal"]}
        changed = list(differences(rows, {name: info[name] for name in rows}))
        if changed:
            raise InvalidPolicy(f"{self._name} was recorded in another task: {'; '.join(changed)}")
        self._actions[index] = np.array(one["actions"], dtype=np.float32).reshape(-1, 6)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        actions = [self._actions[index][episodes.steps[index]] for index in ids.tolist()]
        return Choice(np.stack(actions), [""] * len(ids))


def _episode_settings(task: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a task that decide what happens in an episode."""
    return {name: value for name, value in task.items() if name not in _SHOWN}


def load_transcripts(named: Path) -> list[dict[str, Any]]:
    """Read the transcripts of episodes in a file, or in the folder of a run.

    Raises:
        InvalidPolicy: there are none.
    """
    path = transcripts_at(named)
    if path is None:
        raise InvalidPolicy(f"no transcripts at {named}: give a .jsonl that knotgym prompt wrote")
    try:
        found = read_transcripts(path)
    except InvalidFile as error:
        raise InvalidPolicy(str(error)) from error
    if not found or not all("actions" in one for one in found):
        raise InvalidPolicy(f"{path} holds no episodes")
    return found


def _make(config: PolicyConfig) -> Policy:
    path = config.policy.removeprefix(PREFIX)
    return TranscriptPolicy(load_transcripts(Path(path)), path)


def _files(name: str) -> dict[str, Path]:
    path = Path(name.removeprefix(PREFIX))
    return {"transcripts": transcripts_at(path) or path}


FAMILY = PolicyFamily(
    form=f"{PREFIX}FILE",
    matches=lambda name: name.startswith(PREFIX),
    make=_make,
    files=_files,
)
