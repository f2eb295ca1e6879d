"""Data without end and without a file: batches of episodes or pictures that are made as needed.

    block k     episodes k n to (k + 1) n - 1 of the run, those that `knotgym collect` would write;
                or n pictures of split train, as `knotgym images` makes them, from (seed, k)
    batch k     some rows of one block, in an order drawn from the seed

`shuffled` blocks take turns, and each gives `repeats` batches. So these blocks are the shuffle
buffer, and batch k depends on nothing but the configuration, the seed and k. Any number of workers,
each of which takes every so manieth batch, gives the same batches in the same order, and a stream
goes on from its place alone: from a number.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from knotgym.common import InvalidInput, Stream, as_json, differences
from knotgym.datasets import EpisodeDataset, Episodes
from knotgym.envs import TaskConfig
from knotgym.loaders.pictures import Pictures
from knotgym.loaders.transitions import Opening, Transitions


class Played(Protocol):
    """Episodes by their numbers, such as a `generate.CollectConfig`."""

    @property
    def task(self) -> TaskConfig:
        """The environment of the episodes."""

    def played(self, numbers: range, seed: int) -> Episodes:
        """Play episodes; each depends on its number and the seed alone."""


class Pictured(Protocol):
    """Pictures by block, such as a `generate.ImagesConfig`."""

    @property
    def trained(self) -> tuple[int, ...]:
        """Their numbers of crossings."""

    def pictured(self, number: int, count: int, seed: int) -> Any:
        """Make a block of pictures, a pyarrow.Table, from its number and the seed alone."""


class DataStream:
    """Batches without end, see `stream`.

    Attributes:
        number: the next batch of this process.
    """

    def __init__(
        self,
        config: Played | Pictured,
        seed: int | None,
        batch: int,
        block: int,
        shuffled: int,
        repeats: int,
        opening: Opening,
    ) -> None:
        sizes = {"batch": batch, "block": block, "shuffled": shuffled, "repeats": repeats}
        for name, size in sizes.items():
            if not isinstance(size, (int, np.integer)) or size < 1:
                raise InvalidInput(f"{name} must be a whole number above 0, got {size}")
        self._pictured = hasattr(config, "pictured")
        if not self._pictured and not hasattr(config, "played"):
            raise InvalidInput(f"streams are of a CollectConfig or an ImagesConfig, got {config!r}")
        if self._pictured and opening:
            raise InvalidInput(f"a stream of pictures takes no {', '.join(opening)}")
        self._config, self._opening, self.number = config, opening, 0
        self._seed = int(getattr(config, "seed", 0) if seed is None else seed)
        # what must be the same where a stream goes on: other batches would repeat rows or skip them
        settings: dict[str, Any] = as_json(config) if dataclasses.is_dataclass(config) else {}
        sizes = {name: int(size) for name, size in sizes.items()}
        self._made = {**settings, "seed": self._seed, **sizes}
        self._batch, self._size, self._shuffled, self._repeats = sizes.values()
        self._held = dict[int, Transitions | Pictures]()
        self._batch_of(0)  # refuses what can't be opened before a worker does

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_held": {}}  # another process makes its own blocks

    def _batch_of(self, number: int) -> dict[str, Any]:
        """Return one batch, as `Transitions.batch` does, whatever was returned before."""
        turn, place = divmod(number, self._shuffled * self._repeats)
        part, one = divmod(place, self._shuffled)
        block = turn * self._shuffled + one
        rows = self._block(block)
        order = Stream.STREAM_ORDER.generator(self._seed, block).permutation(len(rows))
        # a block that has too few rows gives them again, in the same order
        drawn = np.resize(order, self._repeats * self._batch)[part * self._batch :][: self._batch]
        return rows.batch(drawn, rng=Stream.SAMPLED_GOALS.generator(self._seed, number))

    def _block(self, number: int) -> Transitions | Pictures:
        if number in self._held:
            return self._held[number]
        made = self._pictures(number) if self._pictured else self._transitions(number)
        # those of an earlier turn won't come again
        first = number - number % self._shuffled
        self._held = {old: rows for old, rows in self._held.items() if old >= first}
        self._held[number] = made
        return made

    def _pictures(self, number: int) -> Pictures:
        config = cast(Pictured, self._config)
        return Pictures(config.pictured(number, self._size, self._seed), max(config.trained))

    def _transitions(self, number: int) -> Transitions:
        config, first = cast(Played, self._config), number * self._size
        block = config.played(range(first, first + self._size), self._seed)
        dataset = EpisodeDataset(Path(f"block {number}"), block, config.task, {})
        transitions = Transitions(dataset, **self._opening)
        if not len(transitions):
            which = f"episodes {first} to {first + self._size - 1}"
            raise InvalidInput(f"{which} have no such transitions: make the block larger")
        return transitions

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Go on with the next batch; in a DataLoader's worker with its share of them."""
        share, shares = _share()
        number = self.number + (share - self.number) % shares
        while True:
            # counted before it is given: who asks for the state then goes on with the next one
            self.number = number + shares
            yield self._batch_of(number)
            number = self.number

    def state_dict(self) -> dict[str, Any]:
        """Return where the stream is, for `load_state_dict` of one made alike."""
        return {"number": self.number, "made": self._made}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where another stream was.

        Raises:
            InvalidInput: the other one had another seed, configuration or size, or it's no state.
        """
        if not isinstance(state, dict) or state.keys() != self.state_dict().keys():
            raise InvalidInput(f"the state of a stream has number and made, got {state!r}")
        if other := next(differences(state["made"], self._made), None):
            raise InvalidInput(f"this stream is another one: {other}")
        self.number = int(state["number"])


def _share() -> tuple[int, int]:
    """Return which share of the batches is this process's, and of how many: rank and worker."""
    torch: Any = sys.modules.get("torch")
    if torch is None:
        return 0, 1
    worker = torch.utils.data.get_worker_info()
    ranks = torch.distributed.is_available() and torch.distributed.is_initialized()
    spread = torch.distributed
    rank, many = (spread.get_rank(), spread.get_world_size()) if ranks else (0, 1)
    own, workers = (worker.id, worker.num_workers) if worker else (0, 1)
    return rank + many * own, many * workers
