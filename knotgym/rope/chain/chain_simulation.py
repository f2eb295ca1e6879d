"""Many ropes stepped at once by the chain engine.

A rope's *state* holds, for each vertex, its position and velocity and the side and spin of the bead
that begins there (`dynamics`). MuJoCo's qpos become states and states qpos, the beads' twist
included; velocities don't.

After a change run `pytest tests/rope/chain/test_chain_simulation.py`: beads end within 1 mm of
MuJoCo's after an action, and the same states lead to the same bytes.
"""

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array, InvalidInput
from knotgym.rope.chain import layout
from knotgym.rope.chain.dynamics import set_all_lengths
from knotgym.rope.chain.passage import longest_edge
from knotgym.rope.chain.simd import LANES
from knotgym.rope.chain.solver import SCHEDULE, TICKS, advance
from knotgym.rope.closed_curves import directions
from knotgym.rope.interface import Ids, Simulation
from knotgym.rope.model import Rope

POSITION, VELOCITY = slice(layout.X, layout.V), slice(layout.V, layout.SIDE)
SIDE = slice(layout.SIDE, layout.SPUN)
# Recordings that ship were made with both. A pull of 0.2 N lengthens an edge by 2e-5 m/s, which
# `set_lengths` undoes; beside it stand m / h = 0.2 kg/s of a bead, so a stiffer edge would only
# cost digits. The floor leaves 2.5 mm between two axes for the proof of passage.
_STIFF = 1e4  # N s/m, what an edge resists being stretched with
_FLOOR = 0.25  # distance that contact keeps at any force, in diameters
_WEIGHT = float.fromhex("0x1.d0df64e796899p+8")  # inverse masses of two beads, 1/kg; see `_settled`


class ChainSimulation(Simulation):
    """Ropes stepped by the chain engine.

    An action is carried out with its full force until no substep can be proved safe; the rest of it
    is taken back. Its applied share is the fraction of its time that was carried out.

    Attributes:
        schedule: int (k,), see `solver.SCHEDULE`; a part of it carries out that part of an action.
    """

    engine = "chain"
    schedule: Sequence[int] = SCHEDULE

    def __init__(self, count: int = 1, rope: Rope | None = None, threads: int = 1) -> None:
        super().__init__(count, rope, threads)
        # The proof that no strand passes another holds for edges up to this length, see
        # `passage`.
        longest = longest_edge(self.rope.config.radius)
        if self.rope.config.bead_length > longest:
            raise InvalidInput(
                "the chain engine takes ropes whose beads are at most"
                f" {1000 * longest:.2f} mm long, got {1000 * self.rope.config.bead_length:.2f} mm"
            )
        # The rope's numbers are read from MuJoCo's compiled model, so both engines have the same.
        self._physics = _physics_of(self.rope)
        self._states: Array = np.empty((count, self.rope.config.beads, layout.STATE))
        self.points = np.empty((count, self.rope.config.beads, 3))
        self.set_qpos(self.rope.qpos(self.rope.loop()))

    def qpos(self, ids: Ids = None) -> Array:
        states = self._states[self._all(ids)]
        points, sides = states[:, :, POSITION], states[:, :, SIDE]
        along = directions(points)
        # MuJoCo's frame of a bead: x along it, y its side, z what is left of a right-handed frame.
        axes = np.stack([along, sides, np.cross(along, sides)], axis=-1)
        return self.rope.turned_qpos(points, _quaternions(axes))

    def states(self, ids: Ids = None) -> Array:
        where = self._all(ids)
        return self._states[where].reshape(len(where), -1)

    def restore(self, states: Array, ids: Ids = None) -> None:
        where = self._all(ids)
        self._states[where] = np.reshape(states, (len(where), *self._states.shape[1:]))
        self.points[where] = self._states[where, :, POSITION]

    def set_qpos(self, qpos: ArrayLike, ids: Ids = None) -> None:
        """Reset ropes to rest at generalized positions float64 (len(ids), nq), or all at (nq,).

        A gap between two sub-chains is closed: vertices near it move by less than the gap.
        """
        where = self._all(ids)
        rows = np.reshape(qpos, (-1, self.rope.nq))
        states = np.zeros((len(rows), *self._states.shape[1:]))
        states[:, :, POSITION] = self._with_lengths(self.rope.points(rows))
        states[:, :, SIDE] = _sides(self.rope, rows, states[:, :, POSITION])
        self.restore(np.broadcast_to(states, (len(where), *states.shape[1:])), where)

    def set_points(self, points: Array, velocities: Array, ids: Ids = None) -> None:
        """Lay ropes along curves whose edges are about as long as the beads.

        Args:
            points, velocities: float64 (len(ids), beads, 3), of the vertices, metres and m/s.
            ids: the ropes; None for all.
        """
        states = np.zeros((len(points), *self._states.shape[1:]))
        states[:, :, POSITION] = self._with_lengths(points)
        states[:, :, VELOCITY] = velocities
        # Joints resist rates, not angles, so each bead's axis may be chosen by itself: level, as
        # in a flat rope.
        along = directions(states[:, :, POSITION])
        sides = np.cross((0.0, 0.0, 1.0), along)
        upright = np.abs(along[..., 2]) > 0.999
        sides[upright] = np.cross(along[upright], (1.0, 0.0, 0.0))
        states[:, :, SIDE] = sides / np.linalg.norm(sides, axis=2, keepdims=True)
        self.restore(states, ids)

    def velocities(self, ids: Ids = None) -> Array:
        """Copy of the vertices' velocities: float64 (len(ids), beads, 3), m/s."""
        return self._states[self._all(ids), :, VELOCITY].copy()

    def _with_lengths(self, points: Array) -> Array:
        """Move vertices a little, so that all edges are as long as the beads; a new array."""
        moved = np.array(points)
        set_all_lengths(moved, self.rope.config.bead_length, 6)
        return moved

    def step(
        self,
        beads: ArrayLike,
        forces: ArrayLike,
        ids: Ids = None,
        meanwhile: Callable[[], None] | None = None,
    ) -> NDArray[np.bool_]:
        where = self._all(ids)
        pulled = np.ascontiguousarray(beads, dtype=np.int64)
        forces = np.ascontiguousarray(forces, dtype=np.float64)
        schedule = np.array(self.schedule, dtype=np.int64)
        counts = np.zeros((len(where), len(layout.COUNTS)), dtype=np.int64)
        ropes = self._states, self.points, where, pulled, forces, self._physics
        whole, part = self.rope.config.timestep * self.rope.config.frame_skip, schedule.sum()
        action = whole * (part / sum(SCHEDULE)), schedule
        taken = np.zeros(1, dtype=np.int64)
        # No rope's result depends on those beside it, so any thread may take any of them.
        self.threads.spread(
            lambda _: advance(*ropes, *action, counts, taken), len(where), LANES, meanwhile
        )
        ticks = TICKS * part
        self.applied_shares[where] = (ticks - counts[:, layout.LOST]) / ticks
        return counts[:, layout.BLOWN_UP] == 0


