"""`knotgym generate` from end to end: what it leaves, and nothing after a mistake; that its bytes
are the same however it was run is in tests/runs/test_runner.py.
"""

import json
from pathlib import Path
from typing import Any

import minari
import mujoco
import numpy as np
import pytest
from pytest_types import Patch

import knotgym as package
from knotgym.cli.generate_command import _code_list
from knotgym.common import InvalidInput, sha256
from knotgym.rope import Rope
from knotgym.states import States, read_states


@pytest.fixture(scope="module")
def states(curated: Path) -> States:
    states = read_states(curated / "states.h5")
    assert len(states) == 8
    return states


@pytest.fixture(scope="module")
def manifest(curated: Path) -> dict[str, Any]:
    return json.loads((curated / "manifest.json").read_text())


# What is in the folder.


def test_the_folder_holds_what_the_contract_lists_and_the_manifest_every_file_of_it(
    curated: Path, manifest: dict[str, Any]
) -> None:
    names = {path.name for path in curated.iterdir()}
    assert names == {"states.h5", "minari", "gallery.png", "README.md", "manifest.json"}
    assert [path.name for path in curated.parent.iterdir()] == ["nx0-1"]
    files = {path for path in curated.rglob("*") if path.is_file()} - {curated / "manifest.json"}
    assert manifest["files"] == {str(one.relative_to(curated)): sha256(one) for one in files}


def test_configuration_versions_and_the_rope_are_written_with_the_states(
    manifest: dict[str, Any], states: States, curated: Path, rope: Rope
) -> None:
    attributes = states.attributes
    assert manifest["config"] == attributes["config"] and manifest["config"]["nx"] == [0, 1]
    assert '"train_share": 0.5' in (curated / "README.md").read_text()
    versions = package.__version__, mujoco.__version__
    assert (attributes["knotgym"], attributes["mujoco"]) == versions
    assert attributes["rope"] == rope.config.fingerprint
    # both splits have as many states as asked for, of as many codes as there are
    assert sorted(states.gauss_code.tolist()) == [""] * 4 + ["1+,1-"] * 2 + ["1-,1+"] * 2
    for nx in (0, 1):
        assert sorted(states.split[states.nx == nx].tolist()) == ["test"] * 2 + ["train"] * 2


# What can be done with it.


@pytest.mark.parametrize(
    ("name", "nx", "split"),
    [
        ("knotgym/unknot-nx0/demonstrations-v0", 0, "train"),
        ("knotgym/tie-nx1/demonstrations-v0", 1, "train"),
        ("knotgym/tie-nx1/demonstrations-test-v0", 1, "test"),
    ],
)
def test_minari_loads_the_trajectories_of_one_split(
    curated: Path, states: States, monkeypatch: Patch, name: str, nx: int, split: str
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(curated / "minari"))
    dataset = minari.load_dataset(name)
    assert dataset.total_episodes == 2
    env: Any = dataset.recover_environment().unwrapped
    assert env.config.split == split
    for row, episode in zip(states.rows(nx, split), dataset.iterate_episodes(), strict=True):
        goals = {text.decode() for text in episode.infos["goal_gauss_code"]}
        assert goals == {states.gauss_code[row]}
        steps = states.source["step"][row]
        assert len(episode.actions) == steps
        assert episode.infos["gauss_code"][-1].decode() == states.gauss_code[row]
        assert episode.terminations.tolist() == [False] * (steps - 1) + [True]
        assert not episode.truncations.any()
        assert states.image is not None  # beside the rope its goal, the state, is shown
        assert np.array_equal(episode.observations["pixels"][-1, :, 128:], states.image[row])
        _, info = env.reset(seed=0, options={"goal": int(row)})
        assert info["goal_gauss_code"] == states.gauss_code[row]
        assert np.array_equal(env.episodes.goal_points(0), states.points[row])


# What is refused.


def test_a_list_of_codes_may_be_sampled_and_filtered(tmp_path: Path, monkeypatch: Patch) -> None:
    path = tmp_path / "codes.txt"
    path.write_text(
        "\ufeff# kinks\n1 -1\n-1 1  # below\n\n1+,1-,2+,2-\n[[2,2,1,1]]\n[4,6,2]\n", "utf-8"
    )

    def read(
        nx: tuple[int, ...] | None = None, count: int | None = None, seed: int = 0
    ) -> list[str]:
        rng = np.random.default_rng(seed)
        return [str(code) for code in _code_list(path, nx, count, rng)]

    everything = read()
    assert len(everything) == 5 and everything[0] == "1+,1-"
    assert read((2, 3)) == everything[2:3] + everything[4:]
    samples = {tuple(read(count=2, seed=seed)) for seed in range(40)}
    assert all(len(one) == 2 for one in samples) and len(samples) > 5
    assert read(count=2, seed=3) == read(count=2, seed=3)
    assert read(count=9) == everything  # in the order of the file
    monkeypatch.setattr("knotgym.cli.generate_command.MOST_CODES", 4)
    with pytest.raises(InvalidInput, match="more than 4 codes"):
        read()
