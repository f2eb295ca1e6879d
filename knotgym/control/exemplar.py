"""How near a rope has come to an exemplar of its goal, seen from above, bead by bead.

Where on the picture, how turned and whether mirrored makes no difference. Two ropes that show one
code may lie very unlike: in one the crossings share the whole rope, in the other they crowd where a
single bead's length is left between them, and no further one can be made. A rope that lies as the
exemplar does has room where the goal needs it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from knotgym.control.macro_actions import MacroAction, MacroActionConfig, cumulative_shares, lead
from knotgym.control.transition_graph import Distances
from knotgym.rope import Array
from knotgym.topology.gauss import GaussCode

WEIGHT = 1500.0  # macro-actions that a metre from the exemplar counts as
PATIENCE = 0.02  # metres farther at which a state of a code is e times less likely to be chosen
STEPS = 300.0  # that a metre counts as when the worst state of a code is dropped
NEARER = 0.003  # metres by which a state has come nearer if it is worth keeping for that alone
ANEW = 7000  # simulated actions after which a search begins anew
IDLE = 2  # tries more that a macro-action counts as when it promises no other code
_OVERSHOOT = (0.8, 1.3)  # of the way to the exemplar that a bead is led, from and to


class Exemplar:
    """A configuration that shows the goal."""

    def __init__(self, points: Array) -> None:
        """Keep (beads, 3) metres, and its mirror image."""
        seen = _from_above(points[None])[0]
        self._forms = np.stack([seen, seen.conj()])
        self._square = float((np.abs(seen) ** 2).mean())

    def apart(self, frames: Array) -> Array:
        """From (k, beads, 3) metres to (k,): root mean square between vertices, metres, once the
        exemplar, or its mirror image, is laid over the rope as well as can be.
        """
        seen = _from_above(frames)
        overlap = np.abs(seen @ self._forms.conj().T).max(axis=1) / seen.shape[1]
        square = (np.abs(seen) ** 2).mean(axis=1) + self._square - 2 * overlap
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))

    def propose(
        self, points: Array, rng: np.random.Generator, config: MacroActionConfig
    ) -> MacroAction:
        """Lead a bead of (beads, 3) about to where the exemplar has it, those far off first."""
        seen = _from_above(points[None])[0]
        turns = self._forms.conj() @ seen
        best = int(np.abs(turns).argmax())
        offset = self._forms[best] * turns[best] / max(abs(turns[best]), 1e-12) - seen
        offset = (offset + np.roll(offset, -1)) / 2  # from vertices to beads
        bead = int(cumulative_shares(np.abs(offset) ** 2).searchsorted(rng.random(), side="right"))
        side = (-1, 1)[rng.integers(2)]
        reach = min(abs(offset[bead]) * rng.uniform(*_OVERSHOOT), config.farthest)
        heading = float(np.angle(offset[bead]))
        return lead(points, "shift", bead, heading, float(reach), side, config)


class Potential:
    """How far states are from the goal: their codes, and how they lie beside an exemplar."""

    def __init__(self, distances: Distances, exemplar: Exemplar | None = None) -> None:
        self.distances, self.exemplar = distances, exemplar

    def apart(self, frames: Array) -> Array:
        """From (k, beads, 3) metres to (k,) metres from the exemplar; 0 where there is none."""
        return np.zeros(len(frames)) if self.exemplar is None else self.exemplar.apart(frames)

    def __call__(self, codes: Sequence[GaussCode], frames: Array) -> Array:
        """Macro-actions, float64 (k,), of k codes shown by (k, beads, 3)."""
        return np.array([self.distances(code) for code in codes]) + WEIGHT * self.apart(frames)


def _from_above(frames: Array) -> NDArray[np.complex128]:
    """Vertices as complex numbers about their centre, (k, beads)."""
    seen = frames[:, :, 0] + 1j * frames[:, :, 1]
    return np.asarray(seen - seen.mean(axis=1, keepdims=True))
