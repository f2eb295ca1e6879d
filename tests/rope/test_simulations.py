"""What both engines promise: batches, threads, saved states, copies, actions; see `Simulation`."""

import pickle

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.common import InvalidInput
from knotgym.rope.engines import ENGINES, simulation
from knotgym.rope.interface import Simulation
from knotgym.rope.model import Rope
from knotgym.rope.mujoco_simulation import MujocoSimulation

from ..conftest import blow_up, curled, rough_play
from ..fresh_interpreter import modules_after

Array = NDArray[np.float64]


@pytest.fixture(scope="module", params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def laid(engine: str, count: int, threads: int = 1) -> Simulation:
    """Ropes of 0 to 4 curls, in turn."""
    ropes = simulation(engine, count, Rope(), threads)
    curls = np.stack([ropes.rope.qpos(ropes.rope.from_curve(curled(nx))) for nx in range(5)])
    ropes.set_qpos(curls[np.arange(count) % 5])
    return ropes


def moved(ropes: Simulation, steps: int, seed: int = 0, ids: list[int] | None = None) -> Array:
    """States after random actions, the same for rope i in a batch of any size."""
    rngs = [np.random.default_rng([seed, i]) for i in range(ropes.count)]
    for _ in range(steps):
        actions = np.array([rng.uniform(-1, 1, 6) for rng in rngs])
        ropes.act(actions if ids is None else actions[ids], ids)
    return ropes.states(ids)


def test_a_simulation_starts_with_plain_loops_and_needs_one(engine: str) -> None:
    ropes = simulation(engine, 2)
    assert (ropes.engine, ropes.count, ropes.applied_shares.tolist()) == (engine, 2, [1, 1])
    assert np.abs(ropes.points - ropes.rope.loop()).max() < 1e-9
    with pytest.raises(InvalidInput, match="at least 1 rope, got 0"):
        simulation(engine, 0)


@pytest.fixture(scope="module")
def nine(engine: str) -> Array:
    return moved(laid(engine, 9), 3)


@pytest.mark.parametrize(("count", "threads"), [(1, 1), (3, 3), (6, 2), (9, 0)])
def test_no_company_changes_a_state(engine: str, nine: Array, count: int, threads: int) -> None:
    assert np.array_equal(moved(laid(engine, count, threads), 3), nine[:count])


def test_ropes_not_named_stand_still(engine: str) -> None:
    ropes = laid(engine, 5)
    before = ropes.states()
    ropes.act(np.full((2, 6), 0.5), [1, 3])
    assert np.array_equal(ropes.states([0, 2, 4]), before[[0, 2, 4]])
    assert not np.array_equal(ropes.states([1]), before[[1]])


def test_a_restored_rope_goes_on_bit_for_bit(engine: str) -> None:
    ropes = laid(engine, 5)
    saved = moved(ropes, 3)
    again, elsewhere = pickle.loads(pickle.dumps(ropes)), simulation(engine, 5, threads=2)
    assert again.rope.config == ropes.rope.config and np.array_equal(again.points, ropes.points)
    moved(elsewhere, 2, seed=9)
    elsewhere.restore(saved[[1, 4]], [1, 4])
    after = moved(ropes, 3, seed=1)
    assert np.array_equal(moved(again, 3, seed=1), after)
    assert np.array_equal(moved(elsewhere, 3, seed=1, ids=[1, 4]), after[[1, 4]])


def test_a_rope_laid_forgets_what_it_did_and_leaves_the_others(engine: str) -> None:
    ropes, fresh = laid(engine, 3), laid(engine, 3)
    before = moved(ropes, 3)
    qpos = ropes.rope.qpos(ropes.rope.from_curve(curled(2)))[None]
    ropes.set_qpos(qpos, [1])
    fresh.set_qpos(qpos, [1])
    assert np.array_equal(ropes.states([0, 2]), before[[0, 2]])
    assert np.array_equal(moved(ropes, 2, ids=[1]), moved(fresh, 2, ids=[1]))


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.full((2, 6), np.nan), r"numbers in \[-1, 1\]"),
        (np.array([[0.0] * 6, [0, 0, 0, 0, 0, 1.001]]), r"got \[0.0, 0.0, 0.0, 0.0, 0.0, 1.001\]"),
        (np.zeros((2, 5)), r"shape \(2, 5\) for 2 ropes"),
    ],
)
def test_bad_actions_are_refused_nothing_moves(engine: str, actions: Array, message: str) -> None:
    ropes = laid(engine, 2)
    before = ropes.states()
    with pytest.raises(InvalidInput, match=message):
        ropes.act(actions)
    assert np.array_equal(ropes.states(), before)


def test_rounding_beyond_1_is_taken_for_1(engine: str) -> None:
    one, other = laid(engine, 1), laid(engine, 1)
    one.act(np.array([[0.1, 0, 0, 1, -1, 1]]))
    other.act(np.array([[0.1, 0, 0, np.nextafter(np.float32(1), np.float32(2)), -1 - 1e-6, 1]]))
    assert np.array_equal(one.states(), other.states())
    with pytest.raises(InvalidInput):
        one.act(np.full((1, 6), 1 + 2e-6))


