"""The closed rope: its MuJoCo model, and conversion between configurations and qpos.

Bead i is a rigid capsule from vertex i to vertex i + 1. A *configuration* is the (beads, 3) array
of vertices in metres, z up, in the order in which the rope runs. MuJoCo needs kinematic trees, so
the loop is cut into sub-chains. Each is a chain of ball joints with one free bead as its root;
`connect` equality constraints pull the end of each sub-chain to the start of the next.
Source: arXiv 2505.18028 for the constants. All beads are equal here; in the published asset their
lengths vary.

After a change run `pytest tests/rope/test_rope.py`; if the same configuration moves differently,
raise the format in _PUBLISHED: shipped states and recordings are refused until they are made again.
"""

import hashlib
import json
from dataclasses import asdict, fields, replace
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from knotgym.common import InvalidInput, configuration
from knotgym.rope.closed_curves import clearance, equal_chords
from knotgym.rope.kinematics import backward, forward, transported
from knotgym.topology import same_spot

Array = NDArray[np.float64]

# MuJoCo's solver parameters of the constraints that join the sub-chains, as published; the chain
# engine closes the rope exactly and has none.
_CLOSURES: dict[str, tuple[float, ...]] = {
    "closure_solref": (0.02, 1.0),
    "closure_solimp": (0.9, 0.95, 0.001, 0.5, 2.0),
}
# The rope that ships, of which a fingerprint is the hash with the values that differ from it. A
# parameter that isn't here counts once it differs from its default, so a new one whose default
# changes no motion leaves every file readable; an engine that carries it out lists it in its
# `parameters`.
_PUBLISHED: dict[str, Any] = {
    "format": 1,  # increase whenever the same configuration would move differently
    "beads": 100,
    "length": 1.33,
    "radius": 0.005,
    "density": 1000.0,
    "medium_density": 10000.0,
    "joint_damping": 0.01,
    "sub_chains": 7,
    "rooted": "middle",  # each sub-chain's free bead
    "timestep": 0.008,
    "frame_skip": 24,
    "max_force": 0.2,
    "reach": 2.0,
    **_CLOSURES,
}


