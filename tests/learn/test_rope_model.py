"""The rope's model: it keeps to the laws it is built on, and its fit finds what moved a rope."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from knotgym.learn.fitting import Stretches, error
from knotgym.learn.rope_model import BEADS, CHORD, DURATION, FIRST_GUESS, Dynamics
from knotgym.rope.model import Rope
from knotgym.rope.mujoco_simulation import MujocoSimulation

pytestmark = pytest.mark.clients  # compiling it takes long

BEAD, FORCE = np.array([25]), np.array([[0.5, 0.8, 0.3]])


def loop() -> np.ndarray:
    points = MujocoSimulation(1).points.copy()
    return points - points.mean(axis=1, keepdims=True)


def hairpin() -> np.ndarray:
    """Two strands side by side, nearer to each other than strands lie."""
    along = CHORD * np.concatenate([np.arange(50), np.arange(50)[::-1]])
    return np.stack([along, np.repeat([0.0, 0.006], 50), np.zeros(BEADS)], axis=1)


def pulled(points: np.ndarray, force: np.ndarray = FORCE) -> np.ndarray:
    dynamics, speeds = Dynamics(FIRST_GUESS), np.zeros_like(points)
    for _ in range(3):
        points, speeds = dynamics.step(points, speeds, BEAD, force)
    return points


def reference(
    points: np.ndarray, velocities: np.ndarray, bead: int, force: np.ndarray, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One rope moved through one action of two substeps, by dense matrices and plain loops."""
    mass, across, along, spin, apart = numbers[:5]
    h, own, speed = DURATION / 2, points.copy(), velocities.copy()
    for _ in range(2):
        tangent = np.roll(own, -1, axis=0) - own
        tangent /= np.linalg.norm(tangent, axis=1)[:, None]
        new = speed
        for _ in range(2):
            matrix, right = np.zeros((4 * BEADS, 4 * BEADS)), np.zeros(4 * BEADS)
            for i in range(BEADS):
                v = slice(4 * i, 4 * i + 3)
                matrix[v, v] += mass / h * np.eye(3)
                matrix[4 * i + 3, 4 * i + 3] += spin
                right[v] += mass / h * speed[i]
                if i in (bead, (bead + 1) % BEADS):
                    right[v] += 0.5 * force
                g, j, t = (i - 1) % BEADS, (i + 1) % BEADS, tangent[i]
                stretch, middle = np.zeros(4 * BEADS), np.zeros((3, 4 * BEADS))
                stretch[4 * j : 4 * j + 3], stretch[v] = t, -t
                middle[:, v] = middle[:, 4 * j : 4 * j + 3] = 0.5 * np.eye(3)
                line, u = np.outer(t, t), 0.5 * (new[i] + new[j])
                drag = across * max(np.linalg.norm(u - line @ u), 0.02) * (np.eye(3) - line)
                drag += along * max(abs(t @ u), 0.02) * line
                matrix += 1e4 * np.outer(stretch, stretch) + 2 * middle.T @ drag @ middle
                right += middle.T @ drag @ u
                turning = np.zeros((3, 4 * BEADS))  # of bead i against bead i - 1
                for sign, a, b in ((1.0, i, j), (-1.0, g, i)):
                    cross = sign * np.cross(tangent[a], np.eye(3)).T / CHORD
                    turning[:, 4 * b : 4 * b + 3] += cross
                    turning[:, 4 * a : 4 * a + 3] -= cross
                    turning[:, 4 * a + 3] += sign * tangent[a]
                matrix += numbers[5 + i] * turning.T @ turning
            new = np.linalg.solve(matrix, right).reshape(BEADS, 4)[:, :3]
        own, speed = own + h * new, new
        for i in range(BEADS):
            for j in range(i + 3, min(BEADS, BEADS - 3 + i)):
                between = own[j] - own[i]
                far = np.sqrt(between @ between)
                if far < apart:
                    own[i] -= 0.5 * (apart - far) / far * between
                    own[j] += 0.5 * (apart - far) / far * between
        for _ in range(8):
            for i in [*range(0, BEADS, 2), *range(1, BEADS, 2)]:
                j = (i + 1) % BEADS
                between = own[j] - own[i]
                share = 0.5 * (1 - CHORD / np.linalg.norm(between))
                own[i] += share * between
                own[j] -= share * between
    return own, speed


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


def test_it_does_what_dense_matrices_and_plain_loops_do() -> None:
    rng = np.random.default_rng(4)
    numbers = FIRST_GUESS * rng.uniform(0.7, 1.3, len(FIRST_GUESS))
    numbers[[5, 40, 104]] = 0.0  # joints that don't resist
    points, speeds = np.stack([loop()[0], hairpin(), hairpin()]), rng.normal(0, 0.1, (3, BEADS, 3))
    beads, forces = np.array([0, 99, 60]), rng.uniform(-1, 1, (3, 3))
    after, faster = Dynamics(numbers).step(points, speeds, beads, forces)
    for rope in range(3):
        told = reference(points[rope], speeds[rope], beads[rope], 0.2 * forces[rope], numbers)
        assert np.abs(after[rope] - told[0]).max() < 1e-9  # metres
        assert np.abs(faster[rope] - told[1]).max() < 1e-8  # m/s


def test_a_rope_moves_as_it_does_alone_whatever_the_others_do() -> None:
    rng = np.random.default_rng(5)
    points = np.stack([loop()[0], hairpin(), loop()[0], hairpin(), hairpin(), loop()[0]])
    points += rng.normal(0, 1e-3, points.shape)
    speeds, beads = rng.normal(0, 0.1, points.shape), rng.integers(BEADS, size=6)
    forces = rng.uniform(-1, 1, (6, 3))
    together = Dynamics(FIRST_GUESS).step(points, speeds, beads, forces)
    for rope in range(6):
        one = slice(rope, rope + 1)
        alone = Dynamics(FIRST_GUESS).step(points[one], speeds[one], beads[one], forces[one])
        assert all(np.array_equal(a[0], b[rope]) for a, b in zip(alone, together, strict=True))


def test_a_fresh_compilation_moves_ropes_as_a_cached_one_does(tmp_path: Path) -> None:
    """To the bit: what is learnt and measured must not depend on whether a clone was used before.
    With `fastmath`, Numba's two ways to the same machine code round otherwise.
    """
    code = (
        "import hashlib, numpy as np\n"
        "from knotgym.learn.rope_model import FIRST_GUESS, Dynamics\n"
        "from knotgym.rope.mujoco_simulation import MujocoSimulation\n"
        "points, rng = MujocoSimulation(4).points.copy(), np.random.default_rng(0)\n"
        "speeds = np.zeros_like(points)\n"
        "for _ in range(4):\n"
        "    beads, forces = rng.integers(0, 100, 4), rng.uniform(-1, 1, (4, 3))\n"
        "    points, speeds = Dynamics(FIRST_GUESS).step(points, speeds, beads, forces)\n"
        "print(hashlib.sha256(points.tobytes() + speeds.tobytes()).hexdigest())\n"
    )
    told = [
        subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for _ in range(2)
    ]
    assert told[0] == told[1] and any(tmp_path.rglob("*.nbc"))
