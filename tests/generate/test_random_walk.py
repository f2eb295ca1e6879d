"""Random walks: states as random play meets them, made again from nothing but a key."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from knotgym.common.configuration import as_json, updated
from knotgym.common.errors import InvalidFile, InvalidInput
from knotgym.datasets.state_verification import folder_faults, state_faults
from knotgym.generate.states.random_walk import (
    RandomWalkConfig,
    TwistLimits,
    Walked,
    WalkUnit,
    coil,
    walk,
)
from knotgym.generate.states.random_walk_recipe import RandomWalkRecipe
from knotgym.quality.measures import measure
from knotgym.rope.model import Rope
from knotgym.states.state_file import read_states, write_states
from knotgym.topology.crossings import label

from ..small_job import knotgym

SMALL = RandomWalkConfig(nx=(1, 2), count=2, burn_in=12, every=2, longest=30, batch=3, wave=1)
WANTED = ("generate", "--source", "random-walk", "--nx", "1,2", "--count", 2, "--workers", 1)


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("settings") / "walks.json"
    names = ("burn_in", "every", "longest", "batch", "wave")
    path.write_text(json.dumps({name: as_json(SMALL)[name] for name in names}))
    return path


@pytest.fixture(scope="module")
def walked(settings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of four states; only ever read."""
    folder = tmp_path_factory.mktemp("walked") / "nx1-2"
    assert knotgym(*WANTED, "--settings", settings, "--out", folder, "--quiet") == 0
    return folder


@pytest.fixture(scope="module")
def unit() -> Walked:
    """What comes of the first ropes."""
    return walk(WalkUnit(SMALL, 0))


@pytest.mark.thorough
def test_a_folder_of_random_walks_has_no_fault_and_no_demonstrations(walked: Path) -> None:
    assert list(folder_faults(walked)) == []
    names = {path.name for path in walked.iterdir()}
    assert names == {"states.h5", "gallery.png", "README.md", "manifest.json"}
    assert "uniform random actions" in (walked / "README.md").read_text()


def test_no_rope_is_in_both_splits_and_half_is_train(walked: Path) -> None:
    states = read_states(walked / "states.h5", images=False)
    assert Counter(zip(states.nx.tolist(), states.split.tolist(), strict=True)) == {
        (nx, split): 1 for nx in (1, 2) for split in ("train", "test")
    }
    ropes = [set(states.source["trajectory"][states.split == s]) for s in ("train", "test")]
    assert not ropes[0] & ropes[1]


def test_a_unit_gives_the_same_states_again(walked: Path, unit: Walked) -> None:
    states = read_states(walked / "states.h5", images=False)
    found = {(one.rope, one.code.nx): one for one in unit.states}
    first = int(np.argmin(states.source["trajectory"]))
    again = found[int(states.source["trajectory"][first]), int(states.nx[first])]
    assert np.array_equal(again.qpos, states.qpos[first]) and again.step <= SMALL.longest


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [
        ("source/steps", 3, "replay of its start"),
        ("source/steps", 10**7, "a random walk takes 0 to 100000 actions, got 10000000"),
        ("source/seed", (30, 9, 0, 0, 0), "replay of its start"),
        ("source/seed", (8, 0, 0, 0, 0), "seed (8, 0, 0, 0, 0) is not a stream of a random walk's"),
        ("source/seed", (-1, 0, 0, 0, 0), "seed (-1, 0, 0, 0, 0) is not a stream"),
        ("source/policy", "somebody", "states.h5: source/actions is missing"),
    ],
)
def test_a_provenance_that_does_not_lead_there_is_named(
    walked: Path, tmp_path: Path, name: str, value: object, fault: str
) -> None:
    path = tmp_path / "states.h5"
    write_states(path, read_states(walked / "states.h5").taken(np.array([0])))
    with h5py.File(path, "a") as file:
        file[name][0] = value
    found = [line.removeprefix("states.h5 row 0: ") for line in state_faults(read_states(path))]
    assert any(line.startswith(fault) for line in found)


def test_a_run_is_taken_up_where_it_was_saved(tmp_path: Path, unit: Walked) -> None:
    recipe, again = RandomWalkRecipe(SMALL), RandomWalkRecipe(SMALL)
    assert not again.load(tmp_path)
    next(iter(recipe.batches(tmp_path))).absorb(WalkUnit(SMALL, 0), unit)
    recipe.save(tmp_path)
    assert again.load(tmp_path) and again.walked == recipe.walked == SMALL.batch
    assert again.report() == recipe.report() and again.status() == recipe.status()
    assert [one.step for one in again.accepted] == [one.step for one in recipe.accepted]
    (tmp_path / "accepted.npz").write_bytes(b"")
    with pytest.raises(InvalidFile):
        again.load(tmp_path)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--source", "drawn"), "--source takes drawing or random-walk, got 'drawn'"),
        (("--source", "random-walk", "--knot", "3_1"), "--knot needs --source drawing"),
        (("--source", "random-walk", "--set", "run.shard=1/2"), "support --shard: leave it out"),
    ],
)
def test_what_goes_with_another_source_is_one_line(
    settings: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    named: str,
) -> None:
    out = ("--settings", settings, "--out", tmp_path / "out")
    assert knotgym("generate", "--nx", "2", *words, *out) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert named in line and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "wrong", [{"nx": [7]}, {"nx": []}, {"start": "knot"}, {"longest": 5}, {"every": 0}]
)
def test_walks_that_make_no_sense_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InvalidInput):
        updated(SMALL, wrong)


def test_ropes_are_dealt_out_to_the_splits_as_wanted() -> None:
    config = replace(SMALL, count=40, loops=17)
    assert [config.wanted(0, split) for split in ("train", "test")] == [9, 8]
    assert [config.wanted(3, split) for split in ("train", "test")] == [20, 20]
    assert Counter(config.split(rope) for rope in range(100)) == {"train": 50, "test": 50}


def test_only_over_twist_and_lost_codes_are_against_a_state(rope: Rope) -> None:
    quality = measure(rope.loop())
    assert TwistLimits().faults(quality) == []
    assert TwistLimits(total_curvature=0.9).faults(quality) == ["total_curvature"]
    twisted = replace(quality, excess_crossing_number=9.0, noise_survival=0.0)
    assert TwistLimits().faults(twisted) == ["excess_crossing_number", "noise_survival"]


def test_the_coil_is_as_small_as_the_published_one(rope: Rope) -> None:
    points = coil(rope)
    radius = np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean())
    assert label(points).nx == 1 and 0.10 < radius < 0.12
