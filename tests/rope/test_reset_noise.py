"""Reset noise keeps a rope closed and its beads equal; at reset it keeps the Gauss code."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from knotgym.rope.closed_curves import noised, start_qpos
from knotgym.rope.model import Rope
from knotgym.states import States, read_states, shipped
from knotgym.topology import GaussCode, label, label_many

from ..conftest import trefoil
from .test_rope import BEAD, ROPE, chords


def moved_by(points: NDArray[np.float64], scale: float, seed: int) -> NDArray[np.float64]:
    """Noise on one rope."""
    return noised(points[None], scale, [np.random.default_rng(seed)])[0]


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.2))
@settings(max_examples=60)
def test_noise_keeps_beads_equal_and_the_rope_closed(seed: int, scale: float) -> None:
    moved = moved_by(ROPE.loop(), scale, seed)
    assert np.abs(chords(moved) - BEAD).max() < 1e-9


def test_noise_on_a_moving_rope_is_exactly_closed(rope: Rope, tangled: NDArray[np.float64]) -> None:
    for points in rope.points(tangled[:10]):
        moved = moved_by(points, 0.015, 0)
        assert np.ptp(chords(moved)) < 1e-12
        assert rope.points_and_gaps(rope.qpos(moved))[1] < 1e-6


def test_noise_is_what_the_generator_says() -> None:
    points = ROPE.from_curve(trefoil())
    first, again, other = (moved_by(points, 0.015, seed) for seed in (3, 3, 4))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    far = np.linalg.norm(first - points, axis=1)
    assert 0.001 < far.min() and far.max() < 0.1
    assert np.abs(moved_by(points, 0.0, 0) - points).max() < 1e-12


@pytest.mark.parametrize("scale", [0.015, 0.9])
def test_a_start_shows_the_code_of_its_row(states: States, rope: Rope, scale: float) -> None:
    rows = np.arange(0, len(states), 6)
    codes = label_many(states.points[rows])
    rngs = [np.random.default_rng(int(row)) for row in rows]
    qpos = start_qpos(rope, states.qpos[rows], states.points[rows], codes, scale, rngs)
    assert label_many(rope.points(qpos)) == codes


def test_ropes_that_start_together_start_as_they_would_alone(states: States, rope: Rope) -> None:
    def started(rows: list[int]) -> NDArray[np.float64]:
        codes = label_many(states.points[rows])
        rngs = [np.random.default_rng(row) for row in rows]
        # so much noise that most draws are rejected
        return start_qpos(rope, states.qpos[rows], states.points[rows], codes, 0.3, rngs)

    rows = list(range(0, len(states), 4))
    assert np.array_equal(started(rows), np.concatenate([started([row]) for row in rows]))


def test_no_noise_and_a_code_that_none_keeps_leave_the_row(states: States, rope: Rope) -> None:
    own, other = (label(states.points[row]) for row in (0, -1))
    assert other != own
    for code, scale in ((other, 0.015), (own, 0.0)):
        rng = np.random.default_rng(0)
        qpos = start_qpos(rope, states.qpos[:1], states.points[:1], [code], scale, [rng])
        assert np.array_equal(qpos, states.qpos[:1]) and not np.shares_memory(qpos, states.qpos)


def test_noise_that_no_rope_can_be_closed_after_is_drawn_again() -> None:
    states = read_states(shipped(), images=False)
    rope, loops = Rope(), np.flatnonzero(states.nx == 0)
    rows = np.repeat(loops, 24)
    codes, rngs = [GaussCode()] * len(rows), [*map(np.random.default_rng, range(len(rows)))]
    points = rope.points(start_qpos(rope, states.qpos[rows], states.points[rows], codes, 0.6, rngs))
    assert np.isfinite(points).all() and all(code.nx == 0 for code in label_many(points))