@configuration
class RopeConfig:
    """Geometry and physics of the rope.

    Attributes:
        beads: number of rigid capsules in the loop.
        length: length of the rope, metres.
        radius: radius of a bead, metres.
        density: density of a bead, kg/m^3.
        medium_density: density of the surrounding medium, kg/m^3; its drag stops the rope.
        joint_damping: damping of the ball joints, N m s / rad.
        sub_chains: number of open chains that the loop is cut into.
        timestep: integrator step, seconds.
        frame_skip: integrator steps per action.
        max_force: largest component of the force on a bead, newtons.
        reach: position that an action's coordinate of 1 stands for, metres.
    """

    beads: PositiveInt = 100
    length: PositiveFloat = 1.33
    radius: PositiveFloat = 0.005
    density: PositiveFloat = 1000.0
    medium_density: PositiveFloat = 10000.0
    joint_damping: NonNegativeFloat = 0.01
    sub_chains: PositiveInt = 7
    timestep: PositiveFloat = 0.008
    frame_skip: PositiveInt = 24
    max_force: PositiveFloat = 0.2
    reach: PositiveFloat = 2.0

    def __post_init__(self) -> None:
        if self.sub_chains < 2 or self.beads < 3 * self.sub_chains:
            raise InvalidInput(
                f"a rope needs 2 sub-chains of 3 beads each at least, got {self.beads} beads in"
                f" {self.sub_chains} sub-chains"
            )
        if 2 * self.radius >= self.bead_length:
            raise InvalidInput(
                f"a bead must be longer than wide, got length {self.bead_length:.3g} and radius"
                f" {self.radius:.3g}"
            )

    @property
    def bead_length(self) -> float:
        """Distance between neighbouring vertices, metres."""
        return self.length / self.beads

    @property
    def added(self) -> dict[str, Any]:
        """Parameters that the published rope doesn't have, where they differ from their default."""
        own = {field.name: (getattr(self, field.name), field.default) for field in fields(self)}
        return {
            name: value
            for name, (value, default) in own.items()
            if name not in _PUBLISHED and value != default
        }

    @property
    def fingerprint(self) -> str:
        """Hash of what differs from the published rope, 16 hexadecimal digits.

        Files hold that of the rope they were made with.
        """
        known = {name: value for name, value in asdict(self).items() if name in _PUBLISHED}
        text = json.dumps({**_PUBLISHED, **known, **self.added}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def rope_of(beads: int) -> RopeConfig:
    """Return the rope of so many beads of the usual length; 200 of them make 2.66 m.

    Sub-chains keep their size, so that closing errors do too.
    """
    usual = RopeConfig()
    # As many beads to a metre, and closures as far apart, as in the usual rope.
    share = beads / usual.beads
    chains = max(2, round(share * usual.sub_chains))
    return replace(usual, beads=beads, length=share * usual.length, sub_chains=chains)


class Rope:
    """A compiled rope model, with conversion between configurations and MuJoCo's qpos.

    Attributes:
        config: the settings it was compiled from.
        model: the compiled model. Bodies are not in the order of the beads, see `bodies`.
        bodies: int (beads,), the MuJoCo body id of each bead.
    """

    def __init__(self, config: RopeConfig | None = None) -> None:
        self.config = config or RopeConfig()
        self.model = _compile(self.config)
        beads = self.config.beads
        self.bodies = np.array([self.model.body(f"bead{i}").id for i in range(beads)])
        bead_of = {int(body): bead for bead, body in enumerate(self.bodies)}
        # MuJoCo numbers a parent's body before its children's
        order = sorted(range(beads), key=lambda bead: self.bodies[bead])
        joints = self.model.body_jntadr[self.bodies]
        self._order = np.array(order)
        self._parent = np.array(
            [bead_of.get(int(self.model.body_parentid[body]), -1) for body in self.bodies]
        )
        self._qpos_at = self.model.jnt_qposadr[joints].astype(np.int64)
        # orientation relative to the parent at zero joint angle
        self._rest = self.model.body_quat[self.bodies].copy()
        # Chords between two sub-chains may have any length up to the gap that closures leave.
        self._next_in_chain = np.ones(beads, dtype=bool)
        self._next_in_chain[[last for _, last in sub_chains(self.config)]] = False

    @property
    def nq(self) -> int:
        """Length of a qpos."""
        return int(self.model.nq)

    def points(self, qpos: ArrayLike) -> Array:
        """Return the vertices of one or many generalized positions.

        Args:
            qpos: float64 (..., nq).

        Returns:
            float64 (..., beads, 3), metres; a new array.
        """
        return self.points_and_gaps(qpos)[0]

    def points_and_gaps(self, qpos: ArrayLike) -> tuple[Array, Array]:
        """Return the vertices and the largest gap between joined ends of sub-chains.

        Args:
            qpos: float64 (..., nq).

        Returns:
            float64 (..., beads, 3) and float64 (...), metres.
        """
        # a writable array, because numba would compile `forward` again for a read-only one
        q = np.require(qpos, np.float64, ["C", "W"])
        rows = q.reshape(-1, self.nq)
        points, gaps = np.empty((len(rows), self.config.beads, 3)), np.empty(len(rows))
        forward(
            rows,
            self._order,
            self._parent,
            self._qpos_at,
            self._rest,
            self.config.bead_length,
            points,
            gaps,
        )
        return points.reshape(*q.shape[:-1], self.config.beads, 3), gaps.reshape(q.shape[:-1])

    def qpos(self, points: ArrayLike) -> Array:
        """Return generalized positions of configurations, with the smallest twist of their beads.

        Args:
            points: float64 (..., beads, 3), metres, neighbours one bead length apart inside each
                sub-chain.

        Returns:
            float64 (..., nq).
        """
        p = np.ascontiguousarray(points, dtype=np.float64)
        rows = p.reshape(-1, *p.shape[-2:])
        along = np.roll(rows, -1, axis=1) - rows
        along /= np.linalg.norm(along, axis=2, keepdims=True)
        qpos = self.turned_qpos(rows, transported(along, self._order, self._parent))
        return qpos.reshape(*p.shape[:-2], self.nq)

    def turned_qpos(self, points: Array, world: Array) -> Array:
        """Return generalized positions of ropes whose beads are turned as given.

        Args:
            points: float64 (n, beads, 3), metres.
            world: float64 (n, beads, 4), the beads' orientations, quaternions with w first.

        Returns:
            float64 (n, nq).
        """
        qpos = np.empty((len(points), self.nq))
        trees = self._order, self._parent, self._qpos_at, self._rest
        backward(np.ascontiguousarray(points), world, *trees, qpos)
        return qpos

    def loop(self) -> Array:
        """Return the plain loop, flat, anticlockwise from +x: float64 (beads, 3), metres."""
        turn = 2 * np.pi * np.arange(self.config.beads) / self.config.beads
        # circumradius of a regular polygon, so that its sides are exactly one bead long
        radius = self.config.bead_length / (2 * np.sin(np.pi / self.config.beads))
        return radius * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)

    def from_curve(self, curve: ArrayLike, *, max_overlap: float = 0.001) -> Array:
        """Turn a closed polyline into a configuration of this rope.

        A curve that already is a configuration (beads of the right length inside every sub-chain,
        closing gaps below a bead's diameter) is returned unchanged. Any other curve is cut into
        equal chords, scaled to the rope's length and centred.

        Args:
            curve: (n, 3), n >= 4, any unit; the last point is joined to the first, which may also
                be repeated at the end. Of points on one spot one is kept.
            max_overlap: largest overlap of two beads that aren't neighbours, metres.

        Returns:
            float64 (beads, 3), metres.

        Raises:
            InvalidInput: the points are not finite or not below 1e100, the curve is not closed or
                turns too sharply, or beads would overlap.
        """
        p = np.array(curve, dtype=np.float64)
        if p.ndim != 2 or p.shape[1] != 3:
            raise InvalidInput(f"a curve is an (n, 3) array of points, got shape {p.shape}")
        if not (np.abs(p) < 1e100).all():  # their squares overflow
            raise InvalidInput("a curve needs finite coordinates, below 1e100, got others")
        again = same_spot(p) if len(p) else np.zeros(0, dtype=bool)
        repeated, p = again[-1:].any(), p[:1] if again.all() else p[~again]
        different = len(np.unique(p, axis=0))
        if different < 4:
            raise InvalidInput(f"a closed rope needs at least 4 different points, got {different}")
        if not self._is_configuration(p):
            # a closing chord of more than three times any other is taken for an open curve
            chords = np.linalg.norm(np.roll(p, -1, axis=0) - p, axis=1)
            if not repeated and chords[-1] > 3 * chords[:-1].max():
                raise InvalidInput(
                    f"the curve isn't closed: its ends are {chords[-1]:.3g} apart, neighbouring"
                    f" points at most {chords[:-1].max():.3g}; repeat the first point at the end to"
                    " close it with a straight line"
                )
            p = self.config.bead_length * equal_chords(p, self.config.beads)
            if not self._is_configuration(p):
                raise InvalidInput(
                    f"the curve turns too sharply for a rope of {self.config.beads} beads"
                )
        depth = 2 * self.config.radius - clearance(p, 2 * self.config.radius)
        if depth > max_overlap:
            most = f"{1000 * max_overlap:.1f} mm"
            raise InvalidInput(
                f"beads would overlap by {1000 * depth:.1f} mm, at most {most} is allowed: the"
                " curve passes too close to itself"
            )
        return p

    def _is_configuration(self, points: Array) -> bool:
        if len(points) != self.config.beads:
            return False
        lengths = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
        # Inside a sub-chain beads are rigid, so a micrometre is rounding; a closure is soft, and
        # open by less than a diameter in every state that a simulation can reach.
        off = np.abs(lengths - self.config.bead_length)
        return bool(off[self._next_in_chain].max() < 1e-6 and off.max() < 2 * self.config.radius)


