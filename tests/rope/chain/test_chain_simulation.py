"""The chain engine moves ropes as MuJoCo does, to a millimetre, keeps the knot, and repeats
itself to the bit.
"""

import platform

import mujoco
import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from knotgym.rope.chain.chain_simulation import (
    _WEIGHT,
    ChainSimulation,
    _settled,
    _sides,
    physics_of,
)
from knotgym.rope.chain.contact import closest
from knotgym.rope.chain.simd import LANES, put
from knotgym.rope.closed_curves import clearance, directions
from knotgym.rope.model import Rope, RopeConfig
from knotgym.rope.mujoco_simulation import MujocoSimulation
from knotgym.states import read_states, shipped
from knotgym.topology import UNKNOT, find_crossings, knot_type, label, label_many, shows

from ...conftest import curled, trefoil

Array = NDArray[np.float64]
LENGTH = RopeConfig().bead_length


@pytest.fixture(scope="module")
def curls(rope: Rope) -> Array:
    """qpos of ropes of 0 to 4 curls."""
    return np.stack([rope.qpos(rope.from_curve(curled(nx))) for nx in range(5)])


def test_beads_are_turned_as_mujoco_turns_them(rope: Rope) -> None:
    qpos = read_states(shipped(), images=False).qpos[::8]
    points, data = rope.points(qpos), mujoco.MjData(rope.model)
    found, along = _sides(rope, qpos, points), directions(points)
    for row, positions in enumerate(qpos):
        data.qpos[:] = positions
        mujoco.mj_kinematics(rope.model, data)
        right = data.xmat[rope.bodies].reshape(-1, 3, 3)[:, :, 1]
        right -= (right * along[row]).sum(axis=1, keepdims=True) * along[row]
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        # elsewhere MuJoCo adds the terms of a product in another order
        exact = platform.machine() == "x86_64"
        assert np.array_equal(found[row], right) if exact else np.allclose(found[row], right)


def pulls(count: int, steps: int, seed: int = 0) -> list[tuple[NDArray[np.int64], Array]]:
    """The same for rope i among any number."""
    rngs = [np.random.default_rng([seed, i]) for i in range(count)]
    return [
        (
            np.array([rng.integers(100) for rng in rngs]),
            np.array([rng.uniform(-0.2, 0.2, 3) for rng in rngs]),
        )
        for _ in range(steps)
    ]


def moved(simulation: ChainSimulation, steps: int, seed: int = 0) -> Array:
    """States after random actions."""
    for beads, forces in pulls(simulation.count, steps, seed):
        simulation.step(beads, forces)
    return simulation.states()


def lengths(points: Array) -> Array:
    return np.linalg.norm(np.roll(points, -1, axis=-2) - points, axis=-1)


def test_ropes_laid_along_curves_move_as_those_laid_with_their_twist(
    rope: Rope, curls: Array
) -> None:
    by_qpos, by_points = ChainSimulation(5, rope), ChainSimulation(5, rope)
    by_qpos.set_qpos(curls)
    beads, forces = pulls(5, 1)[0]
    before = by_qpos.points.copy()
    by_points.set_points(before, by_qpos.velocities())
    assert np.allclose(by_points.points, before, atol=1e-9)
    by_qpos.step(beads, forces)
    by_points.step(beads, forces)
    off = np.linalg.norm(by_points.points - by_qpos.points, axis=2)
    # how beads are turned about the rope matters little, and is all that differs
    assert off.mean() < 1e-3 and by_points.velocities().any()


def test_ropes_laid_along_uneven_curves_get_edges_of_one_length(rope: Rope, curls: Array) -> None:
    chain = ChainSimulation(5, rope)
    uneven = rope.points(curls) * 1.02
    chain.set_points(uneven, np.zeros_like(uneven))
    assert np.abs(lengths(chain.points) / LENGTH - 1).max() < 1e-3
    assert chain.step(*pulls(5, 1)[0]).all() and (chain.applied_shares == 1).all()


def test_beads_end_where_mujoco_puts_them(rope: Rope, curls: Array) -> None:
    chain, mujoco = ChainSimulation(5, rope), MujocoSimulation(5, rope)
    chain.set_qpos(curls)
    mujoco.set_qpos(curls)
    for bar, (beads, forces) in zip((1e-3, 2e-3, 3e-3), pulls(5, 3), strict=True):
        chain.step(beads, forces)
        mujoco.step(beads, forces)
        assert np.linalg.norm(chain.points - mujoco.points, axis=2).mean() < bar


def test_a_rope_left_alone_stays(rope: Rope, curls: Array) -> None:
    chain = ChainSimulation(5, rope)
    chain.set_qpos(curls)
    before = chain.points.copy()
    for _ in range(3):
        chain.step(np.zeros(5, dtype=int), np.zeros((5, 3)))
    assert np.abs(chain.points - before)[0].max() < 1e-12  # others may push themselves apart
    assert np.abs(chain.points - before).max() < 1e-3


def test_a_turned_rope_moves_alike(rope: Rope) -> None:
    # MuJoCo's drag depends on the beads' own axes, which a rope laid from points chooses anew
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    chain = ChainSimulation(2, rope)
    states = chain.states().reshape(2, 100, 10)
    for at in (0, 3, 6):
        states[1, :, at : at + 3] = states[0, :, at : at + 3] @ turn.T
    chain.restore(states)
    force = np.array([0.05, 0.2, 0.1])
    for _ in range(4):
        chain.step([20, 20], np.stack([force, turn @ force]))
    assert np.abs(chain.points[0] @ turn.T - chain.points[1]).max() < 1e-9
    assert np.abs(chain.points[0] - rope.loop()).max() > 0.02


