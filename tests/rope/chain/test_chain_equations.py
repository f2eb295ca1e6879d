"""The compiled equations are those of the module's text, written out densely."""

from typing import Any

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from knotgym.rope.chain.banded import backward, factor, forward
from knotgym.rope.chain.chain_simulation import physics_of
from knotgym.rope.chain.dynamics import assemble
from knotgym.rope.chain.layout import Physics
from knotgym.rope.chain.simd import LANES
from knotgym.rope.model import Rope

Array = NDArray[np.float64]
N = 100


def empty_system() -> tuple[Array, ...]:
    shapes = ((N + 1, 10), (N, 16), (N, 12), (N, 12))
    return tuple(np.full((*shape, LANES), np.nan) for shape in shapes)


def dense(
    tangent: Array, side: Array, v: Array, spin: Array, pull: Array, h: float, physics: Physics
) -> tuple[Array, Array]:
    """Velocities and spins after a substep of one rope, see `dynamics`."""
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


@njit
def solve(*given: Any) -> None:
    """Call what only compiled code may call."""
    tangent, side, v, spin, pull, step, physics, system, right = given
    assemble(tangent, side, v, spin, pull, step, physics, system, right)
    factor(system)
    forward(system, right, 0)
    backward(system, right)


@pytest.mark.thorough
def test_a_substep_solves_the_equations_of_motion(rope: Rope) -> None:
    physics = physics_of(rope)
    rng = np.random.default_rng(0)
    v, pull = rng.normal(0, 0.2, (N, 3, LANES)), rng.normal(0, 0.1, (N, 3, LANES))
    spin = rng.normal(0, 3.0, (N, LANES))
    tangent, side = rng.normal(size=(2, N, 3, LANES))
    tangent[1:] += 2 * tangent[:-1]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side -= (side * tangent).sum(axis=1, keepdims=True) * tangent
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    step = np.linspace(0.005, 0.03, LANES)[None]
    system, right = empty_system(), np.empty((N + 1, 4, LANES))
    solve(tangent, side, v, spin, pull, step, physics, system, right)
    for lane in (0, LANES - 1):
        told, told_spin = dense(
            tangent[..., lane],
            side[..., lane],
            v[..., lane],
            spin[:, lane],
            pull[..., lane],
            step[0, lane],
            physics,
        )
        found = np.concatenate([right[N:, :3, lane], right[1:N, :3, lane]])
        assert np.abs(found - told).max() < 1e-8 * np.abs(told).max()
        assert np.abs(right[:N, 3, lane] - told_spin).max() < 1e-8 * np.abs(told_spin).max()
