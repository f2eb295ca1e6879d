"""The closed rope: its MuJoCo model, and conversion between configurations and qpos.

Bead i is a rigid capsule from vertex i to vertex i + 1. A *configuration* is the (beads, 3) array
of vertices in metres, z up, in the order in which the rope runs. MuJoCo needs kinematic trees, so
the loop is cut into sub-chains. Each is a chain of ball joints with one free bead as its root;
`connect` equality constraints pull the end of each sub-chain to the start of the next.

Quaternions are (w, x, y, z). The trees are described by arrays over the beads: `order` lists
parents before their children; `parent` is -1 at a root; `at` is the index in qpos at which a bead's
numbers begin; `rest` is its orientation relative to its parent at zero joint angle.
Source: arXiv 2505.18028 for the constants. All beads are equal here; in the published asset their
lengths vary.

After a change run `pytest tests/rope/test_rope.py`; if the same configuration moves differently,
raise the format in _PUBLISHED: shipped states and recordings are refused until they are made again.
"""

import hashlib
import json
from dataclasses import asdict, fields, replace
from functools import cache, lru_cache
from itertools import pairwise
from typing import Annotated, Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from knotgym.common import Array, InvalidInput, Mark, configuration, inner, kernel
from knotgym.rope import closed_curves
from knotgym.rope.closed_curves import clearance, directions, equal_chords, require_embedded
from knotgym.topology import same_spot

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


