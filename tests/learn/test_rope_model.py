"""The rope's model: it keeps to the laws it is built on, and its fit finds what moved a rope."""

from __future__ import annotations

import numpy as np
import pytest

from knotgym.learn.fitting import Stretches, error
from knotgym.learn.rope_model import BEADS, CHORD, FIRST_GUESS, Dynamics
from knotgym.rope import Rope
from knotgym.simulation import Simulation

pytestmark = pytest.mark.clients  # compiling it takes long

BEAD, FORCE = np.array([25]), np.array([[0.5, 0.8, 0.3]])


def loop() -> np.ndarray:
    points = Simulation(1).points.copy()
    return points - points.mean(axis=1, keepdims=True)


def pulled(points: np.ndarray, force: np.ndarray = FORCE) -> np.ndarray:
    dynamics, speeds = Dynamics(FIRST_GUESS), np.zeros_like(points)
    for _ in range(3):
        points, speeds = dynamics.step(points, speeds, BEAD, force)
    return points


def test_a_rope_left_alone_stays() -> None:
    assert np.allclose(pulled(loop(), np.zeros((1, 3))), loop(), atol=1e-6)


def test_a_turned_rope_moves_alike() -> None:
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.allclose(pulled(loop() @ turn, FORCE @ turn), pulled(loop()) @ turn, atol=1e-6)


def test_chords_keep_their_length() -> None:
    after = pulled(loop())[0]
    chords = np.linalg.norm(np.roll(after, -1, axis=0) - after, axis=1)
    assert np.abs(chords / CHORD - 1).max() < 0.02


def test_the_pulled_bead_goes_where_it_is_pulled() -> None:
    moved = (pulled(loop()) - loop())[0]
    assert moved[25] @ FORCE[0] > 0.05 and np.linalg.norm(moved, axis=1).argmax() in (24, 25, 26)


def test_an_error_is_least_for_the_numbers_that_moved_the_rope() -> None:
    points = loop()
    after, _ = Dynamics(FIRST_GUESS, 3).step(points, np.zeros_like(points), BEAD, FORCE)
    stretches = Stretches(np.stack([points, after]), BEAD[None], 0.2 * FORCE[None])
    other = FIRST_GUESS.copy()
    other[1] *= 2
    assert error(FIRST_GUESS, stretches) < 1e-9 < error(other, stretches)


def test_a_rope_of_the_model_has_the_simulations_beads() -> None:
    assert Rope().config.beads == BEADS
