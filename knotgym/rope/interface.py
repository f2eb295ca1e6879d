"""The interface of the simulation engines: many independent ropes, stepped together.

A rope's *state* is everything that the engine needs to continue bit for bit, with any number of
threads and beside any other ropes. Its *qpos* are MuJoCo's generalized positions with either
engine. Actions follow the published interface, see `actions`; `engines` makes simulations by name.

After a change run `pytest tests/rope/test_simulations.py`, one contract for both engines: the same
bytes in any company, on any number of threads.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array, InvalidInput, Threads
from knotgym.rope.actions import checked, nearest_beads
from knotgym.rope.model import Rope, RopeConfig

Ids = Sequence[int] | NDArray[np.int64] | None


class Simulation(ABC):
    """A fixed number of independent ropes, stepped together on a thread pool.

    Attributes:
        engine: the name of the engine, see `engines`.
        rope: the model that all ropes share.
        count: number of ropes.
        threads: that share the work on them.
        points: float64 (count, beads, 3), metres, after the last call; the simulation's own memory,
            so copy what you keep.
        applied_shares: float64 (count,), the fraction of the requested impulse (force times time)
            that each rope's last step applied: 1, or less where the engine had to hold back, or 0
            if the rope didn't move.
    """

    engine: ClassVar[str]
    # parameters that it carries out beyond those of the published rope; others are refused
    parameters: ClassVar[frozenset[str]] = frozenset()
    points: Array

    def __init__(self, count: int = 1, rope: Rope | None = None, threads: int = 1) -> None:
        """Start with `count` plain loops; `threads` 0 uses every core.

        Raises:
            InvalidInput: fewer than 1 rope, or a parameter that the engine doesn't know.
        """
        if count < 1:
            raise InvalidInput(f"a simulation needs at least 1 rope, got {count}")
        self.rope = rope or Rope()
        if unknown := sorted(self.rope.config.added.keys() - self.parameters):
            raise InvalidInput(
                f"the engine {self.engine} knows no {', '.join(unknown)}: {type(self).__name__}"
                " must carry it out and list it in `parameters`"
            )
        self.count = count
        self.applied_shares: Array = np.ones(count)
        self.threads = Threads(threads)

    def __reduce__(self) -> Any:
        # the compiled model isn't pickled but compiled again
        made = type(self), self.count, self.rope.config, self.threads.count
        return _with_states, (*made, self.states())

    @property
    def max_force(self) -> float:
        """Largest component of the force of an action, newtons."""
        return self.rope.config.max_force

    @abstractmethod
    def qpos(self, ids: Ids = None) -> Array:
        """Return a copy of MuJoCo's generalized positions: float64 (len(ids), nq)."""

    @abstractmethod
    def states(self, ids: Ids = None) -> Array:
        """Return a copy of the states: float64 (len(ids), nstate)."""

    @abstractmethod
    def restore(self, states: Array, ids: Ids = None) -> None:
        """Set ropes to states that `states` returned, with this engine and the same model."""

    @abstractmethod
    def set_qpos(self, qpos: ArrayLike, ids: Ids = None) -> None:
        """Reset ropes to rest at generalized positions float64 (len(ids), nq).

        Nothing of their earlier state is kept.
        """

    @abstractmethod
    def step(
        self,
        beads: ArrayLike,
        forces: ArrayLike,
        ids: Ids = None,
        meanwhile: Callable[[], None] | None = None,
    ) -> NDArray[np.bool_]:
        """Apply a force to one bead of each rope for one action, timestep * frame_skip seconds.

        Args:
            beads: int (len(ids),); the force acts at the bead's centre of mass.
            forces: (len(ids), 3), newtons, world frame.
            ids: the ropes, in increasing order; None for all.
            meanwhile: called before or while the ropes move; it may change other ropes.

        Returns:
            bool (len(ids),): False where the simulation blew up; such a rope stays as it was.
        """

    def act(self, actions: ArrayLike, ids: Ids = None) -> NDArray[np.bool_]:
        """Take one action with each rope, see `actions`.

        Args:
            actions: (len(ids), 6), in [-1, 1].
            ids: the ropes, in increasing order; None for all.

        Returns:
            As `step`.

        Raises:
            InvalidInput: a number is NaN or outside [-1, 1]; no rope has moved.
        """
        beads, forces = self.read_actions(actions, ids)
        return self.step(beads, self.max_force * forces, ids)

    def read_actions(self, actions: ArrayLike, ids: Ids = None) -> tuple[NDArray[np.int64], Array]:
        """Check and decode actions (len(ids), 6).

        Returns:
            beads int64 (len(ids),); forces float64 (len(ids), 3), in units of the largest.
        """
        where = self._all(ids)
        what = "an action is 6 numbers in [-1, 1] (x, y, z, fx, fy, fz)"
        clipped, reach = checked(actions, (len(where), 6), what), self.rope.config.reach
        beads = np.empty(len(where), dtype=np.int64)

        def _read(rows: slice) -> None:
            positions = reach * clipped[rows, :3]
            beads[rows] = nearest_beads(self.points[where[rows]], positions)

        # shared among the threads, as everything is that grows with the number of ropes
        self.threads.spread(_read, len(where))
        return beads, clipped[:, 3:]

    def actions(self, beads: ArrayLike, forces: ArrayLike, ids: Ids = None) -> NDArray[np.float32]:
        """Return actions of these beads and forces; the inverse of `read_actions`.

        Args:
            beads: int (len(ids),).
            forces: (len(ids), 3), in units of the largest; components are clipped to [-1, 1].
            ids: the ropes, in increasing order; None for all.

        Returns:
            float32 (len(ids), 6).
        """
        # The bead's own position names it best: no other bead is nearer to it. In float32 it is off
        # by 1e-7 of `reach`, far less than beads are apart.
        position = self.points[self._all(ids), np.asarray(beads)] / self.rope.config.reach
        return np.clip(np.concatenate([position, forces], axis=1), -1, 1).astype(np.float32)

    def _all(self, ids: Ids) -> NDArray[np.int64]:
        return np.arange(self.count) if ids is None else np.asarray(ids, dtype=np.int64)


def _with_states(
    kind: type[Simulation], count: int, config: RopeConfig, threads: int, states: Array
) -> Simulation:
    """Unpickle a simulation."""
    made = kind(count, Rope(config), threads)
    made.restore(states)
    return made
