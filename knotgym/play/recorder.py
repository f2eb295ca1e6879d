"""Record what people pull as a Minari dataset, such as knotgym/tie-nx3/human-v0.

A finished or abandoned episode joins the dataset at once. The episode under way is a journal in the
staging folder beside the dataset, a line for each pull, so that a killed program loses nothing: the
next one finds the journal and stores it as abandoned. An abandoned episode is completed by leaving
the rope alone until the horizon, and is stored as a failure (or a success, if the rope drifts into
its goal).
"""

import json
import os
import shutil
import threading
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import as_json, read_json
from knotgym.common.errors import InvalidFile, printable
from knotgym.control.policy import Choice, UnplannedPolicy
from knotgym.control.rollouts import EVALUATION, episode_seed, rollout
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.episode_writer import EpisodeWriter
from knotgym.datasets.minari_dataset import MinariMetadata, metadata_of, publish
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.digests import digests, sources
from knotgym.runs.staging import has_work, lock_folder, staging_folder
from knotgym.states.state_file import minari_root, ships, states_file

HUMAN = "human"  # name of the policy, which who played may follow
_LONGEST_NAME = 80  # characters of a player's name
_JOURNAL = "journal-{}.jsonl"


class _Played(UnplannedPolicy):
    """Repeats the pulls of one episode, then leaves the rope alone."""

    def __init__(self, actions: list[NDArray[np.float32]], player: str) -> None:
        super().__init__(f"{HUMAN} {player}".strip())
        self._actions = actions

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        step = int(episodes.steps[0])
        if step < len(self._actions):
            return Choice(self._actions[step][None], ["hand"])
        return Choice(np.zeros((1, 6), dtype=np.float32), ["rest"])


class Recorder:
    """Writes the episodes of one task and seed; a context manager that holds the dataset's lock.

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
            dataset_id: Minari id of the dataset, which is continued if it exists.
            player: who plays, in a few words; may be empty.
            root: Minari root; None for Minari's own.

        Raises:
            InvalidFile: the dataset exists and holds other episodes.
        """
        if len(player) > _LONGEST_NAME or not player.isprintable():
            raise InvalidFile(
                f"a player's name is at most {_LONGEST_NAME} printable characters, got"
                f" {printable(player[:_LONGEST_NAME])!r}"
            )
        self._task = replace(
            task,
            observation="both",
            states=task.states if ships(task.states) else dataset_id,
        )
        self._playing, self._seed, self._player = task, seed, player
        self._metadata = MinariMetadata(
            dataset_id=dataset_id,
            algorithm_name=HUMAN,
            description=(
                f"KnotGym, task {task.task} with {task.nx} crossings, {task.split} split, pulled by"
                " hand in `knotgym play`. Abandoned episodes are completed by leaving the rope"
                " alone."
            ),
            digests=digests(sources([], [task])),
        )
        self.folder = (root or minari_root()) / dataset_id
        self._root = root
        self._lock, self._stack = threading.Lock(), ExitStack()
        self._seeds: set[int] = set()
        self._taken: set[int] = set()
        self.recovered = 0
        if os.path.lexists(self.folder):
            self._continue()

    def __enter__(self) -> Self:
        self._staging = staging_folder(self.folder)
        self._stack.enter_context(lock_folder(self._staging))
        for journal in sorted(self._staging.glob("journal-*.jsonl")):
            number, actions = _journalled(journal)
            if actions:
                self.finish(number, actions)
                self.recovered += 1
            journal.unlink(missing_ok=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if not has_work(self._staging):
            shutil.rmtree(self._staging)
        self._stack.close()

    def next_number(self) -> int:
        """Return the number of an episode that is neither recorded nor under way."""
        with self._lock:
            number = 0
            while (
                number in self._taken or episode_seed(self._seed, number, EVALUATION) in self._seeds
            ):
                number += 1
            self._taken.add(number)
            return number

    def journal(self, number: int, actions: list[NDArray[np.float32]]) -> None:
        """Note the pulls of an episode that is under way."""
        path = self._staging / _JOURNAL.format(number)
        content = {"number": number, "actions": [action.tolist() for action in actions]}
        temporary = path.with_suffix(".part")
        temporary.write_text(json.dumps(content), encoding="utf-8")
        os.replace(temporary, path)

    def finish(self, number: int, actions: list[NDArray[np.float32]]) -> bool:
        """Add an episode to the dataset; return whether it reached the goal.

        An episode without pulls isn't stored; its number may then be played later.
        """
        with self._lock:
            self._taken.discard(number)
            if not actions:
                return False
            policy = _Played(actions, self._player)
            played = rollout(self._playing, policy, [number], self._seed, streams=EVALUATION)[0]
            new = self._staging / "new.h5"
            with EpisodeWriter(new, self._task) as writer:
                writer.add(played.episode)
            there = [self.folder] if self.folder.exists() else []
            carried = None if ships(self._playing.states) else states_file(self._playing.states)
            publish(
                [*there, new],
                self._metadata,
                self._root,
                concatenate=True,
                overwrite=bool(there),
                states=carried,
            )
            new.unlink()
            (self._staging / _JOURNAL.format(number)).unlink(missing_ok=True)
            self._seeds.add(self._seed_of(number))
            return played.success

    def _seed_of(self, number: int) -> int:
        return episode_seed(self._seed, number, EVALUATION)

    def _continue(self) -> None:
        reader = EpisodeReader(self.folder)
        stored = metadata_of(self.folder)
        task, seeds = reader.task, [reader.attributes(i).get("seed") for i in range(len(reader))]
        reader.close()
        if stored is None or stored.algorithm_name != HUMAN or task != self._task:
            raise InvalidFile(
                f"{self.folder} isn't a recording of this task with these settings: give another"
                f" --id, or the settings {as_json(task)}"
            )
        self._seeds = {int(seed) for seed in seeds if seed is not None}


def _journalled(path: Path) -> tuple[int, list[NDArray[np.float32]]]:
    """Read the number and the pulls of an episode that a killed program was in.

    Raises:
        InvalidFile: the journal isn't one.
    """
    content: Any = read_json(path)
    try:
        actions = np.array(content["actions"], dtype=np.float32).reshape(-1, 6)
        number = int(content["number"])
        if not np.isfinite(actions).all() or number < 0:
            raise ValueError
    except (TypeError, ValueError, KeyError) as error:
        raise InvalidFile(f"{path} isn't a journal of knotgym play; remove it") from error
    return number, list(np.clip(actions, -1, 1))
