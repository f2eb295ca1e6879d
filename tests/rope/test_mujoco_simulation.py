"""Batched ropes move like single ropes, resume from saved states, and return copies."""

import pickle

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.common.errors import InvalidInput
from knotgym.rope.model import Rope, RopeConfig
from knotgym.rope.mujoco_simulation import MujocoSimulation

from ..conftest import curled, rough_play


def moved(simulation: MujocoSimulation, steps: int, seed: int = 0) -> NDArray[np.float64]:
    """Return states after random actions, the same for rope i in a batch of any size."""
    rngs = [np.random.default_rng([seed, i]) for i in range(simulation.count)]
    for _ in range(steps):
        simulation.act(np.array([rng.uniform(-1, 1, 6) for rng in rngs]))
    return simulation.states()


def blown_up(simulation: MujocoSimulation, rope: int, velocity: float = 1e8) -> None:
    """Give a rope velocities at which every integrator fails."""
    states = simulation.states([rope])
    model = simulation.rope.model
    states[:, 1 + model.nq : 1 + model.nq + model.nv] = velocity  # after time and qpos
    simulation.restore(states, [rope])


def test_a_simulation_starts_with_plain_loops(rope: Rope) -> None:
    simulation = MujocoSimulation(2, rope)
    assert np.abs(simulation.points - rope.loop()).max() < 1e-12


def test_a_simulation_needs_a_rope() -> None:
    with pytest.raises(ValueError, match="at least 1 rope, got 0"):
        MujocoSimulation(0)


def test_one_batched_rope_is_mujocos_own_loop(rope: Rope) -> None:
    simulation, data = MujocoSimulation(1, rope), mujoco.MjData(rope.model)
    rng = np.random.default_rng(0)
    for _ in range(4):
        bead, force = int(rng.integers(100)), rng.uniform(-0.2, 0.2, 3)
        simulation.step([bead], force[None])
        data.xfrc_applied[rope.bodies[bead], :3] = force
        for _ in range(rope.config.frame_skip):
            mujoco.mj_step(rope.model, data)
        data.xfrc_applied[:] = 0
    assert np.array_equal(simulation.qpos()[0], data.qpos)


@pytest.fixture(scope="module")
def six(rope: Rope) -> NDArray[np.float64]:
    """Return three of six ropes, stepped by one thread."""
    return moved(MujocoSimulation(6, rope, 1), 3)[:3]


@pytest.mark.parametrize(("count", "threads"), [(6, 2), (6, 0), (3, 1), (3, 3)])
def test_states_are_the_same_bytes_in_any_batch_on_any_threads(
    rope: Rope, six: NDArray[np.float64], count: int, threads: int
) -> None:
    assert np.array_equal(moved(MujocoSimulation(count, rope, threads), 3)[:3], six)


def test_ropes_not_named_stand_still(rope: Rope) -> None:
    simulation = MujocoSimulation(3, rope)
    before = moved(simulation, 2)
    simulation.act(np.full((1, 6), 0.5), [1])
    assert np.array_equal(simulation.states([0, 2]), before[[0, 2]])
    assert not np.array_equal(simulation.states([1]), before[[1]])


def test_points_are_those_of_qpos(rope: Rope) -> None:
    simulation = MujocoSimulation(2, rope)
    moved(simulation, 3)
    assert np.array_equal(simulation.points, rope.points(simulation.qpos()))


def test_a_restored_rope_goes_on_bit_for_bit(rope: Rope) -> None:
    simulation = MujocoSimulation(2, rope)
    saved = moved(simulation, 4)
    onwards = moved(simulation, 3, seed=1)
    elsewhere = MujocoSimulation(3, rope, threads=2)
    moved(elsewhere, 2, seed=9)
    elsewhere.restore(saved, [0, 2])
    rngs = [np.random.default_rng([1, i]) for i in range(2)]
    for _ in range(3):
        elsewhere.act(np.array([rng.uniform(-1, 1, 6) for rng in rngs]), [0, 2])
    assert np.array_equal(elsewhere.states([0, 2]), onwards)


