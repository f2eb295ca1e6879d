"""Batched ropes move like single ropes, resume from saved states, and return copies."""

import mujoco
import numpy as np
import pytest

from knotgym.rope.model import Rope
from knotgym.rope.mujoco_simulation import MujocoSimulation

from ..conftest import blow_up, rough_play
from .test_simulations import moved


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


def test_a_call_refused_by_mujoco_leaves_no_force_behind(rope: Rope) -> None:
    simulation, other = MujocoSimulation(2, rope), MujocoSimulation(2, rope)
    with pytest.raises(ValueError, match="sorted and unique"):
        simulation.step([3, 3], np.full((2, 3), 0.2), [1, 1])
    assert np.array_equal(moved(simulation, 2), moved(other, 2))


@pytest.mark.parametrize("velocity", [1e8, 1e12, np.inf, np.nan])
def test_a_blown_up_rope_is_told_and_stands_where_it_stood(rope: Rope, velocity: float) -> None:
    simulation = MujocoSimulation(3, rope)
    moved(simulation, 2)
    blow_up(simulation, 1, velocity)
    before, points = simulation.states(), simulation.points.copy()
    good = simulation.act(np.full((3, 6), 0.3))
    assert good.tolist() == [True, False, True] == simulation.applied_shares.tolist()
    assert np.array_equal(simulation.states([1]), before[[1]], equal_nan=True)
    assert np.array_equal(simulation.points[1], points[1])
    assert not np.array_equal(simulation.points[0], points[0])


def test_a_force_that_is_no_number_moves_nothing(rope: Rope) -> None:
    simulation = MujocoSimulation(2, rope)
    assert simulation.step([0, 0], [[np.nan, 0, 0], [0.1, 0, 0]]).tolist() == [False, True]
    assert np.isfinite(simulation.points).all()


def test_a_torn_rope_is_told(rope: Rope) -> None:
    simulation = MujocoSimulation(1, rope)
    qpos = rope.qpos(rope.loop())
    qpos[rope.model.jnt_qposadr[rope.model.body_jntadr[1]] + 2] += 0.5  # metres, of one sub-chain
    simulation.set_qpos(qpos[None])
    assert simulation.act(np.zeros((1, 6))).tolist() == [False]


@pytest.mark.parametrize(("row", "share"), [(9, 0.5), (29, 0.0)])
def test_an_eased_step_says_which_share_of_the_force_it_applied(row: int, share: float) -> None:
    qpos, actions = rough_play(row)
    simulation, other = MujocoSimulation(1), MujocoSimulation(1)
    for one in (simulation, other):
        one.set_qpos(qpos[None])
    for action in actions:
        beads, asked = other.read_actions(action[None])
        simulation.act(action[None])
        other.step(beads, simulation.applied_shares[:, None] * asked)
        assert np.array_equal(simulation.states(), other.states())
    assert simulation.applied_shares.tolist() == [share]
