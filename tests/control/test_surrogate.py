import numpy as np
import pytest

from knotgym.control.surrogate import SurrogateConfig, surrogate_rollout
from knotgym.rope.macro_actions import MacroAction, MacroActionConfig, move_aside, pass_strand
from knotgym.rope.model import Array, Rope
from knotgym.topology.crossings import label
from knotgym.topology.symmetry import Symmetry

CONFIG = MacroActionConfig()


def rollout(points: Array, macro_action: MacroAction, steps: int) -> Array:
    return surrogate_rollout(points, macro_action, CONFIG.arrived, SurrogateConfig(steps=steps))


@pytest.fixture
def curl(rope: Rope) -> tuple[Array, MacroAction]:
    """A plain loop, and a bead of it led over a strand close by."""
    points = rope.loop()
    return points, pass_strand(points, "curl", 10, 28, 1, np.random.default_rng(0), CONFIG)


def test_a_rollout_leaves_the_rope_alone_and_ends_at_the_last_waypoint(
    curl: tuple[Array, MacroAction],
) -> None:
    points, macro_action = curl
    before = points.copy()
    frames = rollout(points, macro_action, 50)
    assert (
        np.array_equal(points, before) and frames.shape[1:] == points.shape and 1 < len(frames) < 50
    )
    assert (
        np.linalg.norm(frames[-1][10:12].mean(axis=0) - macro_action.waypoints[-1]) < CONFIG.arrived
    )


def test_a_rollout_keeps_the_lengths_of_all_links_but_the_one_opposite(
    curl: tuple[Array, MacroAction],
) -> None:
    points, macro_action = curl
    links = [
        np.linalg.norm(np.roll(frame, -1, axis=0) - frame, axis=1)
        for frame in (points, rollout(points, macro_action, 10)[-1])
    ]
    kept = np.delete(np.arange(100), [10, 60])
    assert np.allclose(links[0][kept], links[1][kept], atol=1e-9)


def test_a_rollout_has_no_more_frames_than_steps(curl: tuple[Array, MacroAction]) -> None:
    assert len(rollout(*curl, 3)) == 3


def test_a_strand_led_over_another_crosses_it(curl: tuple[Array, MacroAction]) -> None:
    points, macro_action = curl
    assert label(points).nx == 0
    assert any(label(frame).nx for frame in rollout(points, macro_action, 10))


def test_the_rollout_of_a_mirrored_rope_is_the_mirrored_rollout(rope: Rope) -> None:
    points, mirror = rope.loop(), Symmetry(reflect=True, switch=True, turn=1.0)
    macro_action = move_aside(points, "shift", 40, 1, np.random.default_rng(1), CONFIG)
    mirrored = MacroAction("shift", 40, mirror.vectors(macro_action.waypoints), -1, -1)
    assert np.allclose(
        mirror.vectors(rollout(points, macro_action, 5)),
        rollout(mirror.vectors(points), mirrored, 5),
        atol=1e-12,
    )
