"""Marked observations are the same for all images of a state; actions map back to the world."""

import numpy as np
import pytest

from knotgym.envs.environment import KnotEnv
from knotgym.envs.marked import TOKENS, Marked
from knotgym.topology import GaussCode, Symmetry, label

from ..topology.test_crossings import random_curve

GOALS = [GaussCode.parse(text) for text in ("1+,2-,2+,1-", "1-,2+,1+,2-", "1+,1-,2-,2+", "")]
SYMMETRIES = [
    Symmetry(turn=1.0),
    Symmetry(reflect=True, turn=2.0),
    Symmetry(switch=True, turn=-0.5),
    Symmetry(reverse=True, turn=3.0),
    Symmetry(reflect=True, switch=True, turn=0.3, reverse=True),
]


ROPES = np.stack([random_curve(seed, modes=8) for seed in range(40)])


def image(symmetry: Symmetry, goal: GaussCode) -> GaussCode:
    goal = goal.switched() if symmetry.switch else goal
    return goal.reversed() if symmetry.reverse else goal


def pairs(symmetry: Symmetry) -> tuple[Marked, Marked]:
    """Observations of ropes, and of their images under a symmetry with the image of the goal."""
    ropes = ROPES
    goals = [GOALS[row % len(GOALS)] for row in range(len(ropes))]
    moved = np.stack([symmetry.vertices(rope) for rope in ropes])
    return Marked.of(ropes, goals), Marked.of(moved, [image(symmetry, goal) for goal in goals])


@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_images_of_a_state_look_the_same(symmetry: Symmetry) -> None:
    here, there = pairs(symmetry)
    assert np.array_equal(here.goal, there.goal) and np.array_equal(here.code, there.code)
    # a rope whose code and goal are their own images can be seen in two ways
    same = np.abs(here.points - there.points).max(axis=(1, 2)) < 1e-9
    assert same.mean() > 0.8
    if not symmetry.reverse:
        assert same[here.goal[:, 0, 0] != 0].all()
    assert np.array_equal(here.marks[same], there.marks[same])


@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_an_action_chosen_in_the_frame_is_transformed_with_the_rope(symmetry: Symmetry) -> None:
    here, there = pairs(symmetry)
    rows = np.flatnonzero(np.abs(here.points - there.points).max(axis=(1, 2)) < 1e-9)
    beads, sides = np.full(len(here.points), 12), np.ones(len(here.points), dtype=int)
    force = np.tile((0.3, -0.7, 0.5), (len(here.points), 1))
    ours, theirs = (
        (frames.renumber(beads), frames.sides(sides), frames.vectors(force, back=True))
        for frames in (here.frames, there.frames)
    )
    for row in rows:
        assert symmetry.beads(ours[0][row], 100) == theirs[0][row]
        assert ours[1][row] * (-1 if symmetry.switch else 1) == theirs[1][row]
        assert np.allclose(symmetry.vectors(ours[2][row]), theirs[2][row])


def test_marks_and_tokens_tell_the_code_that_the_points_show() -> None:
    ropes, goals = ROPES, [GOALS[row % 3] for row in range(40)]
    seen = Marked.of(ropes, goals)
    for points, marks, code in zip(*seen[:3], strict=True):
        visits = label(points).visits
        assert marks.sum() == len(visits) and (marks[:, 0].sum() == marks[:, 1].sum())
        assert code[: len(visits), 0].tolist() == np.sign(visits)[:TOKENS].tolist()
        for at, (sign, partner) in enumerate(code[code[:, 0] != 0].tolist()):
            assert visits[int(partner)] == -visits[at] and sign == np.sign(visits[at])
    assert (seen.goal[:, 0, 0] == 1).all()


def test_parts_survive_the_vector() -> None:
    seen = Marked.of(ROPES[:5], GOALS[:1] * 5)
    vector = seen.joined()
    assert vector.shape == (5, Marked.size(100)) and vector.dtype == np.float32
    again = Marked.split(vector)
    assert all(np.allclose(a, b, atol=1e-6) for a, b in zip(seen[:4], again[:4], strict=True))
    assert np.array_equal(seen.frames.reverse, again.frames.reverse)


def test_the_environment_shows_its_own_state(states_path: str) -> None:
    env = KnotEnv("tie", nx=2, observation="marked", states=states_path)
    observation, info = env.reset(seed=0)
    episodes = env.episodes
    ours = Marked.of(episodes.simulation.points, [GaussCode.parse(info["goal_gauss_code"])])
    assert np.array_equal(observation, ours.joined()[0])
