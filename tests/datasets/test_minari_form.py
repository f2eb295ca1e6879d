"""Tests of `knotgym.datasets.minari_form`: what Minari loads, and what a forged file gives."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest
from pytest_types import Patch
from synthetic_episodes import TASK, TINY, episodes

from knotgym.datasets import minari_form
from knotgym.datasets.episode_dataset import open_episodes
from knotgym.datasets.episodes import gauss_codes
from knotgym.loaders import statistics

from ..minari_list import check_minari

ID = "knotgym/tie-nx2/tiny-v0"
METADATA = minari_form.MinariMetadata(
    dataset_id=ID,
    algorithm_name="expert",
    description="Three episodes.",
    author=("B", "A"),
    ref_min_score=-5.0,
    ref_max_score=5.0,
    num_episodes_average_score=8,
)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari root with one published dataset; only ever read."""
    out, dataset = tmp_path_factory.mktemp("root"), open_episodes(TINY["expert"])
    minari_form.publish([dataset.episodes], dataset.task, METADATA, out, facts={"run": {"seed": 3}})
    return out


@pytest.fixture
def loaded(root: Path, monkeypatch: Patch) -> minari.MinariDataset:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    return minari.load_dataset(ID)


def test_minari_does_it_all(root: Path, loaded: minari.MinariDataset, monkeypatch: Patch) -> None:
    check_minari(root, ID, monkeypatch)
    (_, steps), offsets = (made := open_episodes(TINY["expert"]).episodes), made.offsets
    for one, first, last in zip(loaded.iterate_episodes(), offsets, made.last(), strict=False):
        codes = [code.decode() for code in one.infos["gauss_code"]]
        assert codes == gauss_codes(steps["visits"][first : last + 1]).tolist()
        assert one.infos["is_success"].tolist() == [False] * (last - first) + [True]
        assert one.infos["bead"].tolist() == [-1, *steps["bead"][first:last].tolist()]
    assert minari.get_normalized_score(loaded, np.array([0.0])) == 0.5


def test_minari_metadata_hold_what_normalizes(root: Path, loaded: minari.MinariDataset) -> None:
    stored = loaded.storage.metadata["statistics"]
    own = statistics(root / ID, observation="state")
    for name, stored_as in (("observations", "observations/state"), ("actions", "actions")):
        for what, values in own[name].items():
            np.testing.assert_allclose(stored[stored_as][what], values, rtol=1e-5, atol=1e-7)


def test_metadata_comes_back(root: Path) -> None:
    dataset = open_episodes(root / ID)
    assert minari_form.metadata_of(dataset) == METADATA and dataset.facts["run"] == {"seed": 3}
    assert minari_form.metadata_of(open_episodes(root / ID)) == replace(METADATA, author=("A", "B"))


def test_no_object_of_a_file_has_a_time_so_that_equal_data_have_equal_bytes(root: Path) -> None:
    times = set()
    with h5py.File(root / ID / "data/main_data.hdf5") as file:
        file.visititems(lambda name, one: times.add(h5py.h5g.get_objinfo(one.id).mtime))
    assert times == {0}


def test_large_sets_and_recordings_have_no_minari_form(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("knotgym.datasets.minari_form.MINARI_STEPS", 2)
    for made, form, has_it in (
        (episodes([3]), "", False),
        (episodes([1]).recording(), "", False),
        (episodes([1]), "columns", False),
        (episodes([3]), "minari", True),
    ):
        folder = minari_form.publish([made], TASK, METADATA, tmp_path, overwrite=True, form=form)
        lines = minari_form.loading_lines(METADATA.dataset_id, tmp_path)
        assert len([*(folder / "data").iterdir()]) == (3 if has_it else 1)
        assert ("minari.load_dataset" in lines[0]) == has_it == ("--to minari" not in lines[1])


def test_a_state_file_is_carried_and_found_by_the_id(tmp_path: Path) -> None:
    (tmp_path / "s.h5").write_bytes(b"states")
    task = replace(TASK, states="s.h5")
    folder = minari_form.publish(
        [episodes([1])], task, METADATA, tmp_path, states=tmp_path / "s.h5"
    )
    dataset = open_episodes(folder)
    assert dataset.task.states == ID
    assert dataset.states_path() == folder / "data/states.h5"


def entry(name: str, value: object) -> Callable[[Path], None]:
    """Forge an entry of the metadata."""

    def forge(data: Path) -> None:
        entries = json.loads((data / "metadata.json").read_text())
        (data / "metadata.json").write_text(json.dumps({**entries, name: value}))

    return forge


def array(change: Callable[[h5py.Group], object]) -> Callable[[Path], None]:
    """Harm arrays of an episode."""

    def harm(data: Path) -> None:
        with h5py.File(data / "main_data.hdf5", "r+") as file:
            change(file["episode_1"])

    return harm


def shift(name: str, one: h5py.Group) -> None:
    one[name][0] = one[name][0] + 1


@pytest.mark.parametrize(
    ("named", "harm"),
    [
        (": total_steps isn't", entry("total_steps", 7)),
        (": statistics isn't", entry("statistics", {})),
        (": jpeg_encoding isn't", entry("jpeg_encoding", True)),
        ("env_spec", entry("env_spec", '{"id": "knotgym/Tie-v0", "entry_point": "os:system"}')),
        *(
            (name, array(partial(shift, name)))
            for name in (
                *("actions", "rewards", "infos/bead"),
                *("observations/state", "observations/pixels"),
            )
        ),
        ("rewards", array(lambda one: one.__delitem__("rewards"))),
        ("main_data.hdf5", lambda data: (data / "main_data.hdf5").unlink()),
    ],
)
def test_what_does_not_follow_from_the_episodes_is_a_fault(
    root: Path, tmp_path: Path, named: str, harm: Callable[[Path], None]
) -> None:
    copy = shutil.copytree(root / ID, tmp_path / "copy")
    harm(copy / "data")
    assert any(named in fault for fault in minari_form.minari_faults(open_episodes(copy)))


def test_a_link_is_not_copied(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("private")
    (tmp_path / "a").symlink_to(tmp_path / "secret")
    with pytest.raises(OSError):
        minari_form.copy_file(tmp_path / "a", tmp_path / "copy")
