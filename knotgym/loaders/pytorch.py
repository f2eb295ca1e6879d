"""Torch datasets over `Transitions`, pictures and streams. Importing this needs torch."""

import os
from operator import itemgetter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset, IterableDataset

from knotgym.common import Ids, Stream
from knotgym.datasets import read_table
from knotgym.envs import Observer
from knotgym.loaders.data_stream import DataStream
from knotgym.loaders.items import Index, rows_at
from knotgym.loaders.pictures import Pictures
from knotgym.loaders.transitions import Transitions

_SEVERAL = ("pulls", "negatives")  # of one transition


class TransitionDataset(Dataset[dict[str, Any]]):
    """Transitions. An index gives one; a slice, list, array or tensor of indices gives a batch.

    `DataLoader(data, sampler=BatchSampler(RandomSampler(data), 256, False), batch_size=None)` reads
    whole batches at once. Goals of a window are sampled whenever an item is read, from the random
    numbers of torch: `torch.manual_seed`, or the DataLoader's `generator`, makes them reproducible.
    """

    def __init__(self, transitions: Transitions) -> None:
        self.transitions = transitions

    def __len__(self) -> int:
        return len(self.transitions)

    def __getitem__(self, index: Index) -> dict[str, Any]:
        rows = rows_at(index, len(self))
        return self._batch(rows) if rows.ndim else _first(self._batch(rows[None]))

    def _batch(self, index: Ids) -> dict[str, Any]:
        window, rng = self.transitions.window, None
        if window is not None and window.goals is not None:
            # torch seeds every worker, from the DataLoader's own generator
            drawn = int(torch.randint(2**62, ()))
            rng = Stream.SAMPLED_GOALS.generator(window.goals.seed, drawn)
        several = self.transitions.batch(index, rng=rng)
        return {
            name if name in _SEVERAL else name.removesuffix("s"): Observer.map_parts(
                column, _tensor
            )
            for name, column in several.items()
        }


class PictureDataset(Pictures, Dataset[dict[str, Any]]):
    """Pictures with labels, zero-padded to max_nx crossings. An item is a dict of tensors:

        image       uint8 (3, size, size), RGB
        nx          int64 ()
        visits      int64 (2 max_nx,): +k at the over strand of crossing k, -k at its under strand,
                    in the order of the walk
        signs       int64 (max_nx,): +1 for "c", -1 for "a", by crossing number
        crossings   float32 (max_nx, 4): x and y in pixels, positions of the over and the under
                    strand along the rope in beads
        grade       int64 (): index in `knotgym.quality.GRADES`
        accepted    bool ()

    Several items, by a slice, list, array or tensor, have an axis more. The PNGs are kept in memory
    (about 3 kB for a picture of 128 x 128) and shared by forked workers; they are decoded on
    demand. Pictures of one size batch with the default collate function; for several sizes, pass
    your own batch sampler or collate function.

    Attributes:
        max_nx: number of crossings that labels are padded to.
        codes: str (n,), the Gauss codes.
        splits: str (n,).
        labels: name -> tensor (n, ...); all of the above except the images.
    """

    def __init__(
        self, path: str | os.PathLike[str], split: str | None = None, max_nx: int | None = None
    ) -> None:
        """Read a table; see `knotgym.loaders.images`."""
        table = read_table(path, split, columns=self.COLUMNS)
        whole = table if split is None else read_table(path, columns=["nx"])
        most = max([0, *whole["nx"].to_pylist()]) if max_nx is None else max_nx
        super().__init__(table, most)
        self.max_nx = most
        self.labels = {name: torch.from_numpy(column) for name, column in self.labels.items()}

    def __getitem__(self, index: Index) -> dict[str, Any]:
        rows = rows_at(index, len(self))
        batch = self.batch(np.atleast_1d(rows))
        batch["image"] = torch.from_numpy(batch["image"])
        return batch if rows.ndim else _first(batch)


class TorchStream(DataStream, IterableDataset[dict[str, Any]]):
    """A `DataStream` that a DataLoader takes, with `batch_size=None`."""

    def __init__(self, *settings: Any) -> None:
        super().__init__(*settings)
        self._forget()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        # spawned workers get the same memory, copies made by pickle or deepcopy their own
        self._begun = self._shared.share_memory_().numpy()

    def _forget(self) -> None:
        # new memory: a worker of before that starts late still writes into the old one
        self._shared = torch.zeros(1024, dtype=torch.int64)  # more workers than any machine has
        self._begun = self._shared.share_memory_().numpy()


def _first(batch: dict[str, Any]) -> dict[str, Any]:
    return dict(Observer.map_parts(batch, itemgetter(0)))


def _tensor(seen: NDArray[Any]) -> torch.Tensor:
    held = np.ascontiguousarray(seen)
    return torch.from_numpy(held.astype(np.float32) if held.dtype == np.float64 else held)
