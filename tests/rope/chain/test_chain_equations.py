"""The compiled equations of motion, contact forces and the proof of passage, against twins written
plainly in NumPy.
"""

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from knotgym.rope.chain import banded, contact, dynamics, passage
from knotgym.rope.chain.chain_simulation import _physics_of
from knotgym.rope.chain.contact import LISTED, ROWS, Pairs
from knotgym.rope.chain.layout import EDGE_I, EDGE_J, GAP, NORMAL, ON_I, ON_J, Physics
from knotgym.rope.chain.passage import MOST_MOVE
from knotgym.rope.chain.simd import LANES
from knotgym.rope.model import Rope
from knotgym.states import read_states, shipped

# with the wrappers through which Python can call them
assemble, set_lengths, tangents, factor, forward, backward = (
    njit(one.py_func)
    for one in (
        dynamics.assemble,
        dynamics.set_lengths,
        dynamics.tangents,
        banded.factor,
        banded.forward,
        banded.backward,
    )
)
find_rows, list_pairs, middles, push_apart, judge = (
    njit(one.py_func)
    for one in (
        contact.find_rows,
        contact.list_pairs,
        contact.middles,
        contact.push_apart,
        passage.judge,
    )
)
pytestmark = pytest.mark.thorough  # compiles the solver's parts, which have no cache of their own

Array = NDArray[np.float64]
N = 100
H = 0.02  # seconds of a substep


@pytest.fixture(scope="module")
def tangled() -> Array:
    """Vertices of LANES ropes of four crossings: float64 (n, 3, LANES)."""
    states = read_states(shipped(), images=False)
    rows = np.flatnonzero(states.nx == 4)[:LANES]
    return np.ascontiguousarray(np.moveaxis(states.points[rows], 0, -1))


def solved(
    tangent: Array, side: Array, v: Array, spin: Array, pull: Array, step: Array, physics: Physics
) -> tuple[tuple[Array, ...], Array, Array]:
    """Solve a substep's system; return it factored, its right side half way, and the solution."""
    n = len(tangent)
    shapes = ((n + 1, 10), (n, 16), (n, 12), (n, 12))
    system = tuple(np.full((*shape, LANES), np.nan) for shape in shapes)
    right = np.empty((n + 1, 4, LANES))
    assemble(tangent, side, v, spin, pull, step, physics, system, right)
    factor(system)
    forward(system, right, 0)
    free = right.copy()
    backward(system, free)
    return system, right, free


def velocities(solution: Array) -> Array:
    n = len(solution) - 1
    return np.concatenate([solution[n:, :3], solution[1:n, :3]])


def across(side: Array, tangent: Array) -> Array:
    """Unit vectors across the tangents."""
    side = side - (side * tangent).sum(axis=1, keepdims=True) * tangent
    return side / np.linalg.norm(side, axis=1, keepdims=True)


def dense(given: list[Array], h: float, physics: Physics) -> tuple[Array, Array]:
    """Velocities and spins after a substep of one rope, see `dynamics`."""
    tangent, side, v, spin, pull = given
    mass, transverse, roll_mass, length, *drag, stretch, damping = physics[:10]
    across, along, turn, roll = drag
    matrix, right = np.zeros((4 * N, 4 * N)), np.zeros(4 * N)
    now = np.concatenate([v, spin[:, None]], axis=1).reshape(-1)

    def add(rows: Array, weight: float, target: Array | float = 0.0) -> None:
        """The form weight |rows z - target|^2 / 2."""
        nonlocal matrix, right
        matrix += weight * rows.T @ rows
        right += weight * rows.T @ (target * np.ones(len(rows)))

    turning = np.zeros((N, 3, 4 * N))
    for i in range(N):
        j, t = (i + 1) % N, tangent[i]
        centre, apart = np.zeros((3, 4 * N)), np.zeros((3, 4 * N))
        centre[:, 4 * i : 4 * i + 3] = centre[:, 4 * j : 4 * j + 3] = 0.5 * np.eye(3)
        apart[:, 4 * j : 4 * j + 3], apart[:, 4 * i : 4 * i + 3] = np.eye(3), -np.eye(3)
        spun = np.zeros((1, 4 * N))
        spun[0, 4 * i + 3] = 1.0
        turning[i] = np.cross(t, apart, axisb=0, axisc=0) / length + t[:, None] * spun
        add(centre, mass / h, centre @ now)
        add(apart, transverse / length**2 / h, apart @ now)
        add(spun, roll_mass / h, spun @ now)
        add(t[None] @ apart, stretch)
        for axis, k in ((side[i], across), (np.cross(t, side[i]), across), (t, along)):
            speed = axis @ centre @ now
            add(axis[None] @ centre, 2 * k * abs(speed), speed / 2)
        fast = float(np.linalg.norm(apart @ now))
        add(apart, 2 * turn * fast / length**3, apart @ now / 2)
        add(spun, 2 * roll * abs(spin[i]), spin[i] / 2)
        # what the compiled code adds for the chord's own direction, which STRETCH keeps at 0
        add(t[None] @ apart, (damping[i] + damping[j]) / length**2)
    for i in range(N):
        add(turning[i] - turning[i - 1], damping[i])
    right.reshape(N, 4)[:, :3] += pull
    found = np.empty((N, 4))
    found.reshape(-1)[:] = np.linalg.solve(matrix, right)
    return found[:, :3], found[:, 3]


