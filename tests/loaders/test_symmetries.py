"""Tests of the symmetries of batches: what an image says is what the moved rope does."""

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from synthetic_episodes import TINY

from knotgym.common import InvalidInput
from knotgym.envs import Marked
from knotgym.loaders import GoalSampling, Symmetries, Transitions, Window, arrays
from knotgym.rope import CHAIN, MUJOCO, Rope
from knotgym.rope import simulation as simulation_of
from knotgym.states import read_states, shipped
from knotgym.topology import GaussCode, label_many

Array = NDArray[np.float64]
COUNT = 64
VIEWS = ("pull", "macro")


def orientations(rope: Rope, qpos: Array) -> Array:
    """World orientations of the beads of a rope, as matrices: float64 (beads, 3, 3)."""
    model, data = rope.model, mujoco.MjData(rope.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return np.asarray(data.xmat[rope.bodies].reshape(-1, 3, 3))


def image_of(rope: Rope, qpos: Array, drawn: Symmetries) -> Array:
    """The generalized positions of a rope's image, with the beads' rolls about their own axes."""
    (axes,) = drawn.vectors(np.eye(3)[None]).swapaxes(1, 2)
    world = axes @ orientations(rope, qpos)
    if np.linalg.det(axes) < 0:  # an orientation isn't mirrored: its own y axis is, instead
        world = world @ np.diag([1.0, -1.0, 1.0])
    if drawn.reverse[0]:
        world = world[::-1] @ np.diag([-1.0, 1.0, -1.0])
    quaternions = np.empty((len(world), 4))
    for quaternion, matrix in zip(quaternions, world.reshape(-1, 9), strict=True):
        mujoco.mju_mat2Quat(quaternion, matrix)
    (made,) = rope.turned_qpos(drawn.vertices(rope.points(qpos[None])), quaternions[None])
    return made


@pytest.mark.parametrize(("engine", "exact"), [(CHAIN, 1e-11), (MUJOCO, 1e-5)])
def test_an_image_of_a_step_is_the_step_of_the_image(engine: str, exact: float) -> None:
    states = read_states(shipped(), images=False)
    rng, rope = np.random.default_rng(0), Rope()
    qpos = states.qpos[rng.choice(np.flatnonzero(states.nx > 0), COUNT)]
    beads, force = rng.integers(100, size=COUNT), rng.uniform(-0.5, 0.5, (COUNT, 3))
    drawn = Symmetries.drawn(COUNT, rng)
    each = [Symmetries(*(field[k : k + 1] for field in drawn[:4])) for k in range(COUNT)]
    images = np.array([image_of(rope, *one) for one in zip(qpos, each, strict=True)])
    ends = []
    for start, bead, pull in (
        (qpos, beads, force),
        (images, drawn.beads(beads, 100), drawn.vectors(force)),
    ):
        ropes = simulation_of(engine, COUNT, rope)
        ropes.set_qpos(start)
        ropes.step(bead, pull * ropes.max_force)
        ends.append(ropes.points.copy())
    off = np.abs(drawn.vertices(ends[0]) - ends[1]).max(axis=(1, 2))  # metres
    assert off[~drawn.reverse].max() < exact
    assert off[drawn.reverse].max() < 0.003


def test_a_code_s_image_is_what_the_moved_rope_shows() -> None:
    states = read_states(shipped(), images=False)
    drawn = Symmetries.drawn(len(states), np.random.default_rng(1))
    visits = np.zeros((len(states), 64), dtype=np.int16)
    moved = visits.copy()
    for rows, points in ((visits, states.points), (moved, drawn.vertices(states.points))):
        for row, code in zip(rows, label_many(points), strict=True):
            row[: len(code.visits)] = code.visits
    np.testing.assert_array_equal(drawn._visits(visits), moved)


@pytest.mark.parametrize("view", VIEWS)
def test_symmetries_of_a_batch_change_state_goal_and_action_alike(view: str) -> None:
    batch = arrays(TINY["expert"], observation="state", action=view)
    count = len(batch["actions"])
    still = Symmetries(np.zeros(count), *np.zeros((3, count), dtype=bool))
    for name, values in still.applied(batch).items():
        np.testing.assert_array_equal(values, batch[name])
    drawn = Symmetries.drawn(count, np.random.default_rng(2))
    made = drawn.applied(batch)
    assert len({len(values) for values in made.values()}) == 1


def test_beads_are_numbered_backwards_on_a_rope_of_any_length() -> None:
    flags = np.zeros(2, dtype=bool)
    walked = Symmetries(np.zeros(2), flags, flags, ~flags)
    own = {"actions": np.array([[0, 30, 1], [59, 7, 0]])}
    codes = {**own, "observations": np.zeros((2, 2, 64), np.int16)}
    states = {**own, "observations": np.zeros((2, 6 * 60), np.float32)}
    for made in (walked.applied(states), walked.applied(codes, beads=60)):
        np.testing.assert_array_equal(made["actions"], [[59, 29, 1], [0, 52, 0]])
    assert walked.applied(codes)["actions"][0, 0] == 99


def test_a_rope_alone_moves_like_one_beside_another() -> None:
    window = Window(goals=GoalSampling(negatives=2))
    loader = Transitions(TINY["expert"], observation="state", window=window)
    rows = np.arange(len(loader))
    batch = loader.batch(rows, apart=True, rng=np.random.default_rng(6))
    drawn = Symmetries.drawn(len(rows), np.random.default_rng(7))
    pairs = batch["negatives"].swapaxes(0, 1), (batch["observations"], batch["goals"])
    alone = drawn.applied(batch)
    del batch["goals"], batch["negatives"], batch["next_observations"]
    moved = alone["negatives"].swapaxes(0, 1), (alone["observations"], alone["goals"])
    for pair, own in zip(pairs, moved, strict=True):
        both = drawn.applied(batch | {"observations": np.concatenate(pair, axis=-1)})
        np.testing.assert_array_equal(both["observations"], np.concatenate(own, axis=-1))


def test_strong_pulls_are_dropped() -> None:
    batch = arrays(TINY["random"], observation="symbolic")
    batch["actions"][:, 3:] = (1, 0.3, 0)
    count = len(batch["actions"])
    made = Symmetries.drawn(count, np.random.default_rng(4)).applied(batch)
    assert 0 < len(made["actions"]) < count and np.abs(made["actions"]).max() <= 1 + 1e-6


def test_marked_rows_as_long_as_vertices_of_more_beads_are_refused() -> None:
    """Marked rows of 61 beads have the 414 numbers of vertices of two ropes of 69."""
    points = read_states(shipped(), images=False).points[:2, :61]
    rows = Marked.of(points, [GaussCode()] * 2).joined()
    drawn, actions = Symmetries.drawn(2, np.random.default_rng(0)), np.zeros((2, 6))
    with pytest.raises(InvalidInput, match="marked ones"):
        drawn.applied({"observations": rows, "actions": actions})
    rows[:] = np.random.default_rng(1).normal(size=rows.shape)
    assert len(drawn.applied({"observations": rows, "actions": actions})["observations"]) == 2