def test_saved_states_are_copies(rope: Rope) -> None:
    simulation = MujocoSimulation(1, rope)
    states, qpos = simulation.states(), simulation.qpos()
    kept = states.copy(), qpos.copy()
    moved(simulation, 1)
    assert np.array_equal(states, kept[0]) and np.array_equal(qpos, kept[1])


def test_a_pickled_simulation_goes_on_bit_for_bit() -> None:
    simulation = MujocoSimulation(2, Rope(RopeConfig(frame_skip=6)), threads=2)
    moved(simulation, 3)
    again = pickle.loads(pickle.dumps(simulation))
    assert again.rope.config == simulation.rope.config and np.array_equal(
        again.points, simulation.points
    )
    assert np.array_equal(moved(again, 3, seed=1), moved(simulation, 3, seed=1))


def test_a_rope_laid_forgets_what_it_did(rope: Rope) -> None:
    used, fresh = MujocoSimulation(1, rope), MujocoSimulation(1, rope)
    moved(used, 5)
    qpos = rope.qpos(rope.from_curve(curled(2)))[None]
    used.lay(qpos)
    fresh.lay(qpos)
    assert np.array_equal(used.states(), fresh.states())
    assert np.array_equal(moved(used, 2, seed=1), moved(fresh, 2, seed=1))


def test_laying_one_rope_leaves_the_others(rope: Rope) -> None:
    simulation = MujocoSimulation(3, rope)
    before = moved(simulation, 3)
    simulation.lay(rope.qpos(rope.loop())[None], [1])
    assert np.array_equal(simulation.states([0, 2]), before[[0, 2]])
    assert np.abs(simulation.points[1] - rope.loop()).max() < 1e-12


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.full((2, 6), np.nan), r"must be in \[-1, 1\]"),
        (
            np.array([[0.0] * 6, [0, 0, 0, 0, 0, 1.001]]),
            r"must be in \[-1, 1\], got \[0.0, 0.0, 0.0, 0.0, 0.0, 1.001\]",
        ),
        (np.full((2, 6), -np.inf), r"must be in \[-1, 1\]"),
        (np.zeros((2, 5)), r"shape \(2, 5\) for 2 ropes"),
        (np.zeros((3, 6)), r"shape \(3, 6\) for 2 ropes"),
        (np.zeros(6), r"shape \(6,\) for 2 ropes"),
    ],
)
def test_bad_actions_are_refused_and_nothing_moves(
    rope: Rope, actions: NDArray[np.float64], message: str
) -> None:
    simulation = MujocoSimulation(2, rope)
    before = moved(simulation, 2)
    with pytest.raises(InvalidInput, match=message):
        simulation.act(actions)
    assert np.array_equal(simulation.states(), before)


def test_rounding_beyond_1_is_taken_for_1(rope: Rope) -> None:
    one, other = MujocoSimulation(1, rope), MujocoSimulation(1, rope)
    one.act(np.array([[0.1, 0, 0, 1, -1, 1]]))
    other.act(np.array([[0.1, 0, 0, np.nextafter(np.float32(1), np.float32(2)), -1 - 1e-6, 1]]))
    assert np.array_equal(one.states(), other.states())
    with pytest.raises(InvalidInput):
        one.act(np.full((1, 6), 1 + 2e-6))


def test_a_call_refused_by_mujoco_leaves_no_force_behind(rope: Rope) -> None:
    simulation, other = MujocoSimulation(2, rope), MujocoSimulation(2, rope)
    with pytest.raises(ValueError, match="sorted and unique"):
        simulation.step([3, 3], np.full((2, 3), 0.2), [1, 1])
    assert np.array_equal(moved(simulation, 2), moved(other, 2))