def test_a_substep_solves_the_equations_of_motion(rope: Rope) -> None:
    physics = _physics_of(rope)
    rng = np.random.default_rng(0)
    v, pull = rng.normal(0, 0.2, (N, 3, LANES)), rng.normal(0, 0.1, (N, 3, LANES))
    spin = rng.normal(0, 3.0, (N, LANES))
    tangent, side = rng.normal(size=(2, N, 3, LANES))
    tangent[1:] += 2 * tangent[:-1]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side, step = across(side, tangent), np.linspace(0.005, 0.03, LANES)[None]
    *_, free = solved(tangent, side, v, spin, pull, step, physics)
    for lane in (0, LANES - 1):
        own = [one[..., lane] for one in (tangent, side, v, spin, pull)]
        told, told_spin = dense(own, step[0, lane], physics)
        assert np.abs(velocities(free)[..., lane] - told).max() < 1e-8 * np.abs(told).max()
        assert np.abs(free[:N, 3, lane] - told_spin).max() < 1e-8 * np.abs(told_spin).max()


def empty_pairs(n: int) -> Pairs:
    return np.empty(n + 1, np.int64), np.empty(n * n, np.int64)


def squeezed(x: Array, speed: float) -> Array:
    """Velocities that press a rope flat, so that its strands meet."""
    v = np.zeros_like(x)
    v[:, 2] = -speed * np.sign(x[:, 2] - x[:, 2].mean(axis=0))
    return v


def test_contact_forces_are_those_of_a_plain_gauss_seidel(rope: Rope, tangled: Array) -> None:
    physics = _physics_of(rope)
    x, n = tangled.copy(), len(tangled)
    x[:, 2] *= 0.3  # strands lie on each other at the crossings
    v, spin, step = squeezed(x, 0.4), np.zeros((n, LANES)), np.full((1, LANES), H)
    tangent, up = np.empty_like(x), np.zeros_like(x)
    tangents(x, v, np.zeros((1, LANES)), tangent)
    up[:, 2] = 1.0
    system, right, free = solved(
        tangent, across(up, tangent), v, spin, np.zeros_like(x), step, physics
    )
    middle, pairs = np.empty_like(x), empty_pairs(n)
    middles(x, middle)
    list_pairs(middle, LISTED, pairs)
    rows, found, motion = (
        np.zeros((ROWS, 8, LANES)),
        np.zeros(LANES, np.int64),
        np.empty((n, LANES)),
    )
    find_rows(x, velocities(free), tangent, middle, pairs, step, physics, motion, rows, found)
    assert found.max() > 3
    pushed = right.copy()
    push_apart(rows, found, int(found.max()), velocities(free), step, physics, system, pushed)
    backward(system, pushed)

    slope = physics.contact_stiffness * H + physics.contact_damping
    for lane in range(LANES):
        count = int(found[lane])
        jacobian = np.zeros((count, n, 3))
        for r in range(count):
            row = rows[r, :, lane]
            i, j, normal = int(row[EDGE_I]), int(row[EDGE_J]), row[NORMAL : NORMAL + 3]
            for vertex, share in (
                (i, row[ON_I] - 1),
                ((i + 1) % n, -row[ON_I]),
                (j, 1 - row[ON_J]),
                ((j + 1) % n, row[ON_J]),
            ):
                jacobian[r, vertex] += share * normal
        answer = np.empty((count, n, 3))  # A^-1 J^T, a solution for each contact
        for r in range(count):
            unit = np.zeros((n + 1, 4, LANES))
            unit[n, :3, lane], unit[1:n, :3, lane] = jacobian[r, 0], jacobian[r, 1:]
            forward(system, unit, 0)
            backward(system, unit)
            answer[r] = velocities(unit)[..., lane]
        weight = np.einsum("qvc,rvc->qr", jacobian, answer)
        speed = np.einsum("rvc,vc->r", jacobian, velocities(free)[..., lane])
        gap, force = rows[:count, GAP, lane] - 2 * physics.radius, np.zeros(count)
        for _ in range(400):
            for r in range(count):
                own = weight[r, r]
                without = speed[r] + weight[r] @ force - own * force[r]
                spring = gap[r] / H if gap[r] > 0 else physics.contact_stiffness * gap[r] / slope
                soft = -slope * (spring + without) / (1 + slope * own)
                hard = (-(rows[r, GAP, lane] - physics.floor) / H - without) / own
                force[r] = max(0.0, soft, hard)
        told = velocities(free)[..., lane] + np.einsum("r,rvc->vc", force, answer)
        assert np.abs(velocities(pushed)[..., lane] - told).max() < 1e-6
        # no pair ends the substep nearer than the floor
        parting = np.einsum("rvc,vc->r", jacobian, velocities(pushed)[..., lane])
        assert (rows[:count, GAP, lane] + H * parting > physics.floor - 1e-7).all()


