"""Manoeuvres lead one bead where they say, by pulls that an agent could make."""

import numpy as np
import pytest

from knotgym.control.macro_actions import (
    ARRIVED,
    KINDS,
    LIFT,
    NO_ACTIONS,
    ActionSequence,
    MacroAction,
    WaypointController,
    pass_strand,
    propose,
    step_ropes,
)
from knotgym.rope import Rope
from knotgym.simulation import Simulation


def drawn(rope: Rope, count: int = 300, seed: int = 0) -> list[MacroAction]:
    rng = np.random.default_rng(seed)
    return [propose(rope.loop(), rng) for _ in range(count)]


def test_every_kind_is_drawn(rope: Rope) -> None:
    assert {one.kind for one in drawn(rope)} == set(KINDS)


def test_the_same_seed_draws_the_same_manoeuvres(rope: Rope) -> None:
    for one, other in zip(drawn(rope, 20), drawn(rope, 20), strict=True):
        assert (one.kind, one.bead, one.target, one.side) == (
            other.kind,
            other.bead,
            other.target,
            other.side,
        )
        assert np.array_equal(one.waypoints, other.waypoints)


def test_only_passes_and_curls_have_a_strand_to_pass(rope: Rope) -> None:
    for one in drawn(rope):
        assert (0 <= one.target < 100) if one.kind in ("pass", "curl") else one.target == -1


def test_a_strand_is_passed_by_another_bead(rope: Rope) -> None:
    apart = {
        kind: [
            min((one.target - one.bead) % 100, (one.bead - one.target) % 100)
            for one in drawn(rope)
            if one.kind == kind
        ]
        for kind in KINDS
    }
    assert min(apart["pass"]) >= 12 and 6 <= min(apart["curl"]) <= max(apart["curl"]) <= 24


@pytest.mark.parametrize("side", [-1, 1])
def test_a_strand_is_passed_at_a_height_above_or_below_it(rope: Rope, side: int) -> None:
    one = pass_strand(rope.loop(), "pass", 10, 60, side, np.random.default_rng(0))
    assert np.allclose(one.waypoints[:2, 2], side * LIFT) and one.waypoints[2, 2] == pytest.approx(
        0
    )


def test_a_pass_ends_beyond_the_strand(rope: Rope) -> None:
    points, rng = rope.loop(), np.random.default_rng(1)
    for _ in range(50):
        one = pass_strand(points, "pass", 10, 30, 1, rng)
        assert np.linalg.norm(one.waypoints[1, :2] - points[10, :2]) > np.linalg.norm(
            points[30, :2] - points[10, :2]
        )


def test_proposing_leaves_the_rope_alone(rope: Rope) -> None:
    points = rope.loop()
    propose(points, np.random.default_rng(0))
    assert np.array_equal(points, rope.loop())


def test_a_new_hand_is_idle_and_pulls_at_nothing(rope: Rope) -> None:
    controller, points = WaypointController(3), np.repeat(rope.loop()[None], 3, axis=0)
    assert controller.idle.all() and not controller.forces(points).any()


def test_a_hand_pulls_with_at_most_the_largest_force(rope: Rope) -> None:
    points = np.repeat(rope.loop()[None], 40, axis=0)
    controller = WaypointController(40)
    for row, one in enumerate(drawn(rope, 40)):
        controller.begin(row, one)
    assert np.linalg.norm(controller.forces(points), axis=1).max() <= 1 + 1e-12


def test_a_hand_pulls_towards_the_waypoint(rope: Rope) -> None:
    controller, points = WaypointController(1), rope.loop()
    controller.begin(
        0, MacroAction("shift", 7, points[7] + [[0.1, 0, 0], [0.1, 0.1, 0], [0, 0, 0]])
    )
    assert np.allclose(controller.forces(points[None]), [[1, 0, 0]])


def test_a_hand_leads_its_bead_to_the_last_waypoint(rope: Rope) -> None:
    simulation, controller, points = Simulation(1, rope), WaypointController(1), rope.loop()
    waypoints = points[40] + np.array([[0.03, 0.0, 0.02], [0.08, 0.02, 0.02], [0.08, 0.02, 0.0]])
    controller.begin(0, MacroAction("shift", 40, waypoints))
    for _ in range(15):
        controller.advance(simulation.points)
        if controller.idle[0]:
            break
        step_ropes(simulation, controller.beads, controller.forces(simulation.points))
    assert controller.idle[0] and np.linalg.norm(simulation.points[0, 40] - waypoints[2]) < ARRIVED


def test_a_pull_is_the_action_that_it_returns(rope: Rope) -> None:
    one, other, rng = Simulation(1, rope), Simulation(1, rope), np.random.default_rng(2)
    for _ in range(6):
        actions, held = step_ropes(one, rng.integers(100, size=1), rng.uniform(-1, 1, (1, 3)))
        assert held.all() and actions.dtype == np.float32 and other.act(actions).all()
    assert np.array_equal(one.states(), other.states())


def test_a_pull_holds_the_bead_that_was_meant(rope: Rope) -> None:
    simulation, rng = Simulation(1, rope), np.random.default_rng(3)
    for bead in rng.integers(100, size=20):
        before = simulation.points.copy()
        actions, _ = step_ropes(simulation, np.array([bead]), rng.uniform(-1, 1, (1, 3)))
        near = np.linalg.norm(before[0] - rope.config.reach * actions[0, :3], axis=1)
        assert np.argmin(near) == bead


def test_ways_are_put_together_in_order() -> None:
    first = ActionSequence(np.array([1, 2], dtype=np.int16), np.ones((2, 3), dtype=np.float32))
    second = ActionSequence(np.array([3], dtype=np.int16), np.zeros((1, 3), dtype=np.float32))
    both = NO_ACTIONS + first + second
    assert (
        len(both) == 3
        and both.beads.tolist() == [1, 2, 3]
        and both.forces[:, 0].tolist() == [1, 1, 0]
    )
    assert both.beads.dtype == np.int16 and both.forces.dtype == np.float32
