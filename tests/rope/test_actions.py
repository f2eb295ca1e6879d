"""Conversion between actions and beads with forces."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.common.errors import InvalidInput
from knotgym.rope.actions import (
    FORCE_BINS,
    decode_actions,
    decode_pulls,
    encode_actions,
    encode_pulls,
    quantized,
    steps_taken,
)
from knotgym.rope.model import Rope

ROPE = Rope()
LOOP = ROPE.loop()

pulls = st.tuples(st.integers(0, 99), *[st.integers(-FORCE_BINS, FORCE_BINS)] * 3)
beads = st.lists(st.integers(0, 99), min_size=1, max_size=5)


@given(beads, st.integers(0, 2**32 - 1))
def test_what_was_encoded_is_decoded(beads: list[int], seed: int) -> None:
    points = np.repeat(LOOP[None], len(beads), axis=0)
    forces = np.random.default_rng(seed).uniform(-0.2, 0.2, (len(beads), 3))
    actions = encode_actions(beads, forces, points, ROPE.config)
    assert actions.dtype == np.float32 and actions.shape == (len(beads), 6)
    read, again = decode_actions(actions, points, ROPE.config)
    assert read.tolist() == beads and np.abs(again - forces).max() < 1e-7


def test_each_rope_is_read_as_it_lies() -> None:
    points = np.stack([LOOP, np.roll(LOOP, 10, axis=0)])
    action = np.zeros((2, 6))
    action[:, :3] = LOOP[30] / ROPE.config.reach
    assert decode_actions(action, points, ROPE.config)[0].tolist() == [30, 40]


def test_forces_beyond_the_largest_are_cut() -> None:
    actions = encode_actions([3], [[9.0, -9.0, 0.1]], LOOP[None], ROPE.config)
    assert np.allclose(actions[0, 3:], [1.0, -1.0, 0.5])


def test_nothing_led_to_the_first_state() -> None:
    points = np.stack([LOOP, LOOP, LOOP])
    actions = encode_actions([7, 60], [[0.1, 0, 0], [0, 0.2, 0]], points[:2], ROPE.config)
    beads, forces = steps_taken(actions, points, ROPE.config)
    assert beads.tolist() == [-1, 7, 60] and beads.dtype == np.int64
    assert np.allclose(forces, [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.2, 0.0]])


@given(st.lists(pulls, min_size=1, max_size=5), st.integers(0, 2**32 - 1))
def test_four_bytes_are_a_pull_at_every_state(rows: list[tuple[int, ...]], seed: int) -> None:
    points = LOOP + np.random.default_rng(seed).uniform(-0.003, 0.003, (len(rows), 100, 3))
    given = np.array(rows, dtype=np.int8)
    actions = decode_pulls(given, points, ROPE.config)
    assert np.array_equal(encode_pulls(actions, points, ROPE.config), given)
    beads, forces = decode_actions(actions, points, ROPE.config)
    assert np.array_equal(beads, given[:, 0])
    assert np.array_equal(forces, quantized(given[:, 1:] / FORCE_BINS) * ROPE.config.max_force)


def test_an_action_between_the_bytes_is_refused() -> None:
    action = encode_actions([3], [[0.05, 0.0, 0.0]], LOOP[None], ROPE.config)
    with pytest.raises(InvalidInput, match="1/127"):
        encode_pulls(action, LOOP[None], ROPE.config)