def distances(x: Array, pairs: Array, places: int = 21) -> Array:
    """Distance of pairs of edges of one rope (n, 3), from a grid of places on both: an upper bound
    that is off by less than half a step along the edges.
    """
    ends, s = np.roll(x, -1, axis=0), np.linspace(0, 1, places)[:, None]
    one, other = (
        x[edge][:, None] * (1 - s) + ends[edge][:, None] * s for edge in (pairs[:, 0], pairs[:, 1])
    )
    apart: Array = np.linalg.norm(one[:, :, None] - other[:, None], axis=-1).min(axis=(1, 2))
    return apart


@pytest.mark.parametrize(
    ("size", "waves"), [(0.005, 1), (0.014, 5), (0.018, 1), (0.02, 1), (0.02, 2)]
)
def test_what_is_judged_safe_is_for_all_edges(tangled: Array, size: float, waves: int) -> None:
    x, n = tangled, len(tangled)
    length = float(np.linalg.norm(np.roll(x, -1, axis=0) - x, axis=1).mean())
    # strands move up and down, smoothly along the rope, and edges keep their length
    phase = np.arange(n)[:, None] / n + np.arange(LANES) / LANES
    new = x.copy()
    new[:, 2] += size * np.sin(2 * np.pi * waves * phase)
    set_lengths(new, length, 4)
    tangent, middle, motion = np.empty_like(x), np.empty_like(x), np.empty((n, LANES))
    tangents(x, np.zeros_like(x), np.zeros((1, LANES)), tangent)
    pairs = empty_pairs(n)
    middles(x, middle)
    list_pairs(middle, LISTED, pairs)
    accepted = np.zeros(LANES, dtype=np.bool_)
    judge(x, new, tangent, middle, motion, pairs, empty_pairs(n), length, accepted)
    i, j = np.triu_indices(n, 2)
    every = np.stack([i, j], axis=1)[(j - i < n - 1)]
    for lane in range(LANES):
        before, after = x[..., lane], new[..., lane]
        # the others' midpoints are further apart than two edges and both motions
        between = np.linalg.norm(before[every[:, 0]] - before[every[:, 1]], axis=1)
        near = every[between < 0.06]
        move = after - before
        ends = [(near[:, 0] + a) % n for a in (0, 1)], [(near[:, 1] + b) % n for b in (0, 1)]
        relative = np.max(
            [np.linalg.norm(move[p] - move[q], axis=1) for p in ends[0] for q in ends[1]], axis=0
        )
        both = distances(before, near) + distances(after, near)
        if accepted[lane]:
            assert (both > relative).all()
        stretched = np.abs(np.linalg.norm(np.roll(after, -1, 0) - after, axis=1) / length - 1)
        small = np.linalg.norm(move, axis=1).max() < MOST_MOVE and stretched.max() < 5e-4
        if small and (both > relative + length / 20).all():  # the grid's error is below that
            assert accepted[lane]
