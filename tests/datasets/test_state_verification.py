"""Verification computes every row again, and names the file, the row and what is wrong."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common import sha256
from knotgym.control import replay
from knotgym.datasets.row_verification import _folder_faults, _state_faults
from knotgym.states import States, read_states, shipped, write_states

ENDS_ELSEWHERE = "replay of its start and actions does not end in qpos bit for bit"


@pytest.fixture(scope="module")
def pair() -> States:
    """A loop and a state with a crossing."""
    return read_states(shipped()).take([0, 20])


def altered(states: States, name: str, at: Any, value: Any) -> States:
    """Return states with one value changed, and without a digest that would tell."""
    values = states.table[name].copy()
    if values.dtype.kind == "U":
        values = values.astype(object)
    values[at] = value
    return states.replaced({name: values.astype("U") if values.dtype == object else values})


def test_an_older_file_lacks_a_new_measure(pair: States) -> None:
    names = {*pair.table} - {"quality/margin"}
    assert [*_state_faults(States(pair.table.only(*names), pair.attributes))] == []


@pytest.mark.parametrize(
    ("name", "at", "value", "fault"),
    [
        ("gauss_code", 1, "1-,1+,2+,2-", "gauss_code is 1-,1+,2+,2-, recomputed"),
        ("pd_code", 1, "[]", "pd_code is [], recomputed [["),
        ("nx", 0, 2, "nx is 2, recomputed 0"),
        ("knot", 0, "3_1", "knot is 3_1, recomputed 0_1"),
        ("image", (0, 64, 64, 1), 77, "image is not the picture of points"),
        ("points", (1, 50, 2), 0.25, "points are not those of qpos"),
        ("qpos", (0, 10), None, ENDS_ELSEWHERE),
        ("split", 1, "dev", "split is 'dev'"),
        ("quality/clearance", 1, np.nan, "quality/clearance is nan, recomputed"),
        ("quality/writhe", 1, 1 + 1e-7, "quality/writhe is 1.0000001, recomputed"),
        ("quality/noise_survival", 1, 0.5, "quality/noise_survival is 0.5, recomputed"),
        ("source/actions", (1, 0, 3), 0.123, ENDS_ELSEWHERE),
        ("source/actions", (1, 0, 3), 1.5, "an action lies outside [-1, 1]"),
        ("source/drawing", 1, "{}", "its drawing can't be reproduced: seed "),
        ("source/policy", 1, "random-walk", "seed (6"),
    ],
)
def test_a_changed_value_is_found(pair: States, name: str, at: Any, value: Any, fault: str) -> None:
    row = at if isinstance(at, int) else at[0]
    if value is None:  # the smallest change
        value = np.nextafter(pair.table[name][at], 1)
    found = list(_state_faults(altered(pair, name, at, value)))
    start = f"states.h5 row {row}: "
    assert any(line.startswith(start + fault) for line in found), found
    assert all(line.startswith(start) for line in found), found


def test_measures_may_differ_by_rounding(pair: States) -> None:
    angle = pair.quality["crossing_angle"][1]
    changed = altered(pair, "quality/crossing_angle", 1, angle * (1 + 1e-13))
    assert list(_state_faults(changed)) == []


@pytest.mark.parametrize(
    ("name", "row", "set_", "fault"),
    [
        ("hard-unknots", 0, 43, "is not a key of the stream DRAWING"),
        ("hard-unknots", 0, 40, "its start differs from the drawing of its seed by"),
        ("random-walk", 27, 7, "is not a key of the stream RANDOM_WALK"),
        ("random-walk", 27, 30, ENDS_ELSEWHERE),  # one of the shortest walks
    ],
)
def test_another_seed_of_drawing_or_walk_shows(name: str, row: int, set_: int, fault: str) -> None:
    states = read_states(shipped(name), images=False).take([row])
    changed = altered(altered(states, "source/seed", (0, 0), set_), "source/seed", (0, 4), 9)
    assert any(fault in line for line in _state_faults(changed))


def test_a_wrong_checksum_is_found(pair: States, tmp_path: Path) -> None:
    write_states(tmp_path / "states.h5", pair)
    read = read_states(tmp_path / "states.h5")
    assert list(_state_faults(read)) == []
    harmed = States(altered(read, "source/trajectory", 1, 99).table, read.attributes, read.digest)
    assert list(_state_faults(harmed)) == ["states.h5: its columns don't match content_sha256"]


def test_a_missing_origin_is_named(pair: States) -> None:
    names = [name for name in pair.table if name not in ("source/actions", "source/seed")]
    few = States(pair.table.only(*names), pair.attributes)
    assert list(_state_faults(few)) == [
        "states.h5: source/actions is missing",
        "states.h5: source/seed is missing",
    ]


def test_states_of_another_rope_are_not_judged(pair: States) -> None:
    (fault,) = _state_faults(pair.replaced({}, rope="feedfeedfeedfeed"))
    assert fault.startswith("rope model feedfeedfeedfeed is not this version's")


def test_a_state_in_both_splits_is_a_leak(pair: States) -> None:
    twice = pair.take([1, 1]).replaced({"split": np.array(["train", "test"])})
    assert list(_state_faults(twice)) == [
        "states.h5 rows 0 (train) and 1 (test) are near-duplicates: 0.0 mm apart at the best"
        " symmetry",
        "states.h5 rows 0 (train) and 1 (test) come from one rope",
        "states.h5 rows 0 and 1 are the same configuration",
    ]


@pytest.fixture
def light(curated: Path, tmp_path: Path) -> Path:
    """A folder with a state with a crossing of each split, without demonstrations."""
    folder = tmp_path / "light"
    shutil.copytree(curated, folder, ignore=shutil.ignore_patterns("minari"))
    states = read_states(folder / "states.h5")
    rows = np.array([states.rows(1, split)[0] for split in ("train", "test")])
    write_states(folder / "states.h5", states.take(rows))
    listed(folder)
    return folder


def listed(folder: Path, **changes: Any) -> None:
    """Change entries of the manifest, and make its checksums agree, as a forger would."""
    manifest = json.loads((folder / "manifest.json").read_text()) | changes
    manifest["files"] = {
        name: sha256(folder / name) for name in manifest["files"] if (folder / name).is_file()
    }
    (folder / "manifest.json").write_text(json.dumps(manifest))


def test_a_changed_file_and_a_missing_one_are_named(light: Path) -> None:
    assert list(_folder_faults(light, replay)) == []
    (light / "README.md").write_text("other")
    (light / "states.h5").unlink()
    assert sorted(_folder_faults(light, replay)) == [
        "README.md is not the file the manifest lists (SHA-256 differs)",
        f"no knotgym-states file at {light / 'states.h5'}",
        "states.h5 is missing",
    ]
    (light / "manifest.json").write_text("[]")
    assert next(_folder_faults(light, replay)).startswith("manifest.json can't be read: ")


def test_states_without_a_source_are_checked_in_all_else(pair: States) -> None:
    """Curves of one's own have none; a fault of theirs isn't hidden behind that."""
    own = States.from_points(pair.points)
    assert [*_state_faults(own)] == []
    mirrored = own.points * [-1, 1, 1]
    copies = States.from_points(np.concatenate([own.points, own.points[1:]]))
    for wrong, said in (
        (altered(own, "gauss_code", 1, "1-,1+,2+,2-"), "row 1: gauss_code is"),
        (altered(own, "nx", 0, 2), "row 0: nx is 2, recomputed 0"),
        (own.replaced({"points": mirrored}), "row 1: points are not those of qpos"),
        (altered(copies, "split", 2, "test"), "are near-duplicates"),
    ):
        assert any(said in one for one in _state_faults(wrong)), said
