"""Macro-actions lead one bead where they say, by steps that an agent could take."""

import numpy as np
import pytest
from pytest_types import Patch

from knotgym.rope.actions import quantized
from knotgym.rope.macro_actions import KINDS, LIFT, MacroAction, Pass, WaypointFollower
from knotgym.rope.model import Rope
from knotgym.rope.mujoco_simulation import MujocoSimulation


def drawn(rope: Rope, count: int = 300, seed: int = 0) -> list[MacroAction]:
    rng = np.random.default_rng(seed)
    return [MacroAction.drawn(rope.loop(), rng) for _ in range(count)]


@pytest.mark.parametrize("kind", KINDS)
def test_passes_and_curls_pass_strands(rope: Rope, kind: str, monkeypatch: Patch) -> None:
    shares = np.cumsum([one == kind for one in KINDS])
    monkeypatch.setattr("knotgym.rope.macro_actions._CUMULATIVE", shares)
    moves = drawn(rope, 100)
    apart = [(move.target - move.bead) % 100 for move in moves]
    near = [min(one, 100 - one) for one in apart]
    if kind in ("pass", "curl"):
        assert min(near) >= (12 if kind == "pass" else 6)
        assert max(near) > 40 if kind == "pass" else max(near) <= 24
    else:
        assert {move.target for move in moves} == {-1}
        assert {move.side for move in moves} == ({0} if kind == "spread" else {-1, 1})


@pytest.mark.parametrize("side", [-1, 1])
def test_a_strand_is_passed_at_a_height_above_or_below_it(rope: Rope, side: int) -> None:
    rng = np.random.default_rng(0)
    macro_action = MacroAction.passing(rope.loop(), Pass(10, 60, side), rng)
    assert np.allclose(macro_action.waypoints[:2, 2], side * LIFT)
    assert macro_action.waypoints[2, 2] == pytest.approx(0)
    for _ in range(50):  # it ends beyond the strand
        macro_action = MacroAction.passing(rope.loop(), Pass(10, 30, side), rng)
        led = np.linalg.norm(macro_action.waypoints[1, :2] - rope.loop()[10, :2])
        assert led > np.linalg.norm(rope.loop()[30, :2] - rope.loop()[10, :2])


def test_forces_are_none_when_idle_else_quantized_and_at_most_the_largest(rope: Rope) -> None:
    points, ids = np.repeat(rope.loop()[None], 40, axis=0), np.arange(40)
    follower = WaypointFollower(40)
    assert follower.idle.all() and not follower.forces(points, ids).any()
    follower.begin(ids, drawn(rope, 40))
    forces = follower.forces(points, ids)
    assert np.linalg.norm(forces, axis=1).max() <= 1.01
    assert np.array_equal(forces, quantized(forces).astype(np.float32))


def test_a_bead_is_led_to_its_last_waypoint(rope: Rope) -> None:
    simulation, follower = MujocoSimulation(1, rope), WaypointFollower(1)
    points, ids = rope.loop(), np.zeros(1, np.int64)
    waypoints = points[40] + np.array([[0.03, 0.0, 0.02], [0.08, 0.02, 0.02], [0.08, 0.02, 0.0]])
    follower.begin(ids, [MacroAction(40, waypoints)])
    pulls = 0
    while not follower.arrive(simulation.points, ids)[0]:
        force = follower.forces(simulation.points, ids) * simulation.max_force
        simulation.step(follower.beads, force)
        pulls += 1
    assert np.linalg.norm(simulation.points[0, 40] - waypoints[2]) < WaypointFollower.ARRIVED
    assert pulls < 15
