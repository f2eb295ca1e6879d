"""Action sequences are made of steps that an agent could take."""

import numpy as np

from knotgym.control.action_sequence import NO_ACTIONS, ActionSequence, resting, step_ropes
from knotgym.rope.model import Rope
from knotgym.rope.mujoco_simulation import MujocoSimulation


def test_a_step_is_the_action_that_it_returns(rope: Rope) -> None:
    one, other, rng = MujocoSimulation(1, rope), MujocoSimulation(1, rope), np.random.default_rng(2)
    for _ in range(6):
        actions, held = step_ropes(one, rng.integers(100, size=1), rng.uniform(-1, 1, (1, 3)))
        assert held.all() and actions.dtype == np.float32 and other.act(actions).all()
    assert np.array_equal(one.states(), other.states())


def test_a_step_moves_the_bead_that_was_meant(rope: Rope) -> None:
    simulation, rng = MujocoSimulation(1, rope), np.random.default_rng(3)
    for bead in rng.integers(100, size=20):
        before = simulation.points.copy()
        actions, _ = step_ropes(simulation, np.array([bead]), rng.uniform(-1, 1, (1, 3)))
        near = np.linalg.norm(before[0] - rope.config.reach * actions[0, :3], axis=1)
        assert np.argmin(near) == bead


def test_sequences_are_put_together_in_order() -> None:
    first = ActionSequence(np.array([1, 2], dtype=np.int16), np.ones((2, 3), dtype=np.float32))
    second = ActionSequence(np.array([3], dtype=np.int16), np.zeros((1, 3), dtype=np.float32))
    both = NO_ACTIONS + first + second
    assert len(both) == 3
    assert both.beads.tolist() == [1, 2, 3] and both.forces[:, 0].tolist() == [1, 1, 0]
    assert both.beads.dtype == np.int16 and both.forces.dtype == np.float32


def test_jitter_changes_the_strength_of_steps_and_not_their_beads_or_headings() -> None:
    forces = np.array([[0.5, 0.0, 0.0], [0.0, -0.5, 0.0]], dtype=np.float32)
    sequence = ActionSequence(np.array([4, 2], dtype=np.int16), forces)
    jittered = sequence.jittered(0.1, np.random.default_rng(0))
    assert jittered.beads.tolist() == [4, 2] and not np.array_equal(jittered.forces, forces)
    assert np.array_equal(np.sign(jittered.forces), np.sign(forces))


def test_resting_is_steps_of_no_force() -> None:
    assert len(resting(3)) == 3 and not resting(3).forces.any()