def test_edges_keep_their_length(rope: Rope, curls: Array) -> None:
    chain = ChainSimulation(5, rope)
    chain.set_qpos(curls)
    for step in range(10):
        chain.step(np.full(5, 30), np.full((5, 3), 0.2 * (-1) ** step))
        assert np.abs(lengths(chain.points) / LENGTH - 1).max() < 1e-3


def test_the_numbers_are_mujocos_own(rope: Rope) -> None:
    physics = physics_of(rope)
    damping = physics.damping
    volume = np.pi * 0.005**2 * LENGTH + 4 / 3 * np.pi * 0.005**3
    assert physics.mass == pytest.approx(1000 * volume)
    assert damping.max() == 0.01 and (damping == 0).sum() == 7 and damping[0] == 0
    assert physics.radius == 0.005


def test_contacts_are_as_stiff_on_processors_that_sum_in_another_order(rope: Rope) -> None:
    for weight in (_WEIGHT, float(rope.model.body_invweight0[1, 0]), 1 / 3):
        assert _settled(weight * (1 - 2e-15)) == _settled(weight) == _settled(weight * (1 + 2e-15))
    assert physics_of(rope).contact_stiffness == 113.21720222318902  # recordings were made with it


def test_strands_pulled_through_each_other_stay_apart(rope: Rope, curls: Array) -> None:
    """A bead of the upper strand pulled straight down onto the lower one, with full force."""
    chain = ChainSimulation(1, rope)
    chain.set_qpos(curls[2:3])
    for _ in range(12):
        crossings = find_crossings(chain.points[0])
        bead = int(crossings.over_place[0]) % 100 if crossings.nx else 0
        chain.step([bead], np.array([[0.0, 0.0, -0.2]]))
        assert shows(label(chain.points[0]), UNKNOT)
        assert clearance(chain.points[0], 1.0) > 0.002


def test_random_play_never_ties_or_unties_a_knot(rope: Rope, curls: Array) -> None:
    knotted = rope.qpos(rope.from_curve(trefoil()))[None]
    chain = ChainSimulation(6, rope)
    chain.set_qpos(np.concatenate([curls, knotted]))
    for beads, forces in pulls(6, 40, seed=3):
        chain.step(beads, np.sign(forces) * 0.2)
        codes = label_many(chain.points)
        assert all(shows(code, UNKNOT) for code in codes[:5]) and knot_type(codes[5]) == "3_1"
        assert (chain.applied_shares == 1).all()


def test_a_substep_that_cannot_be_proved_safe_is_taken_back(rope: Rope, curls: Array) -> None:
    chain = ChainSimulation(2, rope)
    chain.set_qpos(curls[[0, 2]])
    states = chain.states().reshape(2, 100, 10)
    states[1, :, 3:6] = np.random.default_rng(0).normal(0, 1e9, (100, 3))  # m/s
    chain.restore(states)
    before = chain.points.copy()
    assert chain.step([3, 3], np.zeros((2, 3))).tolist() == [True, True]
    assert (chain.applied_shares == 1).tolist() == [True, False]
    assert np.abs(chain.points - before).max() < 1e-3
    chain.step([3, 3], np.full((2, 3), 0.1))
    assert (chain.applied_shares == 1).all()


def test_a_rope_goes_to_mujoco_and_back(rope: Rope, curls: Array) -> None:
    chain = ChainSimulation(5, rope)
    chain.set_qpos(curls)
    moved(chain, 6)
    qpos = chain.qpos()
    mujoco = MujocoSimulation(5, rope)
    mujoco.set_qpos(qpos)
    assert np.abs(mujoco.points - chain.points).max() < 1e-9
    back = ChainSimulation(5, rope)
    back.set_qpos(qpos)
    still = chain.states().reshape(5, 100, 10)[:, :, [0, 1, 2, 6, 7, 8]]
    assert np.abs(back.states().reshape(5, 100, 10)[:, :, [0, 1, 2, 6, 7, 8]] - still).max() < 1e-6


def test_a_rope_that_the_proof_does_not_cover_is_refused() -> None:
    with pytest.raises(ValueError, match=r"at most 13.* mm long, got 26.60 mm"):
        ChainSimulation(1, Rope(RopeConfig(beads=50)))
    shorter = ChainSimulation(1, Rope(RopeConfig(beads=110)))
    shorter.act(np.full((1, 6), 0.5))
    assert np.abs(lengths(shorter.points) / (1.33 / 110) - 1).max() < 1e-3


def test_edges_are_as_far_apart_as_numpy_says() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(200, 3, LANES))
    x[7] = x[6] + x[101] - x[100]  # parallel to edge 100
    at, found = np.linspace(0, 1, 201)[:, None, None], np.empty((1, LANES))
    for i, j in [(6, 100), *rng.integers(0, 199, (30, 2)).tolist()]:
        if abs(i - j) < 2:
            continue
        write_distance(x, i, j, found)
        one, other = x[i] + at * (x[i + 1] - x[i]), x[j] + at * (x[j + 1] - x[j])
        told = np.sqrt(((one[:, None] - other[None]) ** 2).sum(axis=2)).min(axis=(0, 1))
        assert np.abs(found - told).max() < 0.02 and (found <= told + 1e-12).all()


@njit
def write_distance(x: Array, i: int, j: int, out: Array) -> None:
    put(out, (0,), closest(x, i, j)[0])
