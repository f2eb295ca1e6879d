"""Torch datasets over `Transitions` and streams. Importing this needs torch."""

from collections.abc import Sequence
from operator import itemgetter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset, IterableDataset

from knotgym.common import Stream
from knotgym.envs import each
from knotgym.loaders.episode_stream import EpisodeStream
from knotgym.loaders.transitions import Transitions

_SEVERAL = ("pulls", "negatives")  # of one transition


class TransitionDataset(Dataset[dict[str, Any]]):
    """Transitions. An index gives one, a list of indices gives a batch.

    `DataLoader(data, sampler=BatchSampler(RandomSampler(data), 256, False), batch_size=None)` reads
    whole batches at once. Goals of a window are sampled whenever an item is read, from the random
    numbers of torch: `torch.manual_seed`, or the DataLoader's `generator`, makes them reproducible.
    """

    def __init__(self, transitions: Transitions) -> None:
        self.transitions = transitions

    def __len__(self) -> int:
        return len(self.transitions)

    def __getitem__(self, index: int | Sequence[int]) -> dict[str, Any]:
        if not isinstance(index, (int, np.integer)):
            return self._batch(index)
        return each(self._batch([index]), itemgetter(0))

    def _batch(self, index: Sequence[int]) -> dict[str, Any]:
        window, rng = self.transitions.window, None
        if window is not None and window.goals is not None:
            # torch seeds every worker, from the DataLoader's own generator
            drawn = int(torch.randint(2**62, ()))
            rng = Stream.SAMPLED_GOALS.generator(window.goals.seed, drawn)
        several = self.transitions.batch(index, rng=rng)
        return {
            name if name in _SEVERAL else name.removesuffix("s"): each(column, _tensor)
            for name, column in several.items()
        }


class TorchStream(EpisodeStream, IterableDataset[dict[str, Any]]):
    """An `EpisodeStream` that a DataLoader takes, with `batch_size=None`."""


def _tensor(seen: NDArray[Any]) -> torch.Tensor:
    held = np.ascontiguousarray(seen)
    return torch.from_numpy(held.astype(np.float32) if held.dtype == np.float64 else held)
