"""The reference engine: MuJoCo, many ropes in one batch.

A rope's *state* is its MuJoCo integration state (qpos, qvel, warm start, time, ...).

After a change run `pytest tests/rope/test_simulations.py`: a rope of a batch must move as in
MuJoCo's own loop, to the bit.
"""

from collections.abc import Callable

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array
from knotgym.rope.interface import Ids, Simulation
from knotgym.rope.model import Rope

# MuJoCo's own three signs of a simulation that diverged, each counted per rope.
_BAD = mujoco.mjtWarning
_BLOWN_UP = [int(w.value) for w in (_BAD.mjWARN_BADQPOS, _BAD.mjWARN_BADQVEL, _BAD.mjWARN_BADQACC)]

# Fractions of the force that a step is tried with, in this order, until the rope stays closed.
# Recorded episodes were made with these and are rebuilt with no others.
SHARES = (1.0, 0.5, 0.25, 0.0)


class MujocoSimulation(Simulation):
    """Ropes stepped by MuJoCo; an action that would open a closure is repeated with less force."""

    engine = "mujoco"

    def __init__(self, count: int = 1, rope: Rope | None = None, threads: int = 1) -> None:
        super().__init__(count, rope, threads)
        self._batch = Batch(self.rope.model, count, min(threads, count) if threads else 0)
        # views of the batch's memory: reading them costs nothing, writing them moves the ropes
        self._qpos: Array = self._batch.bind("qpos")
        self._xfrc: Array = self._batch.bind("xfrc_applied")
        self.points = self.rope.points(self._qpos)

    def qpos(self, ids: Ids = None) -> Array:
        return self._qpos[self._all(ids)].copy()

    def states(self, ids: Ids = None) -> Array:
        return self._batch.state[self._all(ids)].copy()

    def restore(self, states: Array, ids: Ids = None) -> None:
        where = self._all(ids)
        self._batch.state[where] = states
        self.points[where] = self.rope.points(self._qpos[where])

    def set_qpos(self, qpos: ArrayLike, ids: Ids = None) -> None:
        where = self._all(ids)
        # without a forward step: velocities, warm start and time become 0, as after `mj_resetData`,
        # so an episode begins alike whatever the rope did before
        self._batch.reset(where, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._qpos[where] = qpos
        self.points[where] = self.rope.points(self._qpos[where])

    def step(
        self,
        beads: ArrayLike,
        forces: ArrayLike,
        ids: Ids = None,
        meanwhile: Callable[[], None] | None = None,
    ) -> NDArray[np.bool_]:
        """Apply a force to one bead of each rope for one action, see `Simulation.step`.

        The closures between sub-chains are soft, and a fold at a closure can hold it open by
        millimetres. A step that would open one wider than a bead's diameter is repeated from the
        same state with the next fraction in SHARES of the force; if all fail, the rope doesn't
        move.
        """
        if meanwhile is not None:  # MuJoCo's batch has threads of its own
            meanwhile()
        where, bodies = self._all(ids), self.rope.bodies[np.asarray(beads)]
        full = np.asarray(forces, dtype=np.float64)
        before = self._batch.state[where].copy()
        stable = np.ones(len(where), dtype=bool)
        pending = np.arange(len(where))  # indices into `where` of ropes still to be stepped
        self.applied_shares[where] = 0.0
        # Less force is tried down to none, with which a rope only comes to rest.
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
        # a force at the centre of mass and no torque: columns 3 to 5 stay 0
        self._xfrc[where, bodies, :3] = forces
        blew_up = np.zeros(len(where), dtype=bool)
        try:
            self._batch.step(where, nstep=self.rope.config.frame_skip)
        except SimulationError as error:
            blew_up |= np.isin(where, error.ids)
        finally:
            # MuJoCo keeps applied forces from step to step, so the next action would pull here, too
            self._xfrc[where] = 0.0
        self.points[where], gaps = self.rope.points_and_gaps(self._qpos[where])
        blew_up |= self._batch.warning[where][:, _BLOWN_UP, 1].any(axis=1)
        blew_up |= ~np.isfinite(self.points[where]).all(axis=(1, 2))
        return blew_up, gaps
