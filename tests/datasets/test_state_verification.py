"""Verification finds every harm done to a folder of curated states, and names the file, the row and
what is wrong.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.common.atomic_files import sha256
from knotgym.datasets.cards.state_card import summary
from knotgym.datasets.state_verification import folder_faults, overlap_faults, state_faults
from knotgym.datasets.verification import OVERLAPS
from knotgym.states.schema import DIGEST
from knotgym.states.state_file import read_states, shipped, write_states

from ..small_job import knotgym

DATASET = "knotgym/tie-nx1/demonstrations-v0"
TRAJECTORIES = f"minari/{DATASET}/data/main_data.hdf5"


@pytest.fixture
def copy(curated: Path, tmp_path: Path) -> Path:
    """A folder to do harm to."""
    return Path(shutil.copytree(curated, tmp_path / "copy"))


@pytest.fixture
def light(copy: Path) -> Path:
    """A state with a crossing of each split, without trajectories, which take longest to verify."""
    shutil.rmtree(copy / "minari")
    states = read_states(copy / "states.h5")
    keep_rows(copy, np.array([states.rows(1, split)[0] for split in ("train", "test")]))
    return copy


@pytest.fixture
def one_set(copy: Path) -> Path:
    """One of its sets of trajectories, and the states that these lead to."""
    for folder in (copy / "minari" / "knotgym").iterdir():
        for dataset in folder.iterdir():
            if copy / TRAJECTORIES not in dataset.rglob("main_data.hdf5"):
                shutil.rmtree(dataset)
    keep_rows(copy, np.flatnonzero(read_states(copy / "states.h5").source["dataset"] == DATASET))
    return copy


def keep_rows(folder: Path, rows: NDArray[np.int64]) -> None:
    """Leave only some of its states in a folder, and what is gone out of its manifest."""
    states = read_states(folder / "states.h5")
    assert 0 < len(rows) < len(states)
    (folder / "states.h5").unlink()
    write_states(folder / "states.h5", states.taken(rows))
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["splits"] = [manifest["splits"][row] for row in rows]
    manifest["summary"] = summary(states.taken(rows))
    manifest["files"] = {
        name: sha256(folder / name) for name in manifest["files"] if (folder / name).is_file()
    }
    (folder / "manifest.json").write_text(json.dumps(manifest))


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """A file to change, as somebody would who covers up: its own checksum is gone."""
    with h5py.File(path, "a") as file:
        file.attrs.pop(DIGEST, None)
        yield file


def listed_anew(folder: Path) -> None:
    """Make the manifest agree with the files, as somebody would who covers up."""
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"] = {name: sha256(folder / name) for name in manifest["files"]}
    (folder / "manifest.json").write_text(json.dumps(manifest))


def faults(folder: Path) -> list[str]:
    """Faults with the checksums made right: what the contents alone give away."""
    listed_anew(folder)
    return list(folder_faults(folder))


def altered(folder: Path, name: str, row: Any, value: Any) -> None:
    with opened(folder / "states.h5") as file:
        file[name][row] = value


def test_the_states_that_ship_have_no_fault_in_their_first_rows() -> None:
    states = read_states(shipped())
    assert len(states) == 177
    few = type(states)(**{name: _few(value, [0, 1, 2]) for name, value in vars(states).items()})
    assert len(few) == 3 and list(state_faults(few)) == []


def _few(value: Any, rows: list[int]) -> Any:
    """Some rows of an attribute of States, whatever it is."""
    if isinstance(value, dict):
        return {name: _few(column, rows) for name, column in value.items()}
    return value[rows] if isinstance(value, np.ndarray) else value


def test_a_changed_byte_in_any_file_is_named(light: Path) -> None:
    for path in (light / "gallery.png", light / "README.md", light / "archive.h5"):
        path.write_bytes(path.read_bytes() + b" ")
    expected = [
        f"{name} is not the file the manifest lists (SHA-256 differs)"
        for name in ("README.md", "archive.h5", "gallery.png")
    ]
    assert sorted(folder_faults(light)) == expected


def test_a_missing_file_is_named(one_set: Path) -> None:
    (one_set / TRAJECTORIES).unlink()
    assert list(folder_faults(one_set)) == [f"{TRAJECTORIES} is missing"]


def test_missing_states_are_named(copy: Path) -> None:
    (copy / "states.h5").unlink()
    assert list(folder_faults(copy)) == [
        "states.h5 is missing",
        f"no state file at {copy / 'states.h5'}",
    ]


@pytest.fixture(scope="module")
def pair(curated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state file of two of the rows: a loop, and a state with one crossing."""
    states = read_states(curated / "states.h5")
    path = tmp_path_factory.mktemp("pair") / "states.h5"
    write_states(path, type(states)(**{name: _few(v, [0, 5]) for name, v in vars(states).items()}))
    return path


