"""Ropes of other lengths, and codes from lists: a rope's number of beads is stated everywhere."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import knotgym
from knotgym.common import InvalidFile, InvalidInput, InvalidPolicy
from knotgym.control import PolicyConfig, make_policy
from knotgym.envs import KnotEnv, TaskConfig
from knotgym.rendering import PictureConfig, draw
from knotgym.rope import RopeConfig
from knotgym.states import merge_states, read_states, shipped

from ..small_job import knotgym as run

BEADS = 60


@pytest.fixture(scope="module")
def states(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("beads") / "a"
    given = f"--no-demonstrations --nx 0,1 --count 2 --set beads={BEADS} --engine chain --workers 1"
    assert run("generate", *given.split(), "--out", folder) == 0
    return folder / "states.h5"


def test_states_of_another_rope_say_so_and_have_no_fault(states: Path) -> None:
    held = read_states(states)
    assert held.points.shape == (4, BEADS, 3)
    assert held.attributes["rope"] == RopeConfig.of(BEADS).fingerprint
    assert held.attributes["config"]["beads"] == BEADS
    assert held.image is not None
    assert np.array_equal(held.image[0], draw(held.points[0], PictureConfig.of(BEADS)))
    assert knotgym.verify(states) == []


def test_an_environment_has_the_rope_that_it_is_told_and_no_other(states: Path) -> None:
    given: dict[str, Any] = {"nx": 1, "states": str(states), "observation": "state"}
    env = KnotEnv("unknot", beads=BEADS, **given)
    assert env.observation_space.shape == (6 * BEADS,)
    seen, info = env.reset(seed=0)
    assert seen.shape == (6 * BEADS,) and info["crossings"] == 1
    assert env.step(env.action_space.sample())[0].shape == (6 * BEADS,)
    assert TaskConfig(task="unknot", nx=22, beads=200).nx == 22  # crossings need beads
    with pytest.raises(InvalidInput, match="has ropes of 60 beads, got beads = 100; use 60"):
        KnotEnv("unknot", **given)
    with pytest.raises(InvalidInput, match="has ropes of 100 beads, got beads = 60; use 100"):
        KnotEnv("unknot", beads=BEADS)


def test_ropes_are_not_mixed(states: Path) -> None:
    with pytest.raises(InvalidFile, match="must have one rope model"):
        merge_states([read_states(states), read_states(shipped())])


@pytest.mark.clients
def test_a_learner_of_the_usual_rope_refuses_another() -> None:
    pytest.importorskip("torch")
    policy = make_policy(PolicyConfig(policy="pretrained-clone"))
    with pytest.raises(InvalidPolicy, match="needs a rope of 100 beads, got 60"):
        policy.compatible_task(TaskConfig(task="tie", action="macro", beads=BEADS))