def _physics_of(rope: Rope) -> layout.Physics:
    """Return what the solver needs to know of a rope, from MuJoCo's compiled model."""
    model, config, body = rope.model, rope.config, int(rope.bodies[0])
    mass, (transverse, _, spin) = float(model.body_mass[body]), model.body_inertia[body].tolist()
    # the box of equal inertia, as in MuJoCo's documentation ("Fluid forces", inertia model)
    wide, long = float(np.sqrt(6 * spin / mass)), float(np.sqrt(6 * (2 * transverse - spin) / mass))
    density = float(model.opt.density)
    damping = np.full(config.beads, config.joint_damping)
    # no joint where MuJoCo joins two sub-chains, and none at vertex 0, where `banded` cuts the
    # loop
    damping[[first for first, _ in config.chains]] = 0.0
    # a contact of two beads far from the ends of their sub-chains
    geom = int(model.body_geomadr[body])
    constant, impedance = float(model.geom_solref[geom, 0]), float(model.geom_solimp[geom, 1])
    weight = _settled(2 * float(np.median(model.body_invweight0[rope.bodies, 0])))
    # R of the constraint; MuJoCo's documentation, "Computation", on the parameters of constraints
    soft = (1 - impedance) / impedance * weight
    return layout.Physics(
        mass=mass,
        transverse=transverse,
        round=spin,
        length=config.bead_length,
        drag_across=0.5 * density * wide * long,
        drag_along=0.5 * density * wide * wide,
        drag_turn=density * wide * (wide**4 + long**4) / 64,
        drag_roll=density * long * 2 * wide**4 / 64,
        stretch=_STIFF,
        damping=damping,
        radius=config.radius,
        contact_stiffness=1 / (impedance * constant) ** 2 / soft,
        contact_damping=2 / (impedance * constant) / soft,
        floor=_FLOOR * 2 * config.radius,
    )


