"""Imagined ropes: the learned dynamics behind the interface that the planner steps.

`Imagination` takes the place of `simulation.Simulation` in `control.planner`; no simulator is
involved. An imagined action is (bead, 0, 0, fx, fy, fz), with forces relative to the largest.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.learn.rope_model import BEADS, Dynamics
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode

Array = NDArray[np.float64]


class Imagination:
    """`count` imagined ropes; implements `control.action_sequence.Ropes`.

    Attributes:
        max_force: 1, because forces are relative to the largest.
        points: float64 (count, BEADS, 3), metres.
        velocities: float64 (count, BEADS, 3), m/s.
    """

    max_force = 1.0

    def __init__(self, dynamics: Dynamics, count: int) -> None:
        self.dynamics, self.count = dynamics, count
        self.points: Array = np.zeros((count, BEADS, 3))
        self.velocities: Array = np.zeros((count, BEADS, 3))

    def states(self, ids: Any) -> Array:
        """Copy points and velocities of ropes, float64 (len(ids), 6 BEADS)."""
        # a row is x, y, z of every bead, then their velocities in the same order
        both = np.stack([self.points[ids], self.velocities[ids]], axis=1)
        return both.reshape(len(both), -1)

    def restore(self, states: Array, ids: Any) -> None:
        """Set ropes to states that `states` returned."""
        both = states.reshape(-1, 2, BEADS, 3)
        self.points[ids], self.velocities[ids] = both[:, 0], both[:, 1]

    def actions(self, beads: Any, forces: Any, ids: Any) -> NDArray[np.float32]:
        """Encode imagined actions, float32 (n, 6); forces are clipped to [-1, 1]."""
        actions = np.zeros((len(np.asarray(beads)), 6), dtype=np.float32)
        actions[:, 0], actions[:, 3:] = beads, np.clip(forces, -1, 1)
        return actions

    def act(self, actions: NDArray[np.float32], ids: Any) -> NDArray[np.bool_]:
        """Step ropes; return False for those whose strands passed through each other."""
        # float32 holds bead numbers exactly, so the first column needs no rounding
        ids = np.asarray(ids)
        beads = actions[:, 0].astype(np.int64)
        before = label_many(self.points[ids])
        self.points[ids], self.velocities[ids] = self.dynamics.step(
            self.points[ids], self.velocities[ids], beads, actions[:, 3:].astype(np.float64)
        )
        after = label_many(self.points[ids])
        return np.array([not passed_through(*pair) for pair in zip(before, after, strict=True)])


def pack_state(points: Array, velocities: Array) -> Array:
    """Pack one rope's state as `Imagination.states` does, float64 (6 BEADS,)."""
    return np.stack([points, velocities]).reshape(-1)


def passed_through(before: GaussCode, after: GaussCode) -> bool:
    """Return whether the only change is that crossings swapped over and under.

    A real rope can't do that in one action: two strands would have to cut through each other.

    >>> passed_through(GaussCode((1, -1), "c"), GaussCode((-1, 1), "a"))
    True
    """
    if before.visits == after.visits or len(before.visits) != len(after.visits):
        return False
    return [abs(visit) for visit in before.visits] == [abs(visit) for visit in after.visits]