@lru_cache(maxsize=8)
def _compile(config: RopeConfig) -> mujoco.MjModel:
    """Build and compile the model.

    Its reference pose is the plain loop; MuJoCo derives the anchors of the constraints from it.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "rope"
    # The rope floats in a dense medium, whose drag brings it to rest.
    spec.option.gravity = [0.0, 0.0, 0.0]
    spec.option.density = config.medium_density
    spec.option.timestep = config.timestep
    # MuJoCo's Euler integrator treats joint damping implicitly
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    # Projected Gauss-Seidel, as published: results depend on the solver.
    spec.option.solver = mujoco.mjtSolver.mjSOL_PGS
    for first, last in sub_chains(config):
        _add_chain(spec, config, first, last)
    for _, last in sub_chains(config):
        _join(spec, config, last, (last + 1) % config.beads)
    return spec.compile()


def _add_chain(spec: mujoco.MjSpec, config: RopeConfig, first: int, last: int) -> None:
    """Add the beads first to last as a chain of ball joints with one free bead as its root."""
    length, turn = config.bead_length, 2 * np.pi / config.beads
    radius = length / (2 * np.sin(np.pi / config.beads))
    joint = {"type": mujoco.mjtJoint.mjJNT_BALL, "damping": [config.joint_damping, 0.0, 0.0]}

    def add_bead(parent: mujoco.MjsBody, bead: int, pos: list[float], angle: float) -> Any:
        quat = [np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]
        body = parent.add_body(name=f"bead{bead}", pos=pos, quat=quat)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0.0, 0.0, 0.0, length, 0.0, 0.0],
            size=[config.radius, 0.0, 0.0],
            density=config.density,
            # without friction
            condim=1,
        )
        return body

    # Bead k of the plain loop starts at angle turn * k of the circle and points along the chord to
    # the next vertex, which is the tangent half a bead further on.
    root = (first + last + 1) // 2
    start = [radius * np.cos(turn * root), radius * np.sin(turn * root), 0.0]
    # The root in the middle (published: at the start) halves the longest lever from root to end,
    # and with it the errors that add up on the way. MuJoCo integrates joint angles, which differ
    # between the two, so that beads end up millimetres apart after an action.
    free = add_bead(spec.worldbody, root, start, turn * (root + 0.5) + np.pi / 2)
    free.add_freejoint()
    body = free
    for bead in range(root + 1, last + 1):
        body = add_bead(body, bead, [length, 0.0, 0.0], turn)
        body.add_joint(**joint)
    # Before the root, the joint is at the bead's own end, which is the start of its parent. In the
    # parent's frame the bead's start lies one length back along its direction, (cos, -sin) of turn.
    body, back = free, [-length * np.cos(turn), length * np.sin(turn), 0.0]
    for bead in range(root - 1, first - 1, -1):
        body = add_bead(body, bead, back, -turn)
        body.add_joint(**joint, pos=[length, 0.0, 0.0])


def _join(spec: mujoco.MjSpec, config: RopeConfig, last: int, after: int) -> None:
    """Constrain the end of bead `last` to the start of bead `after`."""
    joined = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_CONNECT,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=f"bead{last}",
        name2=f"bead{after}",
    )
    # the anchor in the frame of the first body: the end of bead `last`
    joined.data[0:3] = [config.bead_length, 0.0, 0.0]
    joined.solref = list(_CLOSURES["closure_solref"])
    joined.solimp = list(_CLOSURES["closure_solimp"])
    # Their capsules overlap where they meet. MuJoCo exempts parent and child from collision, but
    # these two belong to different trees.
    spec.add_exclude(bodyname1=f"bead{last}", bodyname2=f"bead{after}")


def sub_chains(config: RopeConfig) -> list[tuple[int, int]]:
    """Return the first and last bead of each sub-chain; sizes differ by at most one bead."""
    cuts = [round(k * config.beads / config.sub_chains) for k in range(config.sub_chains + 1)]
    return [(first, after - 1) for first, after in zip(cuts[:-1], cuts[1:], strict=True)]
