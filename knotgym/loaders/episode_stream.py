"""Transitions of episodes that are played as they are needed, without end and without a file.

    block k     episodes k n to (k + 1) n - 1 of the run, those that `knotgym collect` would write
    batch k     `batch` of the transitions of block k, drawn from a generator of (seed, k)

Batch k depends on nothing but the configuration, the seed and k. So any number of workers, each of
which takes every so manieth batch, gives the same batches in the same order, and a stream goes on
from its place alone.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

from knotgym.common import InvalidInput, Stream
from knotgym.datasets import EpisodeDataset, Episodes
from knotgym.envs import TaskConfig
from knotgym.loaders.transitions import Opening, Transitions


class Played(Protocol):
    """Episodes by their numbers, such as a `generate.CollectConfig`."""

    @property
    def task(self) -> TaskConfig:
        """The environment of the episodes."""

    def played(self, numbers: range, seed: int) -> Episodes:
        """Play episodes; each depends on its number and the seed alone."""


class EpisodeStream:
    """Batches of transitions without end, see `stream`.

    Attributes:
        number: the next batch of this process.
    """

    def __init__(
        self, config: Played, seed: int, batch: int, episodes: int, opening: Opening
    ) -> None:
        if min(batch, episodes) < 1:
            raise InvalidInput(f"batch and episodes must be at least 1, got {batch} and {episodes}")
        self._config, self._seed, self._batch, self._episodes = config, seed, batch, episodes
        self._opening, self.number = opening, 0
        self.batch_of(0)  # refuses what can't be opened before a worker does

    def batch_of(self, number: int) -> dict[str, Any]:
        """Return one batch, as `Transitions.batch` does, whatever was returned before."""
        first = number * self._episodes
        block = self._config.played(range(first, first + self._episodes), self._seed)
        dataset = EpisodeDataset(Path(f"block {number}"), block, self._config.task, {})
        transitions = Transitions(dataset, **self._opening)
        if not len(transitions):
            raise InvalidInput(
                f"episodes {first} to {first + self._episodes - 1} have no such transitions: play"
                " more of them for a batch"
            )
        rng = Stream.SAMPLED_GOALS.generator(self._seed, number)
        # with replacement only where a block has too few
        few = len(transitions) < self._batch
        rows = rng.choice(len(transitions), self._batch, replace=few)
        return transitions.batch(rows, rng=rng)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Go on with the next batch; in a DataLoader's worker with its share of them."""
        share, shares = _share()
        number = self.number + (share - self.number) % shares
        while True:
            # counted before it is given: who asks for the state then goes on with the next one
            self.number = number + shares
            yield self.batch_of(number)
            number = self.number

    def state_dict(self) -> dict[str, Any]:
        """Return where the stream is, for `load_state_dict` of one made alike."""
        return {"number": self.number, "seed": self._seed}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where another stream was.

        Raises:
            InvalidInput: the other one had another seed.
        """
        if state["seed"] != self._seed:
            raise InvalidInput(f"the stream had seed {state['seed']}, this one has {self._seed}")
        self.number = int(state["number"])


def _share() -> tuple[int, int]:
    """Return which share of the batches is this process's, and of how many: rank and worker."""
    torch: Any = sys.modules.get("torch")
    if torch is None:
        return 0, 1
    worker = torch.utils.data.get_worker_info()
    ranks = torch.distributed.is_available() and torch.distributed.is_initialized()
    rank, many = (
        (torch.distributed.get_rank(), torch.distributed.get_world_size()) if ranks else (0, 1)
    )
    own, workers = (worker.id, worker.num_workers) if worker else (0, 1)
    return rank + many * own, many * workers