def test_an_action_pulls_the_nearest_bead(rope: Rope) -> None:
    simulation = MujocoSimulation(1, rope)
    at = 1.2 * simulation.points[0, 30] / rope.config.reach
    beads, forces = simulation.read_actions(np.concatenate([at, [0.5, -1.0, 0.25]])[None])
    assert beads.tolist() == [30] and np.allclose(forces, [[0.1, -0.2, 0.05]])


def test_a_pulled_bead_goes_where_it_is_pulled(rope: Rope) -> None:
    simulation = MujocoSimulation(1, rope)
    before = simulation.points[0, 40].copy()
    simulation.step([40], [[0.0, 0.0, 0.2]])
    assert 0.02 < simulation.points[0, 40, 2] - before[2] < 0.06


def test_actions_and_read_actions_are_inverse(rope: Rope) -> None:
    simulation, rng = MujocoSimulation(8, rope), np.random.default_rng(0)
    moved(simulation, 3)
    for _ in range(20):
        beads, forces = rng.integers(0, 100, 8), rng.uniform(-0.2, 0.2, (8, 3))
        actions = simulation.actions(beads, forces)
        assert actions.dtype == np.float32 and np.abs(actions).max() <= 1
        read, pulled = simulation.read_actions(actions)
        assert np.array_equal(read, beads) and np.abs(pulled - forces).max() < 1e-7


def test_forces_too_large_for_an_action_are_cut(rope: Rope) -> None:
    simulation = MujocoSimulation(1, rope)
    assert simulation.actions([0], [[5.0, -5.0, 0.0]])[0, 3:].tolist() == [1.0, -1.0, 0.0]


@pytest.mark.parametrize("velocity", [1e8, 1e12, np.inf, np.nan])
def test_a_blown_up_rope_is_told_and_stands_where_it_stood(rope: Rope, velocity: float) -> None:
    simulation = MujocoSimulation(3, rope)
    moved(simulation, 2)
    blown_up(simulation, 1, velocity)
    before, points = simulation.states(), simulation.points.copy()
    good = simulation.act(np.full((3, 6), 0.3))
    assert good.tolist() == [True, False, True]
    assert np.array_equal(simulation.states([1]), before[[1]], equal_nan=True)
    assert np.array_equal(simulation.points[1], points[1])
    assert not np.array_equal(simulation.points[0], points[0])


def test_a_rope_that_blows_up_again_is_told_again(rope: Rope) -> None:
    simulation = MujocoSimulation(2, rope)
    blown_up(simulation, 0)
    for _ in range(3):
        assert simulation.act(np.full((2, 6), 0.3)).tolist() == [False, True]


def test_neighbours_of_a_blown_up_rope_move_as_ever(rope: Rope) -> None:
    simulation, other = MujocoSimulation(3, rope), MujocoSimulation(3, rope)
    blown_up(simulation, 1)
    for one in (simulation, other):
        moved(one, 2)
    assert np.array_equal(simulation.states([0, 2]), other.states([0, 2]))


def test_a_blown_up_rope_can_be_laid_again(rope: Rope) -> None:
    simulation, fresh = MujocoSimulation(1, rope), MujocoSimulation(1, rope)
    blown_up(simulation, 0, np.nan)
    simulation.act(np.zeros((1, 6)))
    for one in (simulation, fresh):
        one.lay(rope.qpos(rope.loop())[None])
    assert np.array_equal(moved(simulation, 2), moved(fresh, 2))


def test_a_force_that_is_no_number_moves_nothing(rope: Rope) -> None:
    simulation = MujocoSimulation(2, rope)
    assert simulation.step([0, 0], [[np.nan, 0, 0], [0.1, 0, 0]]).tolist() == [False, True]
    assert np.isfinite(simulation.points).all()


