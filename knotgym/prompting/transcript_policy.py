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
from knotgym.control.policies import PolicyFamily
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import Player, Policy, Pulls
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
    """

    def __init__(self, transcripts: Sequence[Mapping[str, Any]], name: str) -> None:
        self.name, self._transcripts = PREFIX + name, {one["seed"]: one for one in transcripts}

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """Return the task; raise InvalidPolicy if the transcripts are of another one."""
        here = _episode_settings(as_json(task))
        for one in self._transcripts.values():
            there = _episode_settings(one["config"]["task"])
            changed = [f"--{one.replace('_', '-', 1)}" for one in differences(there, here)]
            if changed:
                raise InvalidPolicy(
                    f"{self.name} was recorded in another task: {'; '.join(changed)}"
                )
        return task

    def player(self, batch: EpisodeBatch) -> Player:
        """Return a player; its `begin` raises InvalidPolicy where there is no transcript."""
        return _TranscriptPlayer(self, batch)

    def actions(self, seed: int, start: int, goal: int) -> NDArray[np.float32]:
        """Return the actions of an episode, float32 (T, 6)."""
        one = self._transcripts.get(seed)
        if one is None:
            count = len(self._transcripts)
            own = next(iter(self._transcripts.values()))["config"]["seed"]
            raise InvalidPolicy(
                f"{self.name} holds {count} episodes of seed {own}, but not this one: use"
                f" --episodes {count} --seed {own}"
            )
        if found := list(differences(dict(one), {**one, "start": start, "goal": goal})):
            raise InvalidPolicy(f"{self.name} was recorded in another task: {'; '.join(found)}")
        return np.array(one["actions"], dtype=np.float32).reshape(-1, 6)


class _TranscriptPlayer:
    def __init__(self, policy: TranscriptPolicy, batch: EpisodeBatch) -> None:
        self._policy, self._batch = policy, batch
        self._actions: dict[int, NDArray[np.float32]] = {}
        self.planned = np.zeros(batch.count, dtype=np.int64)

    def begin(self, ids: NDArray[np.int64], rngs: Sequence[np.random.Generator]) -> None:
        columns = self._batch.seed, self._batch.start_row, self._batch.goal_row
        for index in ids.tolist():
            self._actions[index] = self._policy.actions(*(int(one[index]) for one in columns))

    def act(self, ids: NDArray[np.int64]) -> Pulls:
        # an episode that goes on past its transcript is pulled without force, and differs
        none = np.zeros(6, dtype=np.float32)
        actions = np.array(
            [
                self._actions[k][step] if step < len(self._actions[k]) else none
                for k, step in zip(ids.tolist(), self._batch.steps[ids].tolist(), strict=True)
            ]
        )
        beads, _ = self._batch.simulation.read_actions(actions, ids)
        return Pulls(ids, beads, actions[:, 3:])


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
