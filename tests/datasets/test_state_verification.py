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

from knotgym.atomic_files import sha256
from knotgym.datasets.state_verification import folder_faults, state_faults
from knotgym.datasets.states import read_states, shipped

from ..small_job import knotgym

WAYS = "minari/knotgym/tie-nx1/demonstrations-v0/data/main_data.hdf5"


@pytest.fixture
def copy(curated: Path, tmp_path: Path) -> Path:
    """A folder to do harm to."""
    return Path(shutil.copytree(curated, tmp_path / "copy"))


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    with h5py.File(path, "a") as file:
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
    few = type(states)(**{name: _cut(value, 3) for name, value in vars(states).items()})
    assert list(state_faults(few)) == []


def _cut(value: Any, rows: int) -> Any:
    if isinstance(value, dict):
        return {name: _cut(one, rows) for name, one in value.items()}
    return value[:rows] if isinstance(value, np.ndarray) else value


def test_a_changed_byte_in_any_file_is_named(copy: Path) -> None:
    for path in (copy / "gallery.png", copy / "README.md", copy / "archive.h5"):
        path.write_bytes(path.read_bytes() + b" ")
    expected = [
        f"{name} is not the file the manifest lists (SHA-256 differs)"
        for name in ("README.md", "archive.h5", "gallery.png")
    ]
    assert sorted(folder_faults(copy)) == expected


@pytest.mark.parametrize("name", ["gallery.png", WAYS])
def test_a_missing_file_is_named(copy: Path, name: str) -> None:
    (copy / name).unlink()
    assert list(folder_faults(copy)) == [f"{name} is missing"]


def test_missing_states_are_named(copy: Path) -> None:
    (copy / "states.h5").unlink()
    assert list(folder_faults(copy)) == [
        "states.h5 is missing",
        f"no state file at {copy / 'states.h5'}",
    ]


@pytest.mark.parametrize(
    ("name", "row", "value", "fault"),
    [
        ("gauss_code", 5, "1-,1+,2+,2-", "states.h5 row 5: gauss_code is 1-,1+,2+,2-, recomputed"),
        ("gauss_code", 5, "gibberish", "states.h5 row 5: gauss_code is gibberish, recomputed"),
        ("gauss_code_chiral", 4, "", "states.h5 row 4: gauss_code_chiral is , recomputed 1"),
        ("nx", 0, 2, "states.h5 row 0: nx is 2, recomputed 0"),
        ("knot", 3, "3_1", "states.h5 row 3: knot is 3_1, recomputed 0_1"),
        ("image", (2, 64, 64, 1), 77, "states.h5 row 2: image is not the picture of points"),
        ("points", (6, 50, 2), 0.25, "states.h5 row 6: points are not those of qpos"),
        ("points", (6, 50, 2), np.nan, "states.h5 row 6: coordinates are not finite"),
        (
            "qpos",
            (7, 3),
            0.25,
            "states.h5 row 7: replay of its start and actions does not end in qpos bit for bit",
        ),
        ("split", 1, "dev", "states.h5 row 1: split is 'dev'"),
        (
            "source/actions",
            (4, 0, 3),
            0.123,
            "states.h5 row 4: replay of its start and actions does not end in qpos bit for bit",
        ),
        ("source/actions", (4, 0, 3), 1.5, "states.h5 row 4: an action lies outside [-1, 1]"),
        ("source/actions", (4, 0, 3), np.nan, "states.h5 row 4: an action lies outside [-1, 1]"),
        (
            "source/start_qpos",
            (4, 0),
            0.123,
            "states.h5 row 4: replay of its start and actions does not end in qpos bit for bit",
        ),
        (
            "source/steps",
            4,
            1,
            "states.h5 row 4: replay of its start and actions does not end in qpos bit for bit",
        ),
    ],
)
def test_an_altered_value_is_found_without_the_checksums(
    copy: Path, name: str, row: Any, value: Any, fault: str
) -> None:
    altered(copy, name, row, value)
    found = list(state_faults(read_states(copy / "states.h5")))
    assert any(one.startswith(fault) for one in found), found
    assert all(f"row {row if isinstance(row, int) else row[0]}" in one for one in found), found


def test_the_least_change_of_one_qpos_is_found(copy: Path) -> None:
    with opened(copy / "states.h5") as file:
        file["qpos"][0, 10] = np.nextafter(file["qpos"][0, 10], 1)
    assert any("row 0: replay" in one for one in state_faults(read_states(copy / "states.h5")))


