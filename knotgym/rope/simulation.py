"""Many ropes stepped at once: the one batched simulation under everything that moves a rope.

A rope's *state* is its MuJoCo integration state (qpos, qvel, warm start, time, ...): a rope
restored from a saved state goes on bit for bit, at any number of threads. Actions follow the
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
from knotgym.rope.model import Array, Rope

_BLOWN_UP = [
    int(w.value)
    for w in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
]

ROUNDING = 1e-6  # beyond 1 is float32's, of who rescales actions, and is taken for 1

# Shares of the force that a step is tried with: in full, then less while it opens the rope.
SHARES = (1.0, 0.5, 0.25, 0.0)

Ids = Sequence[int] | NDArray[np.int64] | None


class InvalidSimulation(KnotgymError, ValueError):
    """A simulation that cannot be had."""


class InvalidAction(KnotgymError, ValueError):
    """An action outside [-1, 1]^6, or not finite."""


class Simulation:
    """A fixed number of independent ropes, stepped together on a thread pool.

    Attributes:
        rope: the rope they all are.
        count: how many.
        points: float64 (count, beads, 3), metres, as of the last call; the simulation's own memory,
            copy what you keep.
        applied_shares: float64 (count,), the share of its force that each rope's last step applied:
            1 in full, less where it was eased, 0 where the rope stayed where it was.
        steps_taken: actions taken so far, all ropes together.
    """

    def __init__(self, count: int = 1, rope: Rope | None = None, threads: int = 1) -> None:
        """Lay `count` plain loops; `threads` 0 takes every core."""
        if count < 1:
            raise InvalidSimulation(f"a simulation needs at least 1 rope, got {count}")
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
        """The largest force of an action, newtons."""
        return self.rope.config.max_force

    def qpos(self, ids: Ids = None) -> Array:
        """Copy of the generalized positions: float64 (len(ids), nq)."""
        return self._qpos[self._all(ids)].copy()

    def states(self, ids: Ids = None) -> Array:
        """Copy of the integration states: float64 (len(ids), nstate)."""
        return self._batch.state[self._all(ids)].copy()

    def restore(self, states: Array, ids: Ids = None) -> None:
        """Put ropes back into states that `states` returned, for a rope of the same model."""
        where = self._all(ids)
        self._batch.state[where] = states
        self.points[where] = self.rope.points(self._qpos[where])

    def lay(self, qpos: ArrayLike, ids: Ids = None) -> None:
        """Lay ropes at rest at generalized positions float64 (len(ids), nq).

        A rope so laid forgets all it did before.
        """
        where = self._all(ids)
        self._batch.reset(where, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._qpos[where] = qpos
        self.points[where] = self.rope.points(self._qpos[where])

    def step(self, beads: ArrayLike, forces: ArrayLike, ids: Ids = None) -> NDArray[np.bool_]:
        """Apply a force to one bead of each rope for one action, frame_skip integrator steps.

        A step that would open the rope where its sub-chains meet wider than a bead is made again
        with the next of SHARES times the force (the closures are soft, and a fold at one of them
        can hold it open by millimetres); if all fail, the rope stays. `applied_shares` says which
        share it was.

        Args:
            beads: int (len(ids),), each acted on at its centre of mass.
            forces: (len(ids), 3), newtons, world frame.
            ids: the ropes, in rising order; None for all.

        Returns:
            bool (len(ids),): False where the simulation blew up; such a rope stands where it stood
            before the call.
        """
        where, bodies = self._all(ids), self.rope.bodies[np.asarray(beads)]
        full = np.asarray(forces, dtype=np.float64)
        self.steps_taken += len(where)
        before = self._batch.state[where].copy()
        whole = np.ones(len(where), dtype=bool)
        left = np.arange(len(where))  # of `where`, those still to be stepped
        self.applied_shares[where] = 0.0
        for share in SHARES:
            broken, gaps = self._integrate(where[left], bodies[left], share * full[left])
            fails = broken | ~(gaps < 2 * self.rope.config.radius)
            back = left[fails]
            self.applied_shares[where[left[~fails]]] = share
            whole[left[broken]] = False
            if not len(back):
                break
            self.restore(before[back], where[back])
            left = back[whole[back]]
            if not len(left):
                break
        return whole

    def _integrate(
        self, where: NDArray[np.int64], bodies: NDArray[np.int64], forces: Array
    ) -> tuple[NDArray[np.bool_], Array]:
        """Step ropes `where` through one action; which blew up, and the gaps of all, metres."""
        # MuJoCo starts a blown-up rope over as a plain loop, and the count with it
        self._batch.warning[where] = 0
        self._xfrc[where, bodies, :3] = forces
        broken = np.zeros(len(where), dtype=bool)
        try:
            self._batch.step(where, nstep=self.rope.config.frame_skip)
        except SimulationError as error:
            broken |= np.isin(where, error.ids)
        finally:
            self._xfrc[where] = 0.0
        self.points[where], gaps = self.rope.points_and_gaps(self._qpos[where])
        broken |= self._batch.warning[where][:, _BLOWN_UP, 1].any(axis=1)
        broken |= ~np.isfinite(self.points[where]).all(axis=(1, 2))
        return broken, gaps

    def act(self, actions: ArrayLike, ids: Ids = None) -> NDArray[np.bool_]:
        """Take one action each, see `actions`.

        Args:
            actions: (len(ids), 6), in [-1, 1].
            ids: the ropes, in rising order; None for all.

        Returns:
            As `step`.

        Raises:
            InvalidAction: a NaN, or a number outside [-1, 1] by more than ROUNDING; no rope has
                moved.
        """
        beads, forces = self.read_actions(actions, ids)
        return self.step(beads, forces, ids)

    def read_actions(self, actions: ArrayLike, ids: Ids = None) -> tuple[NDArray[np.int64], Array]:
        """Beads int64 (len(ids),) and forces float64 (len(ids), 3), newtons, that actions name."""
        where = self._all(ids)
        a = np.asarray(actions, dtype=np.float64)
        if a.shape != (len(where), 6):
            raise InvalidAction(
                f"an action is 6 numbers (x, y, z, fx, fy, fz); got shape {a.shape} for"
                f" {len(where)} ropes"
            )
        bad = ~(np.abs(a) <= 1.0 + ROUNDING).all(axis=1)
        if bad.any():
            raise InvalidAction(f"an action's numbers lie in [-1, 1]; got {a[bad][0].tolist()}")
        return decode_actions(np.clip(a, -1.0, 1.0), self.points[where], self.rope.config)

    def actions(self, beads: ArrayLike, forces: ArrayLike, ids: Ids = None) -> NDArray[np.float32]:
        """Actions float32 (len(ids), 6) that `act` reads as these beads and forces, newtons."""
        return encode_actions(beads, forces, self.points[self._all(ids)], self.rope.config)

    def _all(self, ids: Ids) -> NDArray[np.int64]:
        return np.arange(self.count) if ids is None else np.asarray(ids, dtype=np.int64)
