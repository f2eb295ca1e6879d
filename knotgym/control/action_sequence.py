"""Action sequences: a rope's steps one after the other, by bead and not by place.

Every step goes through the agent's interface (`step_ropes`), so that a sequence is something that
an agent can do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from knotgym.rope.model import Array
from knotgym.rope.simulation import Ids


class Ropes(Protocol):
    """Ropes that can be acted on and put back: a `Simulation`, or what foresees one.

    Attributes:
        count: how many.
        points: float64 (count, beads, 3), metres.
    """

    count: int
    points: Array

    @property
    def max_force(self) -> float:
        """The force that actions count in, newtons."""

    def states(self, ids: Any) -> Array:
        """Copies of all that decides what comes next, float64 (len(ids), n)."""

    def restore(self, states: Array, ids: Any) -> None:
        """Put ropes back into states."""

    def actions(self, beads: Any, forces: Any, ids: Any) -> NDArray[np.float32]:
        """Actions float32 (len(ids), 6) that pull beads with forces in newtons."""

    def act(self, actions: NDArray[np.float32], ids: Any) -> NDArray[np.bool_]:
        """Take actions; which ropes held."""


@dataclass(frozen=True)
class ActionSequence:
    """Steps that lead from one state to another and fit a rope that lies elsewhere.

    Attributes:
        beads: int16 (T,), the bead that each step moves.
        forces: float32 (T, 3), in units of the largest force.
    """

    beads: NDArray[np.int16]
    forces: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.beads)

    def __add__(self, other: ActionSequence) -> ActionSequence:
        return ActionSequence(
            np.concatenate([self.beads, other.beads]), np.concatenate([self.forces, other.forces])
        )

    def jittered(self, scale: float, rng: np.random.Generator) -> ActionSequence:
        """Make each step stronger or weaker by a share of about `scale`.

        Another try where the sequence itself just misses.
        """
        strength = 1 + rng.normal(0, scale, (len(self), 1))
        return ActionSequence(self.beads, np.clip(self.forces * strength, -1, 1).astype(np.float32))


def resting(steps: int) -> ActionSequence:
    """Steps of no force."""
    return ActionSequence(np.zeros(steps, dtype=np.int16), np.zeros((steps, 3), dtype=np.float32))


NO_ACTIONS = resting(0)


def step_ropes(
    ropes: Ropes,
    beads: NDArray[np.integer],
    forces: NDArray[np.floating],
    ids: Ids = None,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Take one step of each rope through the agent's interface.

    Args:
        ropes: to act on.
        beads: int (len(ids),).
        forces: (len(ids), 3), in units of the largest force.
        ids: which of them.

    Returns:
        The actions float32 (len(ids), 6), and which ropes held.
    """
    newtons = np.asarray(forces, dtype=np.float64) * ropes.max_force
    actions = ropes.actions(beads, newtons, ids)
    return actions, ropes.act(actions, ids)
