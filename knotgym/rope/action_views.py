"""Action views: what an agent's action is, and the pulls that carry it out.

    "pull"    float32 (6,): x, y, z, fx, fy, fz in [-1, 1], see `actions`; one pull
    "bead"    int (4,): the bead, and choices of fx, fy, fz, see `actions`; one pull
    "macro"   int (3,): the bead to lead, the bead whose strand it passes, and 0 for under or 1 for
              over; as many pulls as it takes
    "decision" float32 (43,) in [-1, 1]: a position, for the bead nearest to it, relative to the
              rope's centre and in units of a third of a metre; the forces of up to LONGEST pulls of
              that bead; and for each of those pulls a number, at most 0 from the first that isn't
              made any more (the first is always made)

A decision is what a macro-action came to, without looking in between. Unlike its name, it can be
averaged, perturbed and turned, so that learners of continuous actions learn it.
A macro-action is a pass without chance, carried out by the `WaypointFollower` until the
bead has reached its last waypoint, the episode has ended, or LONGEST pulls were made. A change of
code doesn't end it: a crossing that has only just been made comes undone in the next one.

After a change run `pytest tests/envs/test_action_views.py`.
"""

from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.rope.actions import (
    FORCE_CHOICES,
    LONGEST,
    NEAR,
    action_space,
    checked,
    nearest_beads,
    quantized,
)
from knotgym.rope.interface import Simulation
from knotgym.rope.macro_actions import WaypointFollower


class ActionView:
    """Carries out agents' actions on the ropes of a simulation, pull by pull.

    Attributes:
        LONGEST: most pulls of a macro-action or of a decision.
        NEAR: metres from the rope's centre that 1 stands for in a decision.
        name: "pull", "bead", "macro" or "decision".
        counts: int64 (size,), how many values each whole number has; None if the numbers are in
            [-1, 1].
        size: how many numbers an action has.
        busy: bool (count,), whether a rope's action has pulls left.
        pulls: int64 (count,), pulls of each rope's current or last action.
        macros: int64 (count, 3), the current or last macro-action: bead, target, side (+1 over, -1
            under).
    """

    LONGEST: ClassVar[int] = LONGEST
    NEAR: ClassVar[float] = NEAR

    def __init__(self, view: str, simulation: Simulation) -> None:
        self.name, self._simulation = view, simulation
        count, beads = simulation.points.shape[:2]
        space: Any = action_space(view, beads)
        self.counts: NDArray[np.int64] | None = getattr(space, "nvec", None)
        self.size = int(space.shape[0])
        # those of macro-actions are kept by the controller
        self._actions: NDArray[np.float64] = np.zeros((count, self.size))
        self._lengths = np.ones(count, dtype=np.int64)  # pulls that an action has, at most
        self._controller = WaypointFollower(count)
        self.busy = np.zeros(count, dtype=bool)
        self.pulls = np.zeros(count, dtype=np.int64)
        self.macros = np.zeros((count, 3), dtype=np.int64)

    @staticmethod
    def force_choices(forces: ArrayLike) -> NDArray[np.int64]:
        """Return the nearest choice for each force component in [-1, 1], int64 of the same shape.

        >>> ActionView.force_choices([-1.0, 0.0, 0.97]).tolist()
        [0, 5, 10]
        """
        half = (FORCE_CHOICES - 1) // 2
        # choices 0 to 2 half stand for -1 to 1, the one in the middle for no force
        return np.rint(half * (1 + np.asarray(forces, dtype=np.float64))).astype(np.int64)

    @staticmethod
    def chosen_forces(chosen: ArrayLike) -> NDArray[np.float64]:
        """Return the force component, quantized, that each choice means.

        >>> ActionView.chosen_forces([0, 5, 10]).tolist()
        [-1.0, 0.0, 1.0]
        """
        half = (FORCE_CHOICES - 1) // 2
        return quantized((np.asarray(chosen, dtype=np.float64) - half) / half)

    def check(self, actions: ArrayLike, ids: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the actions of the ropes `ids` as float64 (n, size).

        Raises:
            InvalidInput: they have another shape, or a number is out of range.
        """
        what = f"an action of the view {self.name!r} is {self.size}"
        what += " numbers in [-1, 1]" if self.counts is None else " whole numbers"
        return checked(actions, (len(ids), self.size), what, self.counts)

    def reset(self, ids: NDArray[np.int64]) -> None:
        """Drop the actions of ropes whose episodes begin."""
        self.busy[ids], self.pulls[ids] = False, 0

    def begin(self, actions: ArrayLike, ids: NDArray[np.int64]) -> None:
        """Start actions on the ropes `ids`.

        Raises:
            InvalidInput: as in `check`; no rope's action has changed.
        """
        chosen = self.check(actions, ids)
        self.busy[ids], self.pulls[ids] = True, 0
        if self.name == "macro":
            # an agent's 0 and 1 become the side -1 and +1 of `macro_actions.Pass`
            self.macros[ids] = chosen * (1, 1, 2) - (0, 0, 1)
            self._controller.begin_passes(ids, self.macros[ids], self._simulation.points)
            return
        self._actions[ids] = chosen
        if self.name == "decision":
            points = self._simulation.points[ids]
            places = points.mean(axis=1) + NEAR * chosen[:, :3]
            self._actions[ids, 0] = nearest_beads(points, places)
            made = chosen[:, 4 + 3 * LONGEST :] > 0  # the pulls after the first
            self._lengths[ids] = 1 + made.cumprod(axis=1).sum(axis=1)

    def pulls_of(self, ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the next pull of each of the ropes `ids`, which are busy.

        Returns:
            beads int64 (n,); forces float32 (n, 3), in units of the largest force.
        """
        if self.name == "bead":
            forces = self.chosen_forces(self._actions[ids, 1:4])
            return self._actions[ids, 0].astype(np.int64), forces.astype(np.float32)
        if self.name == "decision":
            forces = self._actions[ids, 3 : 3 + 3 * LONGEST].reshape(len(ids), LONGEST, 3)
            own = quantized(forces[np.arange(len(ids)), self.pulls[ids]])
            return self._actions[ids, 0].astype(np.int64), own.astype(np.float32)
        self._controller.arrive(self._simulation.points, ids)
        return self._controller.beads[ids], self._controller.forces(self._simulation.points, ids)

    def pulled(self, ids: NDArray[np.int64], ended: NDArray[np.bool_]) -> None:
        """Record that the ropes `ids` made a pull, and whether it `ended` their episodes."""
        self.pulls[ids] += 1
        self.busy[ids] = (self.pulls[ids] < self._lengths[ids]) & ~ended
        if self.name == "macro":
            # waypoints that the pull reached are passed now, so that an action that is over ends
            # with this pull and not with one more
            arrived = self._controller.arrive(self._simulation.points, ids)
            spent = arrived | (self.pulls[ids] >= LONGEST)
            self.busy[ids] = ~spent & ~ended