def test_a_swapped_split_is_found(copy: Path) -> None:
    with opened(copy / "states.h5") as file:
        splits = file["split"].asstr()[()].tolist()
        one, other = splits.index("train", 4), splits.index("test", 4)
        file["split"][one], file["split"][other] = "test", "train"
    assert faults(copy) == sorted(
        [
            f"states.h5 row {one}: split is test, the manifest says train",
            f"states.h5 row {other}: split is train, the manifest says test",
        ]
    )


def test_a_state_in_both_splits_is_a_leak(copy: Path) -> None:
    with opened(copy / "states.h5") as file:
        splits = file["split"].asstr()[()].tolist()
        one, other = splits.index("train", 4), splits.index("test", 4)
        for name in (
            "qpos",
            "points",
            "image",
            "gauss_code",
            "gauss_code_chiral",
            *(f"source/{key}" for key in file["source"]),
        ):
            file[name][other] = file[name][one]
    found = list(state_faults(read_states(copy / "states.h5")))
    assert f"states.h5 rows {one} (train) and {other} (test) are near-duplicates" in found
    assert f"states.h5 rows {one} (train) and {other} (test) come from one trajectory" in found


def test_a_code_in_both_splits_is_a_fault_where_they_should_share_none(copy: Path) -> None:
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["config"]["split_by"] = "code"
    (copy / "manifest.json").write_text(json.dumps(manifest))
    assert "code 1+,1- is in both splits, which share no code" in list(folder_faults(copy))


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_truncated_states_are_named(copy: Path, share: float) -> None:
    raw = (copy / "states.h5").read_bytes()
    (copy / "states.h5").write_bytes(raw[: int(share * len(raw))])
    checksum, unreadable = folder_faults(copy)
    assert (
        checksum == "states.h5 is not the file the manifest lists (SHA-256 differs)"
        and "states.h5 isn't a whole state file" in unreadable
    )


def test_a_truncated_trajectory_file_is_named(copy: Path) -> None:
    (copy / WAYS).write_bytes((copy / WAYS).read_bytes()[:-5000])
    found = faults(copy)
    assert found and all(WAYS in one for one in found)


@pytest.mark.parametrize("name", ["actions", "rewards", "infos/force"])
def test_an_edited_trajectory_is_named_with_its_episode(copy: Path, name: str) -> None:
    with opened(copy / WAYS) as file:
        data = file["episode_2"][name]
        data[(1,) * data.ndim] = 0.0625
    found = faults(copy)
    assert found and all(f"{WAYS}, episode 2" in one for one in found)


def test_edited_pixels_of_a_trajectory_are_named_with_their_episode(copy: Path) -> None:
    with opened(copy / WAYS) as file:
        file["episode_1/observations/pixels"][0, 3, 3] = (9, 9, 9)
    assert [one.split(": ", 1)[0].endswith("episode 1") for one in faults(copy)] == [True]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"files": 3, "config": {}}'])
def test_a_manifest_that_cannot_be_read_is_a_fault(copy: Path, text: str) -> None:
    (copy / "manifest.json").write_text(text)
    shutil.rmtree(copy / "minari")  # they take longest, and nothing is known of them now
    (fault,) = folder_faults(copy)
    assert fault.startswith("manifest.json can't be read: ")


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
    altered(folder, "gauss_code", 5, "1+,1-,2+,2-")


def _cut_states(folder: Path) -> None:
    (folder / "states.h5").write_bytes((folder / "states.h5").read_bytes()[:5000])


@pytest.mark.parametrize(("harm", "named"), [(_flip_label, "row 5"), (_cut_states, "states.h5")])
def test_the_command_names_faults_and_exits_with_1(
    copy: Path, capfd: pytest.CaptureFixture[str], harm: Callable[[Path], None], named: str
) -> None:
    harm(copy)
    shutil.rmtree(copy / "minari")
    assert knotgym("dataset", "verify", copy, "--quiet") == 1
    lines = capfd.readouterr().out.splitlines()
    assert (
        lines
        and all(line.startswith("fault: ") for line in lines)
        and any(named in line for line in lines)
    )


def test_nothing_at_a_path_is_a_mistake(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert knotgym("dataset", "verify", tmp_path / "absent") == 2
    assert len(capfd.readouterr().err.splitlines()) == 1