_DERIVED = Mark("derived")  # follows from a task's own settings: its keyword `rope` can't set it
_SHAPE = Mark("shape")  # states at rest depend on it


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

    beads: Annotated[PositiveInt, _DERIVED] = 100
    length: Annotated[PositiveFloat, _SHAPE] = 1.33
    radius: Annotated[PositiveFloat, _SHAPE] = 0.005
    density: PositiveFloat = 1000.0
    medium_density: PositiveFloat = 10000.0
    joint_damping: NonNegativeFloat = 0.01
    sub_chains: Annotated[PositiveInt, _DERIVED] = 7
    timestep: Annotated[PositiveFloat, _DERIVED] = 0.008
    frame_skip: Annotated[PositiveInt, _DERIVED] = 24
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

    @classmethod
    @cache  # each batch of episodes asks several times
    def of(cls, beads: int) -> "RopeConfig":
        """Return the rope of so many beads of the usual length; 200 of them make 2.66 m.

        Sub-chains keep their size, so that closing errors do too.
        """
        usual = cls()
        # As many beads to a metre, and closures as far apart, as in the usual rope.
        share = beads / usual.beads
        chains = max(2, round(share * usual.sub_chains))
        return replace(usual, beads=beads, length=share * usual.length, sub_chains=chains)

    @property
    def bead_length(self) -> float:
        """Distance between neighbouring vertices, metres."""
        return self.length / self.beads

    @property
    def chains(self) -> list[tuple[int, int]]:
        """First and last bead of each sub-chain; sizes differ by at most one bead."""
        cuts = [round(k * self.beads / self.sub_chains) for k in range(self.sub_chains + 1)]
        return [(first, after - 1) for first, after in pairwise(cuts)]

    @property
    def added(self) -> dict[str, Any]:
        """Parameters that the published rope doesn't have, where they differ from their default."""
        new = (field for field in fields(self) if field.name not in _PUBLISHED)
        values = ((field.name, getattr(self, field.name), field.default) for field in new)
        return {name: value for name, value, default in values if value != default}

    @property
    def fingerprint(self) -> str:
        """Hash of what differs from the published rope, 16 hexadecimal digits.

        Files hold that of the rope they were made with.
        """
        known = {name: value for name, value in asdict(self).items() if name in _PUBLISHED}
        text = json.dumps({**_PUBLISHED, **known, **self.added}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def unlike(self, fingerprint: object) -> str:
        """Say how the rope that something was made with differs; "" if it has this fingerprint."""
        mine = self.fingerprint
        return f"rope model {fingerprint}, this version has {mine}" if fingerprint != mine else ""


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
        parents = self.model.body_parentid[self.bodies].tolist()
        self._trees = (
            np.argsort(self.bodies),  # MuJoCo numbers a parent's body before its children's
            np.array([bead_of.get(parent, -1) for parent in parents]),
            self.model.jnt_qposadr[self.model.body_jntadr[self.bodies]].astype(np.int64),
            self.model.body_quat[self.bodies].copy(),
        )
        # Chords between two sub-chains may have any length up to the gap that closures leave.
        self._next_in_chain = np.ones(beads, dtype=bool)
        self._next_in_chain[[last for _, last in self.config.chains]] = False

    start_qpos = closed_curves.start_qpos
    noised = staticmethod(closed_curves.noised)

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
        # a writable array, because numba would compile `_forward` again for a read-only one
        q = np.require(qpos, np.float64, ["C", "W"])
        rows = q.reshape(-1, self.nq)
        points, gaps = np.empty((len(rows), self.config.beads, 3)), np.empty(len(rows))
        _forward(rows, *self._trees, self.config.bead_length, points, gaps)
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
        qpos = self.turned_qpos(rows, _transported(directions(rows), *self._trees[:2]))
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
        _backward(np.ascontiguousarray(points), world, *self._trees, qpos)
        return qpos

    def least_clearance(self, points: Array) -> float:
        """Return how near noise may bring the beads of a rope, float64 (beads, 3), metres.

        Beads at rest may touch or overlap already, so the bound is relative to where they are now;
        beads that are apart may come to touch.
        """
        return clearance(points, 2 * self.config.radius) - 0.001

    def loop(self) -> Array:
        """Return the plain loop, flat, anticlockwise from +x: float64 (beads, 3), metres."""
        turn = 2 * np.pi * np.arange(self.config.beads) / self.config.beads
        # circumradius of a regular polygon, so that its sides are exactly one bead long
        radius = self.config.bead_length / (2 * np.sin(np.pi / self.config.beads))
        return radius * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)

    def from_curve(
        self, curve: ArrayLike, *, max_overlap: float = 0.001, embedded: bool = False
    ) -> Array:
        """Turn a closed polyline into a configuration of this rope.

        A curve that already is a configuration (beads of the right length inside every sub-chain,
        closing gaps below a bead's diameter) is returned unchanged. Any other curve is cut into
        equal chords, scaled to the rope's length and centred.

        Args:
            curve: (n, 3), n >= 4, any unit; the last point is joined to the first, which may also
                be repeated at the end. Of points on one spot one is kept.
            max_overlap: largest overlap of two beads that aren't neighbours, metres.
            embedded: whether the curve itself must be embedded, as every knot is.

        Returns:
            float64 (beads, 3), metres.

        Raises:
            InvalidInput: the points are not finite or not below 1e100, the curve is not closed or
                turns too sharply, or beads would overlap; or it must be embedded, and jumps, meets
                itself or has more than 20,000 points.
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
        if embedded:
            require_embedded(np.asarray(curve, dtype=np.float64))
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
    for first, last in config.chains:
        _add_chain(spec, config, first, last)
    for _, last in config.chains:
        _join(spec, config, last, (last + 1) % config.beads)
    return spec.compile()


def _add_chain(spec: mujoco.MjSpec, config: RopeConfig, first: int, last: int) -> None:
    """Add the beads first to last as a chain of ball joints with one free bead as its root."""
    length, turn = config.bead_length, 2 * np.pi / config.beads
    radius = length / (2 * np.sin(np.pi / config.beads))
    joint = {"type": mujoco.mjtJoint.mjJNT_BALL, "damping": [config.joint_damping, 0.0, 0.0]}

    def _add_bead(parent: mujoco.MjsBody, bead: int, pos: list[float], angle: float) -> Any:
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
    body = free = _add_bead(spec.worldbody, root, start, turn * (root + 0.5) + np.pi / 2)
    free.add_freejoint()
    for bead in range(root + 1, last + 1):
        body = _add_bead(body, bead, [length, 0.0, 0.0], turn)
        body.add_joint(**joint)
    # Before the root, the joint is at the bead's own end, which is the start of its parent. In the
    # parent's frame the bead's start lies one length back along its direction, (cos, -sin) of turn.
    body, back = free, [-length * np.cos(turn), length * np.sin(turn), 0.0]
    for bead in range(root - 1, first - 1, -1):
        body = _add_bead(body, bead, back, -turn)
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


@kernel
def _forward(
    qpos: Array,
    order: Array,
    parent: Array,
    at: Array,
    rest: Array,
    length: float,
    points: Array,
    gaps: Array,
) -> None:
    """Compute the vertices of generalized positions and the largest gap between joined ends.

    Args:
        qpos: float64 (n, nq).
        order, parent, at, rest: the trees, see the module.
        length: length of a bead, metres.
        points: float64 (n, beads, 3), metres; output.
        gaps: float64 (n,), metres; output.
    """
    beads = len(order)
    world = np.empty((beads, 4))
    axis = np.empty((beads, 3))
    turned, joint = np.empty(4), np.empty(4)
    for row in range(len(qpos)):
        q = qpos[row]
        for k in range(beads):
            bead = order[k]
            up, a = parent[bead], at[bead]
            if up < 0:
                # a free joint: position in q[a : a + 3], orientation in q[a + 3 : a + 7]
                _unit(q[a + 3 : a + 7], world[bead])
            else:
                # world = parent's world * rest * ball joint; MuJoCo normalizes the joint's
                # quaternion before use, and so must we
                _multiply(world[up], rest[bead], turned)
                _unit(q[a : a + 4], joint)
                _multiply(turned, joint, world[bead])
            # a bead lies along its body's x axis: the first column of the rotation matrix
            w, x, y, z = world[bead, 0], world[bead, 1], world[bead, 2], world[bead, 3]
            axis[bead, 0] = length * (1 - 2 * (y * y + z * z))
            axis[bead, 1] = length * 2 * (x * y + w * z)
            axis[bead, 2] = length * 2 * (x * z - w * y)
            for c in range(3):
                if up < 0:
                    points[row, bead, c] = q[a + c]
                elif up == bead - 1:
                    # after the root: the bead starts where its parent ends
                    points[row, bead, c] = points[row, up, c] + axis[up, c]
                else:
                    # before the root: the bead ends where its parent starts
                    points[row, bead, c] = points[row, up, c] - axis[bead, c]
        # Inside a sub-chain the next vertex is the bead's end by construction, so that only the
        # soft closures between sub-chains contribute here.
        gaps[row] = 0.0
        for bead in range(beads):
            square = 0.0
            for c in range(3):
                apart = points[row, (bead + 1) % beads, c] - points[row, bead, c] - axis[bead, c]
                square += apart * apart
            gaps[row] = max(gaps[row], np.sqrt(square))


@kernel
def _transported(along: Array, order: Array, parent: Array) -> Array:
    """Return the orientations of beads with the smallest twist, float64 (n, beads, 4).

    Vertices alone don't determine the rotation of a bead about its own axis; each bead gets its
    parent's orientation turned by the shortest arc (parallel transport).

    Args:
        along: float64 (n, beads, 3), unit vectors of the beads.
        order, parent: the trees, see the module.
    """
    world = np.empty((len(along), len(order), 4))
    x_axis, arc = np.empty(3), np.empty(4)
    x_axis[0], x_axis[1], x_axis[2] = 1.0, 0.0, 0.0
    for row in range(len(along)):
        for k in range(len(order)):
            bead = order[k]
            up = parent[bead]
            if up < 0:
                _shortest_arc(x_axis, along[row, bead], world[row, bead])
            else:
                _shortest_arc(along[row, up], along[row, bead], arc)
                # the arc is applied in the world's frame, so it stands on the left
                _multiply(arc, world[row, up], world[row, bead])
    return world


@kernel
def _backward(
    points: Array, world: Array, order: Array, parent: Array, at: Array, rest: Array, qpos: Array
) -> None:
    """Compute the generalized positions of beads that lie and are turned as given.

    Args:
        points: float64 (n, beads, 3), metres.
        world: float64 (n, beads, 4), the beads' orientations.
        order, parent, at, rest: the trees, see the module.
        qpos: float64 (n, nq); output.
    """
    back = np.empty(4)
    for row in range(len(points)):
        for bead in order:
            up, a = parent[bead], at[bead]
            if up < 0:
                for c in range(3):
                    qpos[row, a + c] = points[row, bead, c]
                for c in range(4):
                    qpos[row, a + 3 + c] = world[row, bead, c]
            else:
                # joint = (parent's world * rest)^-1 * world; the inverse of a unit quaternion is
                # its conjugate
                _multiply(world[row, up], rest[bead], back)
                for c in range(1, 4):
                    back[c] *= -1.0
                _multiply(back, world[row, bead], qpos[row, a : a + 4])


@inner
def _unit(q: Array, unit: Array) -> None:
    size = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for c in range(4):
        unit[c] = q[c] / size


@inner
def _multiply(a: Array, b: Array, product: Array) -> None:
    """Write the Hamilton product a b; `product` must share no memory with a or b."""
    product[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    product[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    product[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1]
    product[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]


@inner
def _shortest_arc(a: Array, b: Array, arc: Array) -> None:
    """Write the quaternion of the smallest rotation that takes unit vector a to unit vector b."""
    # (1 + a . b, a x b) = 2 cos(t / 2) (cos(t / 2), sin(t / 2) n) for angle t and axis n
    x, y, z = b[0], b[1], b[2]
    arc[0] = 1 + a[0] * x + a[1] * y + a[2] * z
    if arc[0] < 1e-12:  # opposite: half a turn about any perpendicular axis
        # cross with the z axis, or with x where a is nearly along z
        arc[0] = 0.0
        x, y, z = (0.0, 0.0, 1.0) if abs(a[2]) < 0.9 else (1.0, 0.0, 0.0)
    arc[1] = a[1] * z - a[2] * y
    arc[2] = a[2] * x - a[0] * z
    arc[3] = a[0] * y - a[1] * x
    _unit(arc, arc)