def test_actions_and_read_actions_are_inverse(engine: str) -> None:
    ropes, rng = laid(engine, 8), np.random.default_rng(0)
    for _ in range(20):
        beads, forces = rng.integers(0, 100, 8), rng.uniform(-1, 1, (8, 3))
        actions = ropes.actions(beads, forces)
        assert actions.dtype == np.float32 and np.abs(actions).max() <= 1
        read, pulled = ropes.read_actions(actions)
        assert np.array_equal(read, beads) and np.abs(pulled - forces).max() < 1e-7
    strong = ropes.actions(np.full(8, 3), np.tile([9.0, -9.0, 0.5], (8, 1)))
    assert np.allclose(strong[:, 3:], [1.0, -1.0, 0.5])


def test_an_action_pulls_the_nearest_bead_where_it_says(engine: str) -> None:
    ropes = simulation(engine, 1)
    at = 1.2 * ropes.points[0, 30] / ropes.rope.config.reach
    action = np.concatenate([at, [0.0, 0.0, 1.0]])[None]
    before = ropes.points[0, 30].copy()
    ropes.act(action)
    assert 0.02 < ropes.points[0, 30, 2] - before[2] < 0.06


def test_a_rope_that_is_not_finite_is_told_and_its_neighbours_move_on(engine: str) -> None:
    ropes, other = laid(engine, 3), laid(engine, 3)
    states = ropes.states([1])
    states[:, 40:60] = np.nan
    ropes.restore(states, [1])
    for _ in range(2):  # and told again
        assert ropes.act(np.full((3, 6), 0.3)).tolist() == [True, False, True]
        other.act(np.full((3, 6), 0.3))
    assert np.array_equal(ropes.states([0, 2]), other.states([0, 2]))
    ropes.set_qpos(ropes.rope.qpos(ropes.rope.loop())[None], [1])
    assert ropes.act(np.zeros((3, 6))).all()


@pytest.mark.thorough
def test_mujocos_engine_leaves_the_chains_kernels_alone() -> None:
    made = "import gymnasium, knotgym; gymnasium.make('knotgym/Tie-v0', nx=2).reset(seed=0)"
    assert not any(name.startswith("knotgym.rope.chain") for name in modules_after(made))


# MuJoCo's engine


def test_one_batched_rope_is_mujocos_own_loop(rope: Rope) -> None:
    simulation, data = MujocoSimulation(1, rope), mujoco.MjData(rope.model)
    rng = np.random.default_rng(0)
    for _ in range(4):
        bead, force = int(rng.integers(100)), rng.uniform(-0.2, 0.2, 3)
        simulation.step([bead], force[None])
        data.xfrc_applied[rope.bodies[bead], :3] = force
        for _ in range(rope.config.frame_skip):
            mujoco.mj_step(rope.model, data)
        data.xfrc_applied[:] = 0
    assert np.array_equal(simulation.qpos()[0], data.qpos)


def test_a_call_refused_by_mujoco_leaves_no_force_behind(rope: Rope) -> None:
    simulation, other = MujocoSimulation(2, rope), MujocoSimulation(2, rope)
    with pytest.raises(ValueError, match="sorted and unique"):
        simulation.step([3, 3], np.full((2, 3), 0.2), [1, 1])
    assert np.array_equal(moved(simulation, 2), moved(other, 2))


@pytest.mark.parametrize("velocity", [1e8, 1e12, np.inf, np.nan])
def test_a_blown_up_rope_is_told_and_stands_where_it_stood(rope: Rope, velocity: float) -> None:
    simulation = MujocoSimulation(3, rope)
    moved(simulation, 2)
    blow_up(simulation, 1, velocity)
    before, points = simulation.states(), simulation.points.copy()
    good = simulation.act(np.full((3, 6), 0.3))
    assert good.tolist() == [True, False, True] == simulation.applied_shares.tolist()
    assert np.array_equal(simulation.states([1]), before[[1]], equal_nan=True)
    assert np.array_equal(simulation.points[1], points[1])
    assert not np.array_equal(simulation.points[0], points[0])


def test_a_force_that_is_no_number_moves_nothing(rope: Rope) -> None:
    simulation = MujocoSimulation(2, rope)
    assert simulation.step([0, 0], [[np.nan, 0, 0], [0.1, 0, 0]]).tolist() == [False, True]
    assert np.isfinite(simulation.points).all()


def test_a_torn_rope_is_told(rope: Rope) -> None:
    simulation = MujocoSimulation(1, rope)
    qpos = rope.qpos(rope.loop())
    qpos[rope.model.jnt_qposadr[rope.model.body_jntadr[1]] + 2] += 0.5  # metres, of one sub-chain
    simulation.set_qpos(qpos[None])
    assert simulation.act(np.zeros((1, 6))).tolist() == [False]


@pytest.mark.parametrize(("row", "share"), [(9, 0.5), (29, 0.0)])
def test_an_eased_step_says_which_share_of_the_force_it_applied(row: int, share: float) -> None:
    qpos, actions = rough_play(row)
    simulation, other = MujocoSimulation(1), MujocoSimulation(1)
    for one in (simulation, other):
        one.set_qpos(qpos[None])
    for action in actions:
        beads, asked = other.read_actions(action[None])
        simulation.act(action[None])
        other.step(beads, simulation.applied_shares[:, None] * (other.max_force * asked))
        assert np.array_equal(simulation.states(), other.states())
    assert simulation.applied_shares.tolist() == [share]
