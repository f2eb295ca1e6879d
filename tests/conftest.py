"""What several test modules share: ropes of known shape and a small state file made of them."""

import gc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from numpy.typing import NDArray

from knotgym.drawing import drawn_curve
from knotgym.rendering import draw
from knotgym.rope import MUJOCO, Rope, Simulation, simulation
from knotgym.states import States, read_states, shipped, write_states
from knotgym.topology import codes_of, label

from .small_job import WANTED, knotgym

# Compiling, or another process on the same cores, is no failure.
settings.register_profile("unhurried", deadline=None, max_examples=20)
settings.load_profile("unhurried")

PER_NX = 6


def pytest_collection_finish() -> None:
    """What was imported and collected stays: the garbage collector needn't look at it again."""
    gc.freeze()


def curled(nx: int, turn: float = 0.0, hand: int = 1) -> NDArray[np.float64]:
    """A round curve with nx curls on its inside, each a crossing; turned by radians, mirrored in z
    for hand -1: float64 (600, 3).
    """
    at = turn + np.linspace(0, 2 * np.pi, 600, endpoint=False)
    size = {0: 0.0, 1: 0.75, 2: 0.55, 3: 0.42, 4: 0.34}[nx]
    flat = np.exp(1j * at) + size * np.exp(1j * (nx + 1) * at)
    return np.stack([flat.real, flat.imag, hand * 0.1 * np.sin(nx * at)], axis=1)


def trefoil() -> NDArray[np.float64]:
    """The usual trefoil: float64 (300, 3)."""
    at = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    return np.stack(
        [np.sin(at) + 2 * np.sin(2 * at), np.cos(at) - 2 * np.cos(2 * at), -np.sin(3 * at)], axis=1
    )


def small_states() -> States:
    """Six states for each nx from 0 to 4, train and test in turn."""
    rope = Rope()
    points = np.array(
        [
            rope.from_curve(curled(nx, 0.7 + k, (-1) ** (k // 2)))
            for nx in range(5)
            for k in range(PER_NX)
        ]
    )
    codes = [label(one) for one in points]
    n = len(points)
    return States.of(
        {
            "qpos": np.array([rope.qpos(one) for one in points]),
            "points": points,
            "image": np.array([draw(one) for one in points]),
            "gauss_code": np.array([str(code) for code in codes]),
            "gauss_code_chiral": np.array([code.chiral for code in codes]),
            "knot": np.array(["0_1"] * n),
            "nx": np.array([code.nx for code in codes]),
            "split": np.array(["train", "test"] * (n // 2)),
            "quality/clearance": np.arange(n, dtype=np.float64),
            "source/seed": np.arange(n)[:, None] * (1, 0, 0, 0, 0),
            "source/policy": np.array(["curve"] * n),
        },
        {"rope": rope.config.fingerprint, "config": {"made": "by hand"}},
    )


@pytest.fixture(scope="session")
def rope() -> Rope:
    return Rope()


@pytest.fixture(scope="session")
def states() -> States:
    return small_states()


@pytest.fixture(scope="session")
def states_path(states: States, tmp_path_factory: pytest.TempPathFactory) -> str:
    path: Path = tmp_path_factory.mktemp("states") / "states.h5"
    write_states(path, states)
    return str(path)


@pytest.fixture(scope="session")
def tangled(rope: Rope) -> NDArray[np.float64]:
    """Generalized positions of ropes in mid-motion: float64 (40, nq)."""
    ropes, rng = simulation(MUJOCO, 8, rope, threads=0), np.random.default_rng(1)
    seen = []
    for _ in range(12):
        ropes.act(rng.uniform(-1, 1, (8, 6)))
        seen.append(ropes.qpos())
    return np.concatenate(seen[-5:])


@pytest.fixture(scope="session")
def curated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the main job: four loops and four states with one crossing, demonstrated. It is
    only ever read, harm is done to copies.
    """
    folder = tmp_path_factory.mktemp("curated") / "nx0-1"
    assert knotgym("generate", *WANTED, "--workers", 1, "--out", folder, "--quiet") == 0
    return folder


def blow_up(simulation: Simulation, rope: int = 0, velocity: float = 1e8) -> None:
    """Give a rope of MuJoCo's velocities at which every integrator fails."""
    states, model = simulation.states([rope]), simulation.rope.model
    states[:, 1 + model.nq : 1 + model.nq + model.nv] = velocity  # after time and qpos
    simulation.restore(states, [rope])


def rough_play(row: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Where a rope is laid, float64 (nq,), and full pulls, float32 (T, 6); the last is eased.

    Args:
        row: 9, eased to half the force at last; or 29, to none.
    """
    states = read_states(shipped(), images=False)
    rng = np.random.default_rng(0)
    start = rng.choice(np.flatnonzero(states.nx >= 2), 64)[row]
    actions = rng.uniform(-1, 1, ({9: 5, 29: 9}[row], 64, 6)).astype(np.float32)[:, row]
    actions[:, 3:] = np.sign(actions[:, 3:])
    return states.qpos[start], actions


@pytest.fixture(scope="session")
def trefoils(rope: Rope) -> States:
    """Trefoils drawn from their codes: in each split two with three crossings, of both codes, and
    two with four.
    """
    codes = [*codes_of("3_1", 3), *codes_of("3_1", 4)[:2]]
    drawn = [
        drawn_curve(code, np.random.default_rng(number), rope)
        for number, code in enumerate([code for code in codes for _ in range(2)])
    ]
    return States.from_points(np.array(drawn), ["train", "test"] * len(codes))


@pytest.fixture
def sound(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the process in which `verify` reads files first, as one may crash the HDF5 library."""
    monkeypatch.setattr("knotgym.cli.inspection.try_files", lambda *_: None)
