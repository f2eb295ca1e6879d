"""Replay the actions of transcripts in the episodes that they were recorded in.

`knotgym.control.policies` finds the names `prompt:FILE` through the entry point `prompt`.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import as_json, differences
from knotgym.common.errors import InvalidFile, InvalidPolicy
from knotgym.control.basic_policies import ActionPlayer, Generators
from knotgym.control.policies import PolicyFamily
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import Ids, Policy
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.prompting.transcripts import read_transcripts, transcripts_at

PREFIX = "prompt:"  # of a policy's name; the path of transcripts follows

# settings of a task that change how an episode is shown but not what happens in it
_SHOWN = ("observation", "image_size", "views", "depth", "camera", "renderer")


class TranscriptPolicy:
    """Repeats the actions of transcripts, in the episodes of the same seeds.

    Attributes:
        name: of the policy.
        transcripts: of episodes, by the seed of the episode.
    """

    def __init__(self, transcripts: Sequence[Mapping[str, Any]], name: str) -> None:
        self.name, self.transcripts = name, {one["seed"]: one for one in transcripts}

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """Return the task; raise InvalidPolicy if the transcripts are of another one."""
        here = {**as_json(task), **dict.fromkeys(_SHOWN)}
        for one in self.transcripts.values():
            there = {**one["config"]["task"], **dict.fromkeys(_SHOWN)}
            self._require_same(
                f"--{name.replace('_', '-', 1)}" for name in differences(there, here)
            )
        return task

    def player(self, batch: EpisodeBatch) -> ActionPlayer:
        """Return a player; its `begin` raises InvalidPolicy where there is no transcript."""
        return _TranscriptPlayer(self, batch)

    def actions(self, seed: int, start: int, goal: int) -> NDArray[np.float32]:
        """Return the actions of an episode, float32 (T, 6)."""
        one = self.transcripts.get(seed)
        if one is None:
            count = len(self.transcripts)
            own = next(iter(self.transcripts.values()))["config"].get("seed")
            raise InvalidPolicy(
                f"{self.name} holds {count} episodes of seed {own}, but not this one: use"
                f" --episodes {count} --seed {own}"
            )
        self._require_same(differences(dict(one), {**one, "start": start, "goal": goal}))
        return np.array(one["actions"], dtype=np.float32).reshape(-1, 6)

    def _require_same(self, changed: Iterable[str]) -> None:
        if found := "; ".join(changed):
            raise InvalidPolicy(f"{self.name} was recorded in another task: {found}")


class _TranscriptPlayer(ActionPlayer):
    def __init__(self, policy: TranscriptPolicy, batch: EpisodeBatch) -> None:
        super().__init__(batch, policy.name)
        self._policy = policy
        # an episode that goes on past its transcript is pulled without force, and differs
        self._actions = np.zeros((batch.count, batch.task.horizon, 6), dtype=np.float32)

    def begin(self, ids: Ids, rngs: Generators) -> None:
        super().begin(ids, rngs)
        columns = self.batch.seed, self.batch.start_row, self.batch.goal_row
        for index in ids.tolist():
            actions = self._policy.actions(*(int(one[index]) for one in columns))
            self._actions[index] = 0
            self._actions[index, : len(actions)] = actions[: len(self._actions[index])]

    def choose(self, ids: Ids) -> NDArray[np.float32]:
        actions: NDArray[np.float32] = self._actions[ids, self.batch.steps[ids]]
        return actions


def _make(config: PolicyConfig) -> Policy:
    path = Path(config.policy.removeprefix(PREFIX))
    named = transcripts_at(path)
    if named is None:
        raise InvalidPolicy(f"no transcripts at {path}: give a .jsonl that knotgym prompt wrote")
    try:
        found = read_transcripts(named)
    except InvalidFile as error:
        raise InvalidPolicy(str(error)) from error
    if not all("actions" in one for one in found):
        raise InvalidPolicy(f"{named} holds no episodes")
    return TranscriptPolicy(found, config.policy)


def _files(name: str) -> dict[str, Path]:
    path = Path(name.removeprefix(PREFIX))
    return {"transcripts": transcripts_at(path) or path}


FAMILY = PolicyFamily(
    form=f"{PREFIX}FILE",
    matches=lambda name: name.startswith(PREFIX),
    make=_make,
    files=_files,
)
