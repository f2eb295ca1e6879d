"""Torch datasets over `Transitions`, one class per kind of item. Importing this needs torch."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from knotgym.common.streams import Stream, generator
from knotgym.loaders.transitions import Transitions

_ONE = {
    name: name.removesuffix("s")
    for name in (
        *("observations", "actions", "rewards", "next_observations", "terminals", "timeouts"),
        "discounts",
    )
}


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
        row = self._batch([_checked(int(index), len(self))])
        return {name: _at(column, 0) for name, column in row.items()}

    def _batch(self, index: Sequence[int]) -> dict[str, Any]:
        window, rng = self.transitions.window, None
        if window is not None and window.goals is not None:
            # torch seeds every worker, from the DataLoader's own generator
            drawn = int(torch.randint(2**62, ()))
            rng = generator(Stream.SAMPLED_GOALS, window.goals.seed, drawn)
        several = self.transitions.batch(index, rng=rng)
        return {_ONE.get(name, name): _tensor(column) for name, column in several.items()}


class TorchEpisodes(Dataset[dict[str, Any]]):
    """Whole episodes."""

    def __init__(self, transitions: Transitions) -> None:
        self.transitions = transitions

    def __len__(self) -> int:
        return self.transitions.segments

    def __getitem__(self, index: int) -> dict[str, Any]:
        segment = _checked(index, len(self))
        own = slice(*self.transitions.starts[segment : segment + 2])
        names = ("actions", "rewards", "terminals", "timeouts")
        columns = {name: getattr(self.transitions, name)[own].copy() for name in names}
        seen = self.transitions.observations(segment)
        return {name: _tensor(one) for name, one in {"observations": seen, **columns}.items()}


class FrameDataset(Dataset[dict[str, Any]]):
    """Single states with their Gauss codes."""

    def __init__(self, transitions: Transitions) -> None:
        self.transitions = transitions

    def __len__(self) -> int:
        return len(self.transitions) + self.transitions.segments

    def __getitem__(self, index: int) -> dict[str, Any]:
        frame = _checked(index, len(self))
        segment, step = self.transitions.frame_place(frame)
        code = self.transitions.codes(segment)[step]
        return {
            "observation": _tensor(_at(self.transitions.observations(segment, step, step + 1), 0)),
            "gauss_code": code,
            "crossings": (code.count(",") + 1) // 2 if code else 0,
            "episode": segment,
            "step": step,
        }


KINDS = {"transitions": TransitionDataset, "episodes": TorchEpisodes, "frames": FrameDataset}


def _checked(index: int, length: int) -> int:
    if not -length <= index < length:
        raise IndexError(f"index {index} is outside a dataset of {length}")
    return index % length


def _at(seen: Any, row: int) -> Any:
    if isinstance(seen, dict):
        return {name: array[row] for name, array in seen.items()}
    return seen[row]


def _tensor(seen: Any) -> Any:
    if isinstance(seen, dict):
        return {name: _tensor(array) for name, array in seen.items()}
    held = np.ascontiguousarray(seen)
    return torch.from_numpy(held.astype(np.float32) if held.dtype == np.float64 else held)
