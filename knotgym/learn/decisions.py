"""Decisions to clone: which macro-action was chosen in which state for which goal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.envs import mark
from knotgym.topology import GaussCode


class Examples(NamedTuple):
    """n decisions in the canonical frame, in few bytes.

    Attributes:
        points, marks, code, goal: float16 and int8, all that the network sees, as of `Marked`.
        macros: int8 (n, 3): bead, strand, 0 for under or 1 for over.
        worked: bool (n,), whether it was on a way to the goal; the other decisions aren't
            imitated, but the network learns that they don't work there.
        episodes: int64 (n,), number of the episode; episodes are held out whole.
    """

    points: NDArray[np.float16]
    marks: NDArray[np.int8]
    code: NDArray[np.int8]
    goal: NDArray[np.int8]
    macros: NDArray[np.int8]
    worked: NDArray[np.bool_]
    episodes: NDArray[np.int64]

    def rows(self, index: NDArray[Any]) -> Examples:
        """Return some of the examples."""
        return Examples(*(column[index] for column in self))

    @property
    def nx(self) -> NDArray[np.int64]:
        """Crossings of the goals, int64 (n,)."""
        return np.count_nonzero(self.goal[:, :, 0], axis=1) // 2


def examples(
    points: NDArray[np.floating],
    goals: Sequence[GaussCode],
    macros: NDArray[np.int64],
    worked: NDArray[np.bool_],
    episodes: NDArray[np.int64],
) -> Examples:
    """Bring n decisions into the canonical frame.

    Args:
        points: (n, beads, 3), metres, where each macro-action begins; taken as float32.
        goals: n codes; chirality is ignored.
        macros: int64 (n, 3): bead to lead, bead of the strand to pass, +1 over or -1 under.
        worked, episodes: as of `Examples`.
    """
    seen = mark(points.astype(np.float32), goals)
    (beads, targets, sides), frames = macros.T, seen.frames
    chosen = frames.renumber(beads), frames.renumber(targets), (frames.sides(sides) + 1) // 2
    marks, code, goal, small = (
        column.astype(np.int8) for column in (*seen[1:4], np.stack(chosen, axis=1))
    )
    return Examples(seen.points.astype(np.float16), marks, code, goal, small, worked, episodes)
