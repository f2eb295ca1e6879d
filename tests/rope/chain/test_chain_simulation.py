"""The chain engine moves ropes as MuJoCo does, to a millimetre, and repeats itself to the bit."""

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.rope.chain.chain_simulation import _WEIGHT, ChainSimulation, _physics_of, _settled
from knotgym.rope.closed_curves import clearance
from knotgym.rope.model import Rope, RopeConfig
from knotgym.rope.mujoco_simulation import MujocoSimulation
from knotgym.topology import UNKNOT, Knot, find_crossings, knot_type, label, label_many

from ...conftest import curled, trefoil

Array = NDArray[np.float64]
LENGTH = RopeConfig().bead_length


@pytest.fixture(scope="module")
def curls(rope: Rope) -> Array:
    """qpos of ropes of 0 to 4 curls."""
    return np.stack([rope.qpos(rope.from_curve(curled(nx))) for nx in range(5)])


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


def lengths(points: Array) -> Array:
    return np.linalg.norm(np.roll(points, -1, axis=-2) - points, axis=-1)


def test_ropes_laid_along_curves_move_as_those_with_their_twist(rope: Rope, curls: Array) -> None:
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


def test_the_numbers_are_mujocos_own(rope: Rope) -> None:
    physics = _physics_of(rope)
    damping = physics.damping
    volume = np.pi * 0.005**2 * LENGTH + 4 / 3 * np.pi * 0.005**3
    assert physics.mass == pytest.approx(1000 * volume)
    assert damping.max() == 0.01 and (damping == 0).sum() == 7 and damping[0] == 0
    # the same where a processor sums MuJoCo's weight in another order; recordings were made with it
    for weight in (_WEIGHT, float(rope.model.body_invweight0[1, 0]), 1 / 3):
        assert _settled(weight * (1 - 2e-15)) == _settled(weight) == _settled(weight * (1 + 2e-15))
    assert (physics.radius, physics.contact_stiffness) == (0.005, 113.21720222318902)


def test_strands_pulled_through_each_other_stay_apart(rope: Rope, curls: Array) -> None:
    """A bead of the upper strand pulled straight down onto the lower one, with full force."""
    chain = ChainSimulation(1, rope)
    chain.set_qpos(curls[2:3])
    for _ in range(12):
        crossings = find_crossings(chain.points[0])
        bead = int(crossings.over_place[0]) % 100 if crossings.nx else 0
        chain.step([bead], np.array([[0.0, 0.0, -0.2]]))
        assert Knot(UNKNOT).is_shown_by(label(chain.points[0]))
        assert clearance(chain.points[0], 1.0) > 0.002


def test_random_play_keeps_the_knot_and_the_length_of_edges(rope: Rope, curls: Array) -> None:
    knotted = rope.qpos(rope.from_curve(trefoil()))[None]
    chain = ChainSimulation(6, rope)
    chain.set_qpos(np.concatenate([curls, knotted]))
    for beads, forces in pulls(6, 40, seed=3):
        chain.step(beads, np.sign(forces) * 0.2)
        codes = label_many(chain.points)
        assert all(map(Knot(UNKNOT).is_shown_by, codes[:5])) and knot_type(codes[5]) == "3_1"
        assert (chain.applied_shares == 1).all()
        assert np.abs(lengths(chain.points) / LENGTH - 1).max() < 1e-3


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
    for beads, forces in pulls(5, 6):
        chain.step(beads, forces)
    qpos = chain.qpos()
    mujoco = MujocoSimulation(5, rope)
    mujoco.set_qpos(qpos)
    assert np.abs(mujoco.points - chain.points).max() < 1e-9
    back = ChainSimulation(5, rope)
    back.set_qpos(qpos)
    for one in (0, 6):  # positions, and sides of edges
        kept, found = (c.states().reshape(5, 100, 10)[..., one : one + 3] for c in (chain, back))
        assert np.abs(found - kept).max() < 1e-6


def test_a_rope_that_the_proof_does_not_cover_is_refused() -> None:
    with pytest.raises(ValueError, match=r"at most 13.* mm long, got 26.60 mm"):
        ChainSimulation(1, Rope(RopeConfig(beads=50)))
    shorter = ChainSimulation(1, Rope(RopeConfig(beads=110)))
    shorter.act(np.full((1, 6), 0.5))
    assert np.abs(lengths(shorter.points) / (1.33 / 110) - 1).max() < 1e-3
