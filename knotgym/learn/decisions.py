"""Decisions to clone: which macro-action was chosen in which state for which goal."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.envs.marked import mark
from knotgym.topology.gauss import GaussCode


class Decisions(NamedTuple):
    """n choices of macro-actions, in the world.

    Attributes:
        points: float32 (n, beads, 3), metres, where the macro-action begins.
        goals: str (n,), codes without chirality.
        macros: int64 (n, 3): bead to lead, bead of the strand to pass, +1 over or -1 under.
        worked: bool (n,), whether it was on a way to the goal; the other decisions aren't
            imitated, but the network learns that they don't work there.
        episodes: int64 (n,), number of the episode; episodes are held out whole.
    """

    points: NDArray[np.float32]
    goals: NDArray[np.str_]
    macros: NDArray[np.int64]
    worked: NDArray[np.bool_]
    episodes: NDArray[np.int64]

    def rows(self, index: NDArray[Any]) -> Decisions:
        """Return some of the decisions."""
        return Decisions(*(column[index] for column in self))


class Examples(NamedTuple):
    """n decisions in the canonical frame, in few bytes.

    Attributes:
        points, marks, code, goal: float16 and int8, all that the network sees, as of `Marked`.
        macros: int8 (n, 3): bead, strand, 0 for under or 1 for over.
        worked, episodes: bool and int64 (n,), as of `Decisions`.
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


def examples(decisions: Decisions) -> Examples:
    """Bring decisions into the canonical frame."""
    codes = {text: GaussCode.parse(text) for text in set(decisions.goals.tolist())}
    seen = mark(decisions.points, [codes[text] for text in decisions.goals.tolist()])
    beads, targets, sides = decisions.macros.T
    frames = seen.frames
    macros = frames.renumber(beads), frames.renumber(targets), (frames.sides(sides) + 1) // 2
    marks, code, goal, chosen = (
        column.astype(np.int8) for column in (*seen[1:4], np.stack(macros, axis=1))
    )
    points, (worked, episodes) = seen.points.astype(np.float16), decisions[3:]
    return Examples(points, marks, code, goal, chosen, worked, episodes)
