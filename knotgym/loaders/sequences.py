"""Stretches of consecutive states, straight from the columns, for models of sequences."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Ids, InvalidInput
from knotgym.datasets import columns_of
from knotgym.loaders.items import Index, rows_at


class Sequences:
    """Every stretch of `length` consecutive states of an episode. Can be pickled.

    Attributes:
        starts: int64 (n,), the row of steps that each stretch begins in.
    """

    def __init__(
        self, dataset: Any, length: int = 64, columns: Sequence[str] = ("observation", "action")
    ) -> None:
        """Open a dataset, see `knotgym.loaders`.

        Args:
            dataset: see `knotgym.loaders`.
            length: states of a stretch.
            columns: which columns of `datasets.episodes.STEPS` a stretch has.

        Raises:
            InvalidInput: the length isn't above 0, no episode is as long, or there is no such
                column.
        """
        if length < 1:
            raise InvalidInput(f"length must be at least 1, got {length}")
        self.dataset, self.length, self.columns = columns_of(dataset), length, tuple(columns)
        episodes = self.dataset.episodes
        episodes.steps.only(*columns)  # refuses unknown names
        self._offsets = episodes.offsets
        rows = np.arange(episodes.steps.rows)
        fits = rows + length <= np.repeat(episodes.offsets[1:], episodes.episodes["length"] + 1)
        self.starts: Ids = rows[fits]
        if not len(self.starts):
            longest = int(episodes.episodes["length"].max(initial=-1)) + 1
            lacks = f"no episode of {self.dataset.path} has {length} states"
            raise InvalidInput(f"{lacks}; the longest has {longest}")

    def __len__(self) -> int:
        """Return the number of stretches."""
        return len(self.starts)

    def __getitem__(self, index: Index) -> dict[str, NDArray[Any]]:
        """Return a copy of a stretch and the number of its episode; of several, with an axis more.

        observation is float32 (length, beads, 3), the rope alone; the goal is
        `dataset.episodes.episodes["goal_points"][episode]`, and episode an array of one number.
        """
        first, steps = self.starts[rows_at(index, len(self))], self.dataset.episodes.steps
        at = first[..., None] + np.arange(self.length)
        # indices copy: torch would write into mapped columns, which ends the process
        columns = {name: steps[name][at] for name in self.columns}
        return {**columns, "episode": np.searchsorted(self._offsets, first[..., None], "right") - 1}