ENDS_ELSEWHERE = "replay of its start and actions does not end in qpos bit for bit"


@pytest.mark.parametrize(
    ("name", "row", "value", "fault"),
    [
        ("gauss_code", 1, "1-,1+,2+,2-", "gauss_code is 1-,1+,2+,2-, recomputed"),
        ("gauss_code", 1, "gibberish", "gauss_code is gibberish, recomputed"),
        ("gauss_code_chiral", 1, "", "gauss_code_chiral is , recomputed 1"),
        ("nx", 0, 2, "nx is 2, recomputed 0"),
        ("knot", 0, "3_1", "knot is 3_1, recomputed 0_1"),
        ("image", (0, 64, 64, 1), 77, "image is not the picture of points"),
        ("points", (1, 50, 2), 0.25, "points are not those of qpos"),
        ("qpos", (1, 3), 0.25, ENDS_ELSEWHERE),
        ("split", 1, "dev", "split is 'dev'"),
        ("source/actions", (1, 0, 3), 0.123, ENDS_ELSEWHERE),
        ("source/actions", (1, 0, 3), 1.5, "an action lies outside [-1, 1]"),
        ("source/start_qpos", (1, 0), 0.123, ENDS_ELSEWHERE),
        ("source/steps", 1, 1, ENDS_ELSEWHERE),
    ],
)
def test_an_altered_value_is_found_without_the_checksums(
    pair: Path, tmp_path: Path, name: str, row: Any, value: Any, fault: str
) -> None:
    harmed = Path(shutil.copy(pair, tmp_path / "states.h5"))
    altered(tmp_path, name, row, value)
    found = list(state_faults(read_states(harmed)))
    at = f"states.h5 row {row if isinstance(row, int) else row[0]}: "
    assert any(line.startswith(at + fault) for line in found), found
    assert all(line.startswith(at) for line in found), found


def test_two_rows_of_a_file_have_no_fault_themselves(pair: Path) -> None:
    assert list(state_faults(read_states(pair))) == []


def test_the_least_change_of_one_qpos_is_found(pair: Path, tmp_path: Path) -> None:
    harmed = Path(shutil.copy(pair, tmp_path / "states.h5"))
    with opened(harmed) as file:
        file["qpos"][0, 10] = np.nextafter(file["qpos"][0, 10], 1)
    assert any("row 0: replay" in one for one in state_faults(read_states(harmed)))


def test_a_swapped_split_is_found(light: Path) -> None:
    with opened(light / "states.h5") as file:
        splits = file["split"].asstr()[()].tolist()
        train, test = splits.index("train"), splits.index("test")
        file["split"][train], file["split"][test] = "test", "train"
    assert faults(light) == sorted(
        [
            f"states.h5 row {train}: split is test, the manifest says train",
            f"states.h5 row {test}: split is train, the manifest says test",
        ]
    )


def test_a_state_in_both_splits_is_a_leak(copy: Path) -> None:
    with opened(copy / "states.h5") as file:
        splits = file["split"].asstr()[()].tolist()
        train, test = splits.index("train", 4), splits.index("test", 4)
        for name in (
            "qpos",
            "points",
            "image",
            "gauss_code",
            "gauss_code_chiral",
            *(f"source/{key}" for key in file["source"]),
        ):
            file[name][test] = file[name][train]
    found = list(state_faults(read_states(copy / "states.h5")))
    near = f"states.h5 rows {train} (train) and {test} (test) are near-duplicates: 0.0 mm apart"
    assert any(fault.startswith(near) for fault in found)
    assert f"states.h5 rows {train} (train) and {test} (test) come from one trajectory" in found


def test_a_wrong_overlap_in_the_manifest_is_found(light: Path) -> None:
    manifest = json.loads((light / "manifest.json").read_text())
    manifest["summary"]["nx"]["1"]["overlap"]["code_in_train"] = 7
    (light / "manifest.json").write_text(json.dumps(manifest))
    assert any("nx 1: code_in_train of the overlap is 7, should be" in one for one in faults(light))