def test_a_torn_rope_is_told(rope: Rope) -> None:
    simulation = MujocoSimulation(1, rope)
    qpos = rope.qpos(rope.loop())
    qpos[rope.model.jnt_qposadr[rope.model.body_jntadr[1]] + 2] += (
        0.5  # one sub-chain far above the others
    )
    simulation.lay(qpos[None])
    assert simulation.act(np.zeros((1, 6))).tolist() == [False]


@pytest.mark.parametrize(("row", "share"), [(9, 0.5), (29, 0.0)])
def test_an_eased_step_says_which_share_of_the_force_it_applied(row: int, share: float) -> None:
    qpos, actions = rough_play(row)
    simulation, other = MujocoSimulation(1), MujocoSimulation(1)
    for one in (simulation, other):
        one.lay(qpos[None])
    for action in actions:
        beads, asked = other.read_actions(action[None])
        simulation.act(action[None])
        other.step(beads, simulation.applied_shares[:, None] * asked)
        assert np.array_equal(simulation.states(), other.states())
    assert simulation.applied_shares.tolist() == [share]


def test_a_rope_that_blows_up_had_no_force_applied(rope: Rope) -> None:
    simulation = MujocoSimulation(2, rope)
    blown_up(simulation, 0, np.nan)
    assert simulation.act(np.zeros((2, 6))).tolist() == [False, True]
    assert simulation.applied_shares.tolist() == [0.0, 1.0]


def turned_alike(here: Rope, there: Rope, qpos: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return qpos with the vertices and bead orientations of `here`, in the model of `there`."""
    ours, theirs = mujoco.MjData(here.model), mujoco.MjData(there.model)
    ours.qpos[:] = qpos
    mujoco.mj_kinematics(here.model, ours)
    same = dict(zip(there.bodies.tolist(), here.bodies.tolist(), strict=True))
    rest, back = np.zeros(4), np.zeros(4)
    for body in sorted(same):
        joint, parent = int(there.model.body_jntadr[body]), int(there.model.body_parentid[body])
        at = int(there.model.jnt_qposadr[joint])
        if parent == 0:
            theirs.qpos[at : at + 3] = ours.xpos[same[body]]
            theirs.qpos[at + 3 : at + 7] = ours.xquat[same[body]]
        else:
            mujoco.mju_mulQuat(rest, ours.xquat[same[parent]], there.model.body_quat[body])
            mujoco.mju_negQuat(back, rest)
            mujoco.mju_mulQuat(theirs.qpos[at : at + 4], back, ours.xquat[same[body]])
    return theirs.qpos.copy()


@pytest.mark.parametrize(("finer", "share"), [(1, 0.08), (4, 0.02)])
@pytest.mark.parametrize("nx", [0, 3])
def test_the_root_of_a_sub_chain_is_bookkeeping(nx: int, finer: int, share: float) -> None:
    # Over 20 steps at full force the two came apart by at most 0.055 of the distance that the rope
    # moved, 0.014 at a quarter of the timestep: it is the integrator's error. Beads are turned
    # alike, because MuJoCo's drag treats a bead as a box, so that its twist matters.
    here, there = (
        Rope(RopeConfig(rooted=rooted, timestep=0.008 / finer, frame_skip=24 * finer))
        for rooted in ("middle", "start")
    )
    points = here.from_curve(curled(nx))
    qpos = here.qpos(points)
    starts = [qpos, turned_alike(here, there, qpos)]
    rng = np.random.default_rng(0)
    for _ in range(4):
        bead, force = int(rng.integers(100)), rng.choice([-0.2, 0.2], 3)
        ends = []
        for rope, start in zip((here, there), starts, strict=True):
            simulation = MujocoSimulation(1, rope)
            simulation.lay(start[None])
            assert simulation.step([bead], force[None]).all()
            ends.append(simulation.points[0].copy())
        moved_by = np.linalg.norm(ends[0] - points, axis=1).max()
        assert moved_by > 0.02
        assert np.linalg.norm(ends[0] - ends[1], axis=1).max() < share * moved_by
