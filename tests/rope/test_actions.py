"""Conversion between actions and beads with forces."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from knotgym.rope.actions import (
    decode_actions,
    encode_actions,
)
from knotgym.rope.model import Rope

ROPE = Rope()
LOOP = ROPE.loop()

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