def _settled(weight: float) -> float:
    """Return a sum of MuJoCo's compiler, whose last digits depend on the processor, without them.

    Its inverse inertias are 2e-15 off on aarch64, and stiffness and damping of contacts follow from
    them, so ropes that touch moved otherwise. The rope that ships keeps the bits of x86-64, with
    which recordings were made; others get 12 digits.
    """
    return _WEIGHT if abs(weight - _WEIGHT) < 1e-12 * _WEIGHT else float(f"{weight:.12g}")


def _sides(rope: Rope, qpos: Array, points: Array) -> Array:
    """The beads' first axes across: MuJoCo's y axes, made perpendicular to the edges.

    Args:
        qpos: float64 (ropes, nq).
        points: float64 (ropes, beads, 3), metres.
    """
    # Twist is in qpos alone and not in the vertices, so MuJoCo's kinematics say how each bead is
    # turned. They are written out: MuJoCo itself rounds products of quaternions by processor.
    model, at = rope.model, np.zeros((len(qpos), rope.model.nbody, 4))
    places = model.jnt_qposadr + np.where(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE, 3, 0)
    turns = _unit(qpos[:, places[:, None] + np.arange(4)])  # of joint k, the one of body k + 1
    depth = np.zeros(model.nbody, dtype=np.int64)
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + 1
    for level in range(1, depth.max() + 1):
        bodies = np.flatnonzero(depth == level)
        at[:, bodies] = turns[:, bodies - 1]
        if level > 1:  # the roots, of level 1, are free
            parents = at[:, model.body_parentid[bodies]]
            beside = _product(parents, model.body_quat[bodies])
            at[:, bodies] = _unit(_product(beside, at[:, bodies]))
    w, x, y, z = np.moveaxis(at[:, rope.bodies], 2, 0)
    # x is along the bead, so its first axis across is column 1 of its matrix
    sides = np.stack([2 * (x * y - w * z), (w * w + y * y) - (x * x + z * z), 2 * (y * z + w * x)])
    sides = np.moveaxis(sides, 0, 2)
    along = directions(points)
    sides -= (sides * along).sum(axis=2, keepdims=True) * along
    return sides / np.linalg.norm(sides, axis=2, keepdims=True)


def _product(one: Array, other: Array) -> Array:
    """Products of quaternions (..., 4), w first; terms are added in pairs, as MuJoCo does."""
    a, b, c, d = np.moveaxis(one, -1, 0)
    w, x, y, z = np.moveaxis(other, -1, 0)
    terms = [
        (a * w - b * x) + (-c * y - d * z),
        (a * x + b * w) + (c * z - d * y),
        (a * y - b * z) + (c * w + d * x),
        (a * z + b * y) + (-c * x + d * w),
    ]
    return np.stack(terms, axis=-1)


def _unit(quaternions: Array) -> Array:
    """Quaternions (..., 4) of length 1; those that have it to 1e-15 stay, as in MuJoCo."""
    a, b, c, d = np.moveaxis(quaternions, -1, 0)
    norm = np.sqrt((a * a + b * b) + (c * c + d * d))[..., None]
    return np.where(np.abs(norm - 1) > 1e-15, quaternions * (1 / norm), quaternions)


def _quaternions(axes: Array) -> Array:
    """Unit quaternions, w first, of rotation matrices (..., 3, 3).

    Row i of the matrix below is 4 q_i q; the row of the largest q_i is well conditioned.
    """
    m = np.moveaxis(axes, (-2, -1), (0, 1))
    across = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    along = m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2]
    square = [
        1 + m[0, 0] * a + m[1, 1] * b + m[2, 2] * a * b
        for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
    ]
    rows = np.array(
        [
            [square[0], *across],
            [across[0], square[1], along[0], along[1]],
            [across[1], along[0], square[2], along[2]],
            [across[2], along[1], along[2], square[3]],
        ]
    )
    # The four numbers 4 q_i^2 sum to 4, so the largest is at least 1, and the row that is divided
    # by its norm, 4 |q_i|, by 2 at least: that amplifies no rounding.
    best = np.argmax(square, axis=0)
    directed = np.moveaxis(np.take_along_axis(rows, best[None, None], axis=0)[0], 0, -1)
    return directed / np.linalg.norm(directed, axis=-1, keepdims=True)
