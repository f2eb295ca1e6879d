"""The rope model matches the published one, and configurations and qpos convert without loss."""

from dataclasses import fields
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import NonNegativeFloat

from knotgym.common import InvalidInput, configuration
from knotgym.rope.chain.chain_simulation import ChainSimulation
from knotgym.rope.closed_curves import noised, start_qpos
from knotgym.rope.interface import Simulation
from knotgym.rope.model import Rope, RopeConfig
from knotgym.rope.mujoco_simulation import MujocoSimulation
from knotgym.states import States, read_states, shipped
from knotgym.topology import GaussCode, label, label_many

from ..conftest import trefoil

ROPE = Rope()  # hypothesis tests cannot take function-scoped fixtures
BEAD = RopeConfig().bead_length


def chords(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)


# stored in every file of the rope that ships; another value would make them unreadable
PUBLISHED = "68d74ed3ebfefb54"


@pytest.mark.parametrize("name", [field.name for field in fields(RopeConfig)])
def test_fingerprint_changes_with_every_number(name: str) -> None:
    other: Any = {"radius": 0.004, "beads": 120}.get(name) or 2 * getattr(RopeConfig(), name)
    assert RopeConfig(**{name: other}).fingerprint != RopeConfig().fingerprint


@configuration
class Rubbing(RopeConfig):
    """A rope with a parameter that no file knows."""

    friction: NonNegativeFloat = 0.0


def test_a_neutral_new_parameter_leaves_files_readable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RopeConfig, "of", Rubbing.of)
    assert isinstance(RopeConfig.of(100), Rubbing)
    assert RopeConfig.of(100).fingerprint == read_states(shipped()).attributes["rope"] == PUBLISHED
    gym.make("knotgym/Tie-v0", nx=1, engine="chain").reset(seed=0)
    assert Rubbing(length=2.0).fingerprint == RopeConfig(length=2.0).fingerprint
    assert len({Rubbing(friction=x).fingerprint for x in (0.0, 0.1, 0.2)}) == 3


@pytest.mark.parametrize("engine", [ChainSimulation, MujocoSimulation])
def test_an_engine_refuses_a_parameter_that_it_does_not_carry_out(
    monkeypatch: pytest.MonkeyPatch, engine: type[Simulation]
) -> None:
    engine(1, Rope(Rubbing()))
    with pytest.raises(InvalidInput, match=f"{engine.engine} knows no friction"):
        engine(1, Rope(Rubbing(friction=0.3)))
    monkeypatch.setattr(engine, "parameters", frozenset({"friction"}))
    engine(1, Rope(Rubbing(friction=0.3)))


def test_model_has_the_published_sizes_and_physics(rope: Rope) -> None:
    sizes = rope.model.nq, rope.model.nv, rope.model.nbody - 1, rope.model.neq
    assert sizes == (421, 321, 100, 7)
    option = rope.model.opt
    assert option.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert option.solver == mujoco.mjtSolver.mjSOL_PGS
    assert not option.gravity.any() and option.density == 10000 and option.timestep == 0.008
    assert (rope.model.geom_condim == 1).all()
    assert (rope.model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE).all()
    assert np.allclose(rope.model.geom_size[:, :2], [0.005, BEAD / 2])
    damping = rope.model.dof_damping
    assert set(damping) == {0.0, 0.01} and (damping == 0).sum() == 7 * 6
    assert (rope.model.eq_type == mujoco.mjtEq.mjEQ_CONNECT).all() and rope.model.nexclude == 7


def test_vertices_are_mujocos_body_positions(rope: Rope, tangled: NDArray[np.float64]) -> None:
    data = mujoco.MjData(rope.model)
    rng = np.random.default_rng(0)
    for _ in range(5):
        data.qpos[:] = tangled[0] + rng.normal(0, 0.3, rope.nq)
        mujoco.mj_kinematics(rope.model, data)
        assert np.abs(rope.points(data.qpos) - data.xpos[rope.bodies]).max() < 1e-12


def test_points_come_back_from_qpos(rope: Rope, tangled: NDArray[np.float64]) -> None:
    many = rope.points(tangled.reshape(2, 20, -1))
    assert many.shape == (2, 20, 100, 3)
    for points, qpos in zip(many.reshape(40, 100, 3), tangled, strict=True):
        assert np.array_equal(rope.points(qpos), points)
        assert np.abs(rope.points(rope.qpos(points)) - points).max() < 1e-6


def test_qpos_bears_a_rope_folded_back_on_itself(rope: Rope) -> None:
    flat = rope.loop()
    flat[50:] = flat[49] + np.arange(1, 51)[:, None] % 2 * [BEAD, 0.0, 0.0]  # there and back
    assert np.isfinite(rope.qpos(flat)).all()


def test_loop_is_the_reference_pose_a_flat_ring_of_equal_beads(rope: Rope) -> None:
    assert np.allclose(chords(rope.loop()), BEAD, atol=1e-15) and not rope.loop()[:, 2].any()
    assert np.abs(rope.points(rope.model.qpos0) - rope.loop()).max() < 1e-12


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_trefoil_comes_in_at_any_scale_and_stays_on_its_curve(rope: Rope, scale: float) -> None:
    points = rope.from_curve(scale * trefoil() + 5 * scale)
    assert label(points).nx == 3
    assert np.abs(chords(points) - BEAD).max() < 1e-9
    assert np.abs(points.mean(axis=0)).max() < 1e-9
    assert np.abs(points - rope.from_curve(trefoil())).max() < 1e-6
    # it stays on its curve, from its first point on and in its direction
    fine = trefoil() * rope.config.length / chords(trefoil()).sum()
    off = np.linalg.norm(points[:, None] - fine[None], axis=2)
    assert off.min(axis=1).max() < 0.003 and off[0].argmin() == 0
    assert (np.diff(off.argmin(axis=1)) > 0).all()


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
@settings(max_examples=60)
def test_every_smooth_curve_becomes_equal_beads(seed: int, modes: int) -> None:
    rng = np.random.default_rng(seed)
    at = np.arange(1, modes + 1)[:, None] * np.linspace(0, 2 * np.pi, 240, endpoint=False)
    curve = np.concatenate([np.cos(at), np.sin(at)]).T @ rng.normal(size=(2 * modes, 3))
    points = ROPE.from_curve(curve, max_overlap=1.0)
    assert np.abs(chords(points) - BEAD).max() < 1e-9


@pytest.mark.parametrize(
    ("curve", "message"),
    [
        (np.ones((7, 3)), "at least 4 different points, got 1"),
        (trefoil()[:, :2], r"\(n, 3\) array"),
        (trefoil()[:200], "isn't closed"),
        (np.where(np.arange(300)[:, None] == 7, np.inf, trefoil()), "finite coordinates"),
        (trefoil() * [1, 1, 0], "beads would overlap by 10.0 mm"),
    ],
)
def test_what_is_no_rope_is_refused(rope: Rope, curve: NDArray[np.float64], message: str) -> None:
    with pytest.raises(InvalidInput, match=message) as caught:
        rope.from_curve(curve)
    assert "\n" not in str(caught.value)


# noise at reset keeps a rope closed, its beads equal and its code


def moved_by(points: NDArray[np.float64], scale: float, seed: int) -> NDArray[np.float64]:
    """Noise on one rope."""
    return noised(points[None], scale, [np.random.default_rng(seed)])[0]


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
