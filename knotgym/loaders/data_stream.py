"""Data without end and without a file: batches of episodes or pictures that are made as needed.

    block k     episodes k n to (k + 1) n - 1 of the run, those that `knotgym collect` would write;
                or n pictures of split train, as `knotgym images` makes them, from (seed, k)
    batch k     some rows of one block, in an order drawn from the seed

`shuffled` blocks take turns, and each gives `repeats` batches. So these blocks are the shuffle
buffer, and batch k depends on nothing but the configuration, the seed and k. Any number of workers,
each of which takes every so manieth batch, gives the same batches in the same order, and a stream
goes on from its place alone: from a number.

    pass p      what one `iter` gives: batches p n to (p + 1) n - 1 for a pass of n, read to its end
                or not; without a size, those from the first not yet given on, without end

Workers are copies of the stream, and torch says nothing to them when a pass begins. So they write
the passes that they have begun into memory that all copies share, from which the next ones start.
"""

from __future__ import annotations

import dataclasses
import logging
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from knotgym.common import InvalidInput, Stream, as_json, differences
from knotgym.datasets import EpisodeDataset, Episodes
from knotgym.envs import TaskConfig
from knotgym.loaders.pictures import Pictures
from knotgym.loaders.transitions import Opening, Transitions

_SILENT = 2.0  # seconds after which a stream says what its first batch waits for
_log = logging.getLogger(__name__)


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
        number: the next batch, of that many ranks as there are.
    """

    def __init__(
        self,
        config: Played | Pictured,
        seed: int | None,
        batch: int,
        block: int,
        shuffled: int,
        repeats: int,
        batches: int | None,
        opening: Opening,
    ) -> None:
        sizes = {"batch": batch, "block": block, "shuffled": shuffled, "repeats": repeats}
        for name, size in [*sizes.items(), ("batches", 1 if batches is None else batches)]:
            if not isinstance(size, (int, np.integer)) or size < 1:
                raise InvalidInput(f"{name} must be a whole number above 0, got {size}")
        self._pictured = hasattr(config, "pictured")
        if not self._pictured and not hasattr(config, "played"):
            raise InvalidInput(f"streams are of a CollectConfig or an ImagesConfig, got {config!r}")
        if self._pictured and opening:
            raise InvalidInput(f"a stream of pictures takes no {', '.join(opening)}")
        self._config, self._opening = config, opening
        # whether the next `iter` goes on in this pass; and whether `number` is one worker's alone
        self.number, self._pass, self._goes_on, self._own = 0, 0, True, False
        self._ranks, self._begun = (0, 1), np.zeros(0, dtype=np.int64)
        self._seed = int(getattr(config, "seed", 0) if seed is None else seed)
        # what must be the same where a stream goes on: other batches would repeat rows or skip them
        settings: dict[str, Any] = as_json(config) if dataclasses.is_dataclass(config) else {}
        sizes = {name: int(size) for name, size in sizes.items()}
        self._length = None if batches is None else int(batches)
        self._made = {**settings, "seed": self._seed, **sizes, "batches": self._length}
        self._batch, self._size, self._shuffled, self._repeats = sizes.values()
        self._held = dict[int, Transitions | Pictures]()
        self._batch_of(0)  # refuses what can't be opened before a worker does

    def __getstate__(self) -> dict[str, Any]:
        # another process makes its own blocks; one that is spawned knows nothing of ranks
        return {**vars(self), "_held": {}, "_ranks": self._spread()}

    def _batch_of(self, number: int) -> dict[str, Any]:
        """Return one batch, as `Transitions.batch` does, whatever was returned before."""
        turn, place = divmod(number, self._shuffled * self._repeats)
        part, offset = divmod(place, self._shuffled)
        block = turn * self._shuffled + offset
        rows = self._block(block)
        order = Stream.STREAM_ORDER.generator(self._seed, block).permutation(len(rows))
        # a block that has too few rows gives them again, in the same order
        drawn = np.resize(order, self._repeats * self._batch)[part * self._batch :][: self._batch]
        return rows.batch(drawn, rng=Stream.SAMPLED_GOALS.generator(self._seed, number))

    def _block(self, number: int) -> Transitions | Pictures:
        if number in self._held:
            return self._held[number]
        what = "pictures" if self._pictured else "episodes"
        said = "a stream makes its first block, %d %s, before it gives a batch"
        waits = threading.Timer(_SILENT, _log.warning, (said, self._size, what))
        waits.daemon = True
        if not self._held:
            waits.start()
        try:
            made = self._pictures(number) if self._pictured else self._transitions(number)
        finally:
            waits.cancel()
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

    def __len__(self) -> int:
        """Return the batches of a pass, for each rank."""
        if self._length is None:
            raise TypeError("a stream has no length unless it is given batches=")
        return self._length // self._spread()[1]

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Begin a pass; in a DataLoader's worker its share of one.

        Raises:
            InvalidInput: workers have read passes without a size, or ranks can't share them evenly.
        """
        # a worker is counted at once, because it may be asked for nothing
        return self._given(self._begin() if _worker() else None)

    def _given(self, end: float | None) -> Iterator[dict[str, Any]]:
        end, worker, (rank, ranks) = end or self._begin(), _worker(), self._spread()
        step = ranks * (worker.num_workers if worker else 1)
        while self.number < end:
            number = self.number
            # counted before it is given: who asks for the state then goes on with the next one
            self.number += step
            yield self._batch_of(number + rank)
        if not worker and self.number == end:
            self._pass, self._goes_on = self._pass + 1, True

    def _begin(self) -> float:
        """Begin a pass, or go on in one; return its end."""
        worker, size, ranks = _worker(), self._length, self._spread()[1]
        number, is_own = self._next_pass(worker), worker is not None and self._own
        if not (self._goes_on and number == self._pass) and not is_own:
            if size is not None:
                self.number = number * size
            elif self._begun.any():
                raise InvalidInput(_UNKNOWN)
        self._pass, self._own = number, False
        self._goes_on = size is None and worker is None
        if worker is None:
            self._forget()
        else:
            self.number += 0 if is_own else ranks * worker.id
            self._begun[worker.id] = _key(worker) << 32 | number + 1
        if size is None:
            return float("inf")
        end = (number + 1) * size
        if (end - self.number) % ranks and not is_own:
            raise InvalidInput(f"{ranks} ranks can't share {size} batches of a pass evenly")
        return end

    def _next_pass(self, worker: Any) -> int:
        """Return the number of the pass that begins, or in which this process goes on."""
        begun = self._begun.copy()  # at once: the other workers write into it meanwhile
        passes = begun & (1 << 32) - 1
        if worker is not None and self._own:
            return self._pass
        if worker is not None:
            # those of one loader have the same seed; each of them begins a pass once
            same = passes[(begun >> 32 == _key(worker)) & (begun != 0)].max(initial=0)
            if same and begun[worker.id] != _key(worker) << 32 | same:
                return int(same) - 1
        if begun.any():
            return int(passes.max())
        return self._pass + (not self._goes_on)

    def _spread(self) -> tuple[int, int]:
        """Return the rank of the training process, and of how many."""
        spread: Any = getattr(sys.modules.get("torch"), "distributed", None)
        if spread is not None and spread.is_available() and spread.is_initialized():
            return spread.get_rank(), spread.get_world_size()
        return self._ranks

    def state_dict(self) -> dict[str, Any]:
        """Return where the stream is, for `load_state_dict` of one made alike.

        Raises:
            InvalidInput: only workers know.
        """
        number, pass_ = self.number, self._pass
        if _worker() is None and self._begun.any():
            if self._length is None:
                raise InvalidInput(_UNKNOWN)
            pass_ = self._next_pass(None)
            number = pass_ * self._length
        return {"number": number, "pass": pass_, "made": self._made}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where another stream was, with the rest of its pass; before a loader reads it.

        Raises:
            InvalidInput: the other one had another seed, configuration or size, or it's no state.
        """
        if not isinstance(state, dict) or state.keys() | {"pass"} != {"number", "pass", "made"}:
            raise InvalidInput(f"the state of a stream has number, pass and made, got {state!r}")
        # before there were passes, a rank counted its own batches
        number = int(state["number"])
        number -= 0 if "pass" in state else number % self._spread()[1]
        if other := next(differences({"batches": None, **state["made"]}, self._made), None):
            raise InvalidInput(f"this stream is another one: {other}")
        self.number, self._pass, self._goes_on = number, int(state.get("pass", 0)), True
        self._own = _worker() is not None
        if not self._own:
            self._forget()

    def _forget(self) -> None:
        """Forget the passes that workers have begun."""


_UNKNOWN = (
    "how far workers have read passes without end isn't known: give passes a size, such as"
    " stream(..., batches=1000), or keep one iterator; torchdata's StatefulDataLoader has the state"
)


def _worker() -> Any:
    """Return what torch says of this DataLoader's worker; None in the training process."""
    torch: Any = sys.modules.get("torch")
    return None if torch is None else torch.utils.data.get_worker_info()


def _key(worker: Any) -> int:
    """Return what the workers of one iterator have in common."""
    return int(worker.seed - worker.id) % (1 << 31)
