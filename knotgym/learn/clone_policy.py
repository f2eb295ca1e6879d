"""The clone as a policy: it looks when its last macro-action is over, and acts its choice out.

From vertices it sees the rope and the goal's code. From pictures alone it sees what the reader makes
of them (`shape_hypotheses`), and names the bead to pull by where it believes the rope to lie.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from knotgym.envs.marked import mark
from knotgym.learn.clone_network import CloneNetwork, inputs
from knotgym.topology.gauss import GaussCode

Array = NDArray[np.float64]

LONGEST = 10  # pulls of a macro-action, at most
_ESCAPE = 0.7  # temperature after a macro-action that changed no code


class Decision:
    """Choices for n states in the world: beads, targets and sides int64 (n,), or forces (n, 3)."""


def choose(
    network: CloneNetwork,
    points: Array,
    goals: list[GaussCode],
    rngs: list[np.random.Generator],
    temperatures: NDArray[np.float32],
) -> NDArray[np.int64]:
    """Choose macro-actions in the world, int64 (n, 3): bead, target, +1 over or -1 under.

    Args:
        network: in evaluation mode.
        points: float64 (n, beads, 3), metres.
        goals: n codes.
        rngs: source of the draws of each state; not used at temperature 0.
        temperatures: float32 (n,); 0 for the likeliest.
    """
    seen = mark(points, goals)
    chosen = np.zeros((len(points), 3), dtype=np.int64)
    states = inputs(seen)
    for drawn in (False, True):
        rows = np.flatnonzero((temperatures > 0) == drawn)
        if not len(rows):
            continue
        noise = None
        if drawn:
            noise = torch.from_numpy(np.stack([rngs[row].random(NOISE) for row in rows])).float()
        heat = torch.from_numpy(temperatures[rows])[:, None]
        with torch.no_grad():
            made = network.choose(states.rows(torch.from_numpy(rows)), noise, heat)
        chosen[rows] = np.stack([column.numpy() for column in made], axis=1)
    chosen[:, 0] = seen.frames.renumber(chosen[:, 0])
    chosen[:, 1] = seen.frames.renumber(chosen[:, 1])
    chosen[:, 2] = seen.frames.sides(2 * chosen[:, 2] - 1)
    # a bead can't pass itself
    chosen[:, 1] += chosen[:, 1] == chosen[:, 0]
    chosen[:, 1] %= points.shape[1]
    return chosen
