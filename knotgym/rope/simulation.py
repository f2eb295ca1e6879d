"""Batched simulation of many independent ropes.

A rope's *state* is its MuJoCo integration state (qpos, qvel, warm start, time, ...). A rope
restored from a saved state continues bit for bit, with any number of threads. Actions follow the
published interface, see `actions`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import ArrayLike, NDArray

from knotgym.common.errors import KnotgymError
from knotgym.rope.actions import decode_actions, encode_actions
from knotgym.rope.model import Array, InvalidRope, Rope

_BLOWN_UP = [
    int(w.value)
    for w in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
]

ROUNDING = 1e-6  # tolerance for float32 rounding of actions beyond 1; they are clipped to 1

# Fractions of the force that a step is tried with, in this order, until the rope stays closed.
SHARES = (1.0, 0.5, 0.25, 0.0)

Ids = Sequence[int] | NDArray[np.int64] | None


class InvalidAction(KnotgymError, ValueError):
    """An action outside [-1, 1]^6, or not finite."""


class Simulation:
    """A fixed number of independent ropes, stepped together on a thread pool.

    Attributes:
        rope: the model that all ropes share.
        count: number of ropes.
        points: float64 (count, beads, 3), metres, after the last call; the simulation's own memory,
            so copy what you keep.
        applied_shares: float64 (count,), the fraction of the requested force that each rope's last
            step applied: 1, or less if the step was repeated, or 0 if the rope didn't move.
        steps_taken: actions taken so far, summed over all ropes.
    """

    def __init__(self, count: int = 1, rope: Rope | None = None, threads: int = 1) -> None:
        """Start with `count` plain loops; `threads` 0 uses every core."""
        if count < 1:
            raise InvalidRope(f"a simulation needs at least 1 rope, got {count}")
        self.rope = rope or Rope()
        self.count = count
        self._threads = threads
        self._batch = Batch(self.rope.model, count, min(threads, count) if threads else 0)
        self._qpos: Array = self._batch.bind("qpos")
        self._xfrc: Array = self._batch.bind("xfrc_applied")
        self.points: Array = self.rope.points(self._qpos)
        self.applied_shares: Array = np.ones(count)
        self.steps_taken = 0

    def __getstate__(self) -> dict[str, Any]:
        return {
            "config": self.rope.config,
            "count": self.count,
            "threads": self._threads,
            "states": self.states(),
        }

    def __setstate__(self, saved: dict[str, Any]) -> None:
        Simulation.__init__(self, saved["count"], Rope(saved["config"]), saved["threads"])
        self.restore(saved["states"])

    @property
    def max_force(self) -> float:
        """Largest component of the force of an action, newtons."""
        return self.rope.config.max_force

    def qpos(self, ids: Ids = None) -> Array:
        """Return a copy of the generalized positions: float64 (len(ids), nq)."""
        return self._qpos[self._all(ids)].copy()

    def states(self, ids: Ids = None) -> Array:
        """Return a copy of the integration states: float64 (len(ids), nstate)."""
        return self._batch.state[self._all(ids)].copy()

    def restore(self, states: Array, ids: Ids = None) -> None:
        """Set ropes to states that `states` returned for a rope of the same model."""
        where = self._all(ids)
        self._batch.state[where] = states
        self.points[where] = self.rope.points(self._qpos[where])

    def lay(self, qpos: ArrayLike, ids: Ids = None) -> None:
        """Reset ropes to rest at generalized positions float64 (len(ids), nq).

        Nothing of their earlier state (velocity, warm start, time) is kept.
        """
        where = self._all(ids)
        self._batch.reset(where, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._qpos[where] = qpos
        self.points[where] = self.rope.points(self._qpos[where])

    def step(self, beads: ArrayLike, forces: ArrayLike, ids: Ids = None) -> NDArray[np.bool_]:
        """Apply a force to one bead of each rope for one action, frame_skip integrator steps.

        The closures between sub-chains are soft, and a fold at a closure can hold it open by
        millimetres. A step that would open one wider than a bead's diameter is repeated from the
        same state with the next fraction in SHARES of the force; if all fail, the rope doesn't
        move. `applied_shares` holds the fraction that was applied.

        Args:
            beads: int (len(ids),); the force acts at the bead's centre of mass.
            forces: (len(ids), 3), newtons, world frame.
            ids: the ropes, in increasing order; None for all.

        Returns:
            bool (len(ids),): False where the simulation blew up; such a rope is restored to its
            state before the call.
        """
        where, bodies = self._all(ids), self.rope.bodies[np.asarray(beads)]
        full = np.asarray(forces, dtype=np.float64)
        self.steps_taken += len(where)
        before = self._batch.state[where].copy()
        stable = np.ones(len(where), dtype=bool)
        pending = np.arange(len(where))  # indices into `where` of ropes still to be stepped
        self.applied_shares[where] = 0.0
        for share in SHARES:
            blew_up, gaps = self._integrate(where[pending], bodies[pending], share * full[pending])
            fails = blew_up | ~(gaps < 2 * self.rope.config.radius)
            failed = pending[fails]
            self.applied_shares[where[pending[~fails]]] = share
            stable[pending[blew_up]] = False
            if not len(failed):
                break
            self.restore(before[failed], where[failed])
            # less force is tried only for ropes that opened, not for those that blew up
            pending = failed[stable[failed]]
            if not len(pending):
                break
        return stable

    def _integrate(
        self, where: NDArray[np.int64], bodies: NDArray[np.int64], forces: Array
    ) -> tuple[NDArray[np.bool_], Array]:
        """Step ropes `where` through one action.

        Returns:
            Which of them blew up, bool (n,), and their largest gaps, float64 (n,), metres.
        """
        # MuJoCo resets a rope that blew up to the plain loop, and its warning counts with it; they
        # start from 0 here, so that any count is from this step
        self._batch.warning[where] = 0
        self._xfrc[where, bodies, :3] = forces
        blew_up = np.zeros(len(where), dtype=bool)
        try:
            self._batch.step(where, nstep=self.rope.config.frame_skip)
        except SimulationError as error:
            blew_up |= np.isin(where, error.ids)
        finally:
            self._xfrc[where] = 0.0
        self.points[where], gaps = self.rope.points_and_gaps(self._qpos[where])
        blew_up |= self._batch.warning[where][:, _BLOWN_UP, 1].any(axis=1)
        blew_up |= ~np.isfinite(self.points[where]).all(axis=(1, 2))
        return blew_up, gaps

    def act(self, actions: ArrayLike, ids: Ids = None) -> NDArray[np.bool_]:
        """Take one action with each rope, see `actions`.

        Args:
            actions: (len(ids), 6), in [-1, 1].
            ids: the ropes, in increasing order; None for all.

        Returns:
            As `step`.

        Raises:
            InvalidAction: a number is NaN or outside [-1, 1] by more than ROUNDING; no rope has
                moved.
        """
        beads, forces = self.read_actions(actions, ids)
        return self.step(beads, forces, ids)

    def read_actions(self, actions: ArrayLike, ids: Ids = None) -> tuple[NDArray[np.int64], Array]:
        """Check and decode actions (len(ids), 6).

        Returns:
            beads int64 (len(ids),); forces float64 (len(ids), 3), newtons.
        """
        where = self._all(ids)
        a = np.asarray(actions, dtype=np.float64)
        if a.shape != (len(where), 6):
            raise InvalidAction(
                f"an action is 6 numbers (x, y, z, fx, fy, fz); got shape {a.shape} for"
                f" {len(where)} ropes"
            )
        bad = ~(np.abs(a) <= 1.0 + ROUNDING).all(axis=1)
        if bad.any():
            raise InvalidAction(f"an action's numbers must be in [-1, 1], got {a[bad][0].tolist()}")
        return decode_actions(np.clip(a, -1.0, 1.0), self.points[where], self.rope.config)

    def actions(self, beads: ArrayLike, forces: ArrayLike, ids: Ids = None) -> NDArray[np.float32]:
        """Return actions float32 (len(ids), 6) that `act` decodes to these beads and forces (N)."""
        return encode_actions(beads, forces, self.points[self._all(ids)], self.rope.config)

    def _all(self, ids: Ids) -> NDArray[np.int64]:
        return np.arange(self.count) if ids is None else np.asarray(ids, dtype=np.int64)
