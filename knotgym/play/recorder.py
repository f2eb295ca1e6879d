"""Record what people pull as a dataset, such as knotgym/tie-nx3/human-v0.

A finished or abandoned episode joins the dataset at once. The pulls of the episode under way are in
the journal of a run, in the staging folder beside the dataset, so that a killed program loses
nothing: the next one finds them and stores the episode as abandoned. The journal names all that a
replay needs, the task, the seed, the states and who played, and a session with others is refused.

An abandoned episode is completed by leaving the rope alone until the horizon, and is stored as a
failure (or a success, if the rope drifts into its goal). An episode in which a policy pulled is
never stored.
"""

import os
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidFile, InvalidInput, Stream, as_json, differences, one_line, sha256
from knotgym.control import replay
from knotgym.datasets import EpisodeDataset, Episodes, MinariMetadata, open_episodes, publish
from knotgym.envs import TaskConfig
from knotgym.play.session import HandPull
from knotgym.rope import ENGINES
from knotgym.runs import RunOptions, identity, staged
from knotgym.states import is_bundled, minari_root, resolve_states

HUMAN = "human"  # name of the policy, which who played may follow
_LONGEST_NAME = 80  # characters of a player's name
_KEY = "episode "  # before the number of an episode in the journal
_STREAM = Stream.EVALUATION_EPISODE  # episodes are those that `evaluate` plays


class Recorder:
    """Writes the episodes of one task and seed; a context manager that holds the journal's lock.

    Attributes:
        folder: of the dataset.
        recovered: episodes of a killed program that were found and stored.
    """

    def __init__(
        self,
        task: TaskConfig,
        seed: int,
        dataset_id: str,
        player: str = "",
        root: Path | None = None,
    ) -> None:
        """Prepare the recording.

        Args:
            task: the environment; `both` observations are stored.
            seed: of the run, from which starts and goals follow.
            dataset_id: id of the dataset, which is continued if it exists.
            player: who plays, in a few words; may be empty.
            root: folder of datasets; None for Minari's own.

        Raises:
            InvalidInput: the name isn't one.
            InvalidFile: the dataset exists and holds other episodes.
        """
        if len(player) > _LONGEST_NAME or not player.isprintable():
            raise InvalidInput(
                f"a player's name is at most {_LONGEST_NAME} printable characters, got"
                f" {one_line(player[:_LONGEST_NAME])!r}"
            )
        self._task, self._seed, self._root = replace(task, observation="both"), seed, root
        self._policy = f"{HUMAN} {player}".strip()
        self._metadata = MinariMetadata(
            dataset_id=dataset_id,
            algorithm_name=HUMAN,
            description=(
                f"KnotGym, task {task.task} with {task.nx} crossings, {task.split} split, pulled by"
                " hand in `knotgym play`. Abandoned episodes are completed by leaving the rope"
                " alone."
            ),
        )
        self.folder = (root or minari_root()) / dataset_id
        self._lock, self._stack = threading.Lock(), ExitStack()
        self._taken: set[int] = set()
        self.recovered = 0

    def __enter__(self) -> Self:
        self._states = _content(self._task)
        self._seeds = self._stored_seeds()
        run = {"task": as_json(self._task), "seed": self._seed, "player": self._policy}
        whole = identity(self._task, fields={**run, "dataset_id": self._metadata.dataset_id})
        staging = staged(self.folder, whole, RunOptions(resume=True))
        _, self._journal = self._stack.enter_context(staging)
        for key in [*self._journal]:
            number, columns = int(key.removeprefix(_KEY)), self._journal[key]
            rows = zip(*columns.values(), strict=True)
            pulls = [HandPull(int(bead), force, bool(helped)) for bead, force, helped in rows]
            # it may have been stored just before the program was killed
            stored = self._seed_of(number) in self._seeds
            self.recovered += self.finish(number, [] if stored else pulls)
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def next_number(self) -> int:
        """Return the number of an episode that is neither recorded nor under way."""
        with self._lock:
            number = 0
            while number in self._taken or self._seed_of(number) in self._seeds:
                number += 1
            self._taken.add(number)
            return number

    def note(self, number: int, pulls: Sequence[HandPull]) -> None:
        """Note the pulls of an episode that is under way; without any it is forgotten."""
        with self._lock:
            if not pulls:
                del self._journal[f"{_KEY}{number}"]
                return
            self._journal[f"{_KEY}{number}"] = _columns(pulls)

    def finish(self, number: int, pulls: Sequence[HandPull]) -> bool:
        """Add an episode to the dataset; return whether it was stored.

        An episode without pulls, or with a policy's, isn't stored; it may be played later.
        """
        stored = bool(pulls) and not any(pull.helped for pull in pulls)
        if stored:
            # with the last pull, in case the dataset can't be written now
            self.note(number, pulls)
            with self._lock:
                self._store(number, pulls)
        self.note(number, [])
        self._taken.discard(number)
        return stored

    def _store(self, number: int, pulls: Sequence[HandPull]) -> None:
        columns = _columns(pulls)
        del columns["helped"]
        if _content(self._task) != self._states:
            raise InvalidFile(f"{self._task.states} changed since the session began; put it back")
        whole = Episodes.to_repeat(np.array([len(pulls)]), columns, self._policy)
        played = replay(whole, self._task, [self._seed_of(number)])
        there = [open_episodes(self.folder).episodes] if self.folder.exists() else []
        named, about, root = self._task.states, self._metadata, self._root
        states, replaces = None if is_bundled(named) else resolve_states(named), bool(there)
        publish([*there, played], self._task, about, root, states=states, overwrite=replaces)
        self._seeds.add(self._seed_of(number))

    def _seed_of(self, number: int) -> int:
        return _STREAM.derived_seed(self._seed, number)

    def _stored_seeds(self) -> set[int]:
        """Return the seeds of the episodes in the dataset, if there is one to continue."""
        if not os.path.lexists(self.folder):
            return set()
        stored: EpisodeDataset = open_episodes(self.folder)
        named, settings = as_json(stored.task), as_json(self._task)
        # a file of states has another name in each of them
        named["states"], settings["states"] = _content(stored.found_task), self._states
        if (stored.metadata or {}).get("algorithm_name") != HUMAN or named != settings:
            unlike = "; ".join(differences(named, settings))
            raise InvalidFile(
                f"{self.folder} isn't a recording of this task with these settings: give another"
                f" --id, or the settings that it has ({unlike or 'nobody pulled by hand'})"
            )
        if unlike := ENGINES[self._task.engine].unlike(stored.attributes.get("engine")):
            raise InvalidFile(f"{self.folder} was recorded in {unlike}; give another --id")
        return set(stored.episodes.episodes["seed"].tolist())


def _content(task: TaskConfig) -> str:
    """Return the digest of the states that a task draws from."""
    return sha256(resolve_states(task.states))


def _columns(pulls: Sequence[HandPull]) -> dict[str, NDArray[Any]]:
    return {
        "bead": np.array([pull.bead for pull in pulls], dtype=np.int64),
        "force": np.array([pull.force for pull in pulls], np.float32).reshape(-1, 3),
        "helped": np.array([pull.helped for pull in pulls], dtype=bool),
    }
