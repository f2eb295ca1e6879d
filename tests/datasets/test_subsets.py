"""Selected, split and shortened datasets, counted against independent passes over the rows."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.common.errors import InvalidInput
from knotgym.datasets import delete, read_rows, select, split, verify
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.image_rows import Row, record
from knotgym.datasets.image_table import write_rows
from knotgym.datasets.row_expressions import matching_rows
from knotgym.rendering.appearance_config import AppearanceConfig
from knotgym.states.near_duplicates import families
from knotgym.states.state_file import read_states, shipped
from knotgym.topology.gauss import GaussCode

from ..small_job import knotgym
from .test_image_table import SOURCE, UNMOVED

COLUMNS = {
    "nx": np.array([0, 1, 2, 3]),
    "length": np.array([5.0, 50.0, 10.0, 30.0]),
    "success": np.array([True, False, True, False]),
    "knot": np.array(["0_1", "3_1", "3_1#4_1", "4_1"]),
    "quality.clearance": np.array([7.0, 8.0, 9.0, 10.0]),
    "source.seed": np.array([1, 2, 3, 4]),
    "appearance.seed": np.array([4, 3, 2, 1]),
}
_NUMBERS = st.sampled_from(["nx", "length"]) | st.integers(-3, 60).map(str)
_SUMS = st.recursive(
    _NUMBERS,
    lambda one: st.tuples(one, st.sampled_from("+-*"), one).map("".join).map("({})".format),
)
_COMPARED = st.one_of(
    st.tuples(_SUMS, st.sampled_from(["==", "!=", "<", "<=", ">", ">="]), _SUMS).map(" ".join),
    st.sampled_from(["success", "knot == '3_1'", "'4_1' in knot", "nx in (1, 3)", "nx not in [0]"]),
)
_CONDITIONS = st.recursive(
    _COMPARED,
    lambda one: (
        one.map("not ({})".format)
        | st.tuples(one, st.sampled_from([" and ", " or "]), one).map("".join).map("({})".format)
    ),
    max_leaves=5,
)


@given(_CONDITIONS)
def test_a_condition_means_what_python_would_make_of_it_row_by_row(text: str) -> None:
    slow = [
        bool(eval(text, {}, {name: COLUMNS[name][row].item() for name in COLUMNS}))
        for row in range(4)
    ]
    assert matching_rows(text, COLUMNS).tolist() == slow


@given(st.text(max_size=40))
def test_any_other_text_is_refused_in_one_line(text: str) -> None:
    try:
        matching_rows(text, COLUMNS)
    except InvalidInput as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("colour == 1", "no column 'colour'; columns are nx, length, success"),
        ("nx == 'a'", "a number and .* is a text"),
        ("nx", "not a condition"),
        ("not nx", "should be a condition"),
        ("knot + 1 == 2", "should be a number"),
        ("seed == 1", "may be source.seed or appearance.seed"),
        ("__import__('os').system('touch x')", "not part of the grammar"),
        ("nx.__class__ == 1", "no column"),
        ("(lambda: 1)()", "not part of the grammar"),
        ("[nx for nx in (1,)]", "not part of the grammar"),
        ("nx ** 9 ** 9 > 1", "not part of the grammar"),
        ("nx := 3", "can't be read"),
        ("nx == 3; import os", "can't be read"),
        ("(" * 1500, "can't be read"),
        ("-" * 1900 + "nx == 1", "can't be"),
        ("nx == " + "9" * 1000, "too large"),
        ("nx == 1 " * 500, "at most 2000"),
    ],
)
def test_a_bad_expression_is_refused_in_one_line_and_nothing_is_written(
    tmp_path: Path, text: str, problem: str
) -> None:
    with pytest.raises(InvalidInput, match=problem) as caught:
        matching_rows(text, COLUMNS)
    assert "\n" not in str(caught.value)
    assert (
        knotgym("dataset", "select", shipped(), f"--where={text}", "--out", tmp_path / "x.h5") == 2
    )
    assert not list(tmp_path.iterdir())


def test_selected_states_are_those_that_a_loop_over_the_rows_finds(tmp_path: Path) -> None:
    states = read_states(shipped())
    made = select(
        "readable", where="nx >= 2 and clearance > 9.5", split="train", out=tmp_path / "a.h5"
    )
    rows = [
        row
        for row in range(len(states))
        if states.nx[row] >= 2
        and states.quality["clearance"][row] > 9.5
        and states.split[row] == "train"
    ]
    found = read_states(made)
    assert 0 < len(rows) < len(states)
    for name, values in states.taken(rows).table.items():
        assert np.array_equal(found.table[name], values), name
    (said,) = found.attributes["selection"]
    assert (said["where"], said["kept"]) == ("nx >= 2 and clearance > 9.5", len(rows))
    few = select(made, sample=2, seed=5, out=tmp_path / "b.h5")
    again = select(made, sample=2, seed=5, out=tmp_path / "c.h5")
    assert few.read_bytes() == again.read_bytes() and verify(few) == []


def test_split_states_leave_near_duplicates_together(tmp_path: Path) -> None:
    states = read_states(shipped(), images=False)
    parts = split("readable", "a=0.5,b=0.3,c=0.2", seed=2, out=tmp_path / "s.h5")
    points = [read_states(part, images=False).points for part in parts]
    assert [part.name for part in parts] == ["s-a.h5", "s-b.h5", "s-c.h5"]
    assert sum(map(len, points)) == len(states)
    assert abs(len(points[0]) - 0.5 * len(states)) < 3
    near = families(np.concatenate(points))
    of_part = np.repeat(np.arange(3), [len(one) for one in points])
    assert all(len(set(of_part[near == one])) == 1 for one in set(near.tolist()))


@pytest.mark.thorough
def test_a_folder_keeps_the_demonstrations_of_its_rows(curated: Path, tmp_path: Path) -> None:
    made = select(curated, where="nx == 1 or row == 2", out=tmp_path / "few")
    assert len(read_states(made / "states.h5")) == 5 and verify(made) == []
    assert "## Selection" in (made / "README.md").read_text()
    left = delete(made, [0, 3], out=tmp_path / "fewer")
    assert len(json.loads((left / "manifest.json").read_text())["selection"]) == 2
    assert len(read_states(left / "states.h5")) == 3 and verify(left) == []


@pytest.fixture(scope="module")
def episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("minari")
    given = ("collect", "--task", "unknot", "--nx", 2, "--policy", "random", "--episodes", 12)
    more = ("--set", "task.horizon=3", "--observation", "state", "--workers", 1, "--id", "x/all-v0")
    assert knotgym(*given, *more, "--out", root, "--quiet") == 0
    return root / "x" / "all-v0"


def test_selected_episodes_are_those_that_a_loop_finds(episodes: Path, tmp_path: Path) -> None:
    every = list(EpisodeReader(episodes))
    right = [one.digest() for one in every if one.options["start"] % 2 and len(one) > 2]
    made = select(
        episodes, where="start % 2 == 1 and length > 2", out=tmp_path, dataset_id="x/a-v0"
    )
    reader = EpisodeReader(made)
    assert [one.digest() for one in reader] == right and 0 < len(right) < 12
    assert "start % 2 == 1" in str((reader.metadata() or {})["description"])
    assert verify(made) == []
    left = delete(episodes, [0, 5], out=tmp_path / "left.h5")
    kept = [one.digest() for k, one in enumerate(every) if k not in (0, 5)]
    assert [one.digest() for one in EpisodeReader(left)] == kept
    with h5py.File(left) as file:
        assert json.loads(file.attrs["selection"])[0]["deleted"] == [0, 5]


def test_split_episodes_share_no_start_with_crossings(episodes: Path, tmp_path: Path) -> None:
    parts = split(episodes, {"a": 0.5, "b": 0.5}, out=tmp_path, dataset_id="x/all-v3")
    starts = [{one.options["start"] for one in EpisodeReader(part)} for part in parts]
    assert [part.name for part in parts] == ["all-a-v3", "all-b-v3"]
    assert starts[0] and starts[1] and not starts[0] & starts[1]
    assert sum(len(EpisodeReader(part)) for part in parts) == 12


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    """A file with one picture."""
    states = read_states(shipped(), images=False).taken(np.array([20]))
    code = GaussCode.parse(states.gauss_code_chiral[0])
    row = Row(states.points[0], code, "train", {**SOURCE, **UNMOVED})
    write_rows(tmp_path / "train.parquet", [record(row, AppearanceConfig())])
    return tmp_path / "train.parquet"


def test_pictures_of_one_file_are_selected(shard: Path, tmp_path: Path) -> None:
    (row,) = read_rows(shard)
    where = f"nx == {row['nx']} and grade == '{row['grade']}' and 'x' not in knot"
    made = select(shard, where=where, out=tmp_path / "a.parquet")
    assert list(read_rows(made)) == [row]
    with pytest.raises(InvalidInput, match="none of the 1 rows"):
        delete(shard, [row["source"]["row"]], out=tmp_path / "b.parquet")


@pytest.mark.slow
def test_selected_and_split_pictures_verify(tmp_path: Path) -> None:
    given = ("images", "--nx", "0-2", "--count", 18, "--workers", 1, "--out", tmp_path / "all")
    assert knotgym(*given, "--quiet") == 0
    rows = list(read_rows(tmp_path / "all"))
    made = select(tmp_path / "all", where="nx > 0 and zoom > 0", out=tmp_path / "few")
    assert [one["source"] for one in read_rows(made)] == [
        one["source"] for one in rows if one["nx"]
    ]
    assert verify(made) == []
    parts = split(tmp_path / "all", "a=0.5,b=0.5", out=tmp_path / "part")
    walks = [{one["source"]["walk"] for one in read_rows(part)} for part in parts]
    assert not walks[0] & walks[1] and all(verify(part) == [] for part in parts)


@pytest.mark.parametrize("parts", ["a=1", "a=0.5,b=0.4", "a=0.5,a=0.5", "x", "a=2,b=-1", "a=0.5;b"])
def test_parts_that_are_no_fractions_are_refused(tmp_path: Path, parts: str) -> None:
    with pytest.raises(InvalidInput, match="parts are"):
        split("readable", parts, out=tmp_path / "a.h5")


def test_an_output_that_is_there_is_kept(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_text("mine")
    given = ("dataset", "select", "readable", "--where", "nx == 0", "--out", tmp_path / "a.h5")
    assert knotgym(*given) == 2 and (tmp_path / "a.h5").read_text() == "mine"
    assert knotgym(*given, "--overwrite", "--quiet") == 0
    assert len(read_states(tmp_path / "a.h5")) == 17
