"""Action sequences: forces on beads, step by step, independent of where the rope lies.

Every step goes through the environment's actions (`step_ropes`), so an agent can repeat any
sequence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from knotgym.rope.simulation import Ids, Simulation


@dataclass(frozen=True)
class ActionSequence:
    """T steps, given by beads instead of positions, so they fit a rope that lies elsewhere.

    Attributes:
        beads: int16 (T,), the bead that each step pulls.
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
        """Scale each step by 1 + normal noise of standard deviation `scale`.

        Gives another chance where the sequence itself just misses its code.
        """
        strength = 1 + rng.normal(0, scale, (len(self), 1))
        return ActionSequence(self.beads, np.clip(self.forces * strength, -1, 1).astype(np.float32))


def resting(steps: int) -> ActionSequence:
    """A sequence of steps without force."""
    return ActionSequence(np.zeros(steps, dtype=np.int16), np.zeros((steps, 3), dtype=np.float32))


NO_ACTIONS = resting(0)


def step_ropes(
    ropes: Simulation,
    beads: NDArray[np.integer],
    forces: NDArray[np.floating],
    ids: Ids = None,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Pull one bead of each rope for one step, through the environment's actions.

    Args:
        ropes: the ropes to act on.
        beads: int (len(ids),), the bead to pull on each.
        forces: (len(ids), 3), in units of the largest force.
        ids: which ropes; None for all.

    Returns:
        The actions taken, float32 (len(ids), 6), and which simulations stayed stable.
    """
    newtons = np.asarray(forces, dtype=np.float64) * ropes.max_force
    actions = ropes.actions(beads, newtons, ids)
    return actions, ropes.act(actions, ids)