@pytest.mark.parametrize("name", ["readable", "random-walk", "hard-unknots"])
def test_what_train_and_test_of_a_shipped_set_share_is_as_said(name: str) -> None:
    said = json.loads(shipped(name).with_name(OVERLAPS).read_text())[shipped(name).name]
    states = read_states(shipped(name), images=False)
    assert list(overlap_faults(states, said, OVERLAPS)) == []
    assert said.keys() == {str(nx) for nx in states.nx}


def test_a_code_in_both_splits_is_a_fault_where_they_should_share_none(light: Path) -> None:
    manifest = json.loads((light / "manifest.json").read_text())
    manifest["config"]["split_by"] = "code"
    (light / "manifest.json").write_text(json.dumps(manifest))
    (code,) = set(read_states(light / "states.h5").gauss_code)
    assert f"code {code} is in both splits, which should share no code" in list(
        folder_faults(light)
    )


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_truncated_states_are_named(copy: Path, share: float) -> None:
    raw = (copy / "states.h5").read_bytes()
    (copy / "states.h5").write_bytes(raw[: int(share * len(raw))])
    checksum, unreadable = folder_faults(copy)
    assert (
        checksum == "states.h5 is not the file the manifest lists (SHA-256 differs)"
        and "states.h5 isn't a whole state file" in unreadable
    )


def test_a_truncated_trajectory_file_is_named(one_set: Path) -> None:
    (one_set / TRAJECTORIES).write_bytes((one_set / TRAJECTORIES).read_bytes()[:-5000])
    found = faults(one_set)
    assert found and all(TRAJECTORIES in fault for fault in found)


def test_an_edited_trajectory_is_named_with_its_episode(one_set: Path) -> None:
    with opened(one_set / TRAJECTORIES) as file:
        file["episode_1/actions"][1, 1] = 0.0625
    found = faults(one_set)
    assert found and all(f"{TRAJECTORIES}, episode 1" in fault for fault in found)


def test_edited_pixels_of_a_trajectory_are_named_with_their_episode(one_set: Path) -> None:
    with opened(one_set / TRAJECTORIES) as file:
        file["episode_1/observations/pixels"][0, 3, 3] = (9, 9, 9)
    assert [fault.split(": ", 1)[0].endswith("episode 1") for fault in faults(one_set)] == [True]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"files": 3, "config": {}}'])
def test_a_manifest_that_cannot_be_read_is_a_fault(copy: Path, text: str) -> None:
    (copy / "manifest.json").write_text(text)
    assert next(folder_faults(copy)).startswith("manifest.json can't be read: ")


@pytest.mark.parametrize("name", ["start_qpos", "actions", "steps", "seed"])
def test_a_missing_provenance_is_named(copy: Path, name: str) -> None:
    with opened(copy / "states.h5") as file:
        del file["source"][name]
    (fault,) = state_faults(read_states(copy / "states.h5"))
    assert fault.startswith(f"states.h5: source/{name} is missing, should be (8")


def test_columns_of_another_shape_are_named(copy: Path) -> None:
    with opened(copy / "states.h5") as file:
        halves = file["points"][:, :50]
        del file["points"]
        file["points"] = halves
    assert list(state_faults(read_states(copy / "states.h5"))) == [
        "states.h5: points is of shape (8, 50, 3), should be (8, 100, 3)"
    ]


def test_states_of_another_rope_are_not_judged(copy: Path) -> None:
    with opened(copy / "states.h5") as file:
        file.attrs["rope"] = "feedfeedfeedfeed"
    (fault,) = state_faults(read_states(copy / "states.h5"))
    assert fault.startswith("rope model feedfeedfeedfeed is not this version's")


def _flip_label(folder: Path) -> None:
    altered(folder, "gauss_code", 1, "1+,1-,2+,2-")


def _cut_states(folder: Path) -> None:
    (folder / "states.h5").write_bytes((folder / "states.h5").read_bytes()[:5000])


@pytest.mark.parametrize(("harm", "named"), [(_flip_label, "row 1"), (_cut_states, "states.h5")])
def test_the_command_names_faults_and_exits_with_1(
    light: Path, capfd: pytest.CaptureFixture[str], harm: Callable[[Path], None], named: str
) -> None:
    harm(light)
    assert knotgym("dataset", "verify", light, "--quiet") == 1
    lines = capfd.readouterr().out.splitlines()
    assert (
        lines
        and all(line.startswith("fault: ") for line in lines)
        and any(named in line for line in lines)
    )


def test_nothing_at_a_path_is_a_mistake(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert knotgym("dataset", "verify", tmp_path / "absent") == 2
    assert len(capfd.readouterr().err.splitlines()) == 1
