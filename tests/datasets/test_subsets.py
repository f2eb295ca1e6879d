"""Tests of select, split, delete and merge: table operations on states and episodes alike."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_types import Patch
from synthetic_episodes import TASK, TINY, episodes, written

from knotgym.common import InvalidInput, MissingFile
from knotgym.datasets import delete, open_episodes, select, split
from knotgym.datasets.merging import merge
from knotgym.datasets.minari_form import MinariMetadata, publish
from knotgym.datasets.subsets import _matching_rows, _write_rows, kept
from knotgym.states import States, read_states, shipped, write_states

COLUMNS = {
    "row": np.arange(4),
    "nx": np.array([3, 4, 0, 3]),
    "policy": np.array(["expert", "play", "random", "play"]),
    "quality.clearance": np.array([1.0, 2.0, np.nan, 9.0]),
    "success": np.array([True, False, True, True]),
}


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("nx = 3 and success", [0, 3]),
        ("nx == 3 and not success", []),
        ("clearance > 1.5", [1, 3]),
        ("policy in ('play', 'expert') and row % 2 = 1", [1, 3]),
        ("policy like 'p%'", [1, 3]),
        ("10 / clearance > 6", [0]),
        ("policy = 'select'", []),
    ],
)
def test_a_condition_keeps_the_rows_that_fulfil_it(text: str, rows: list[int]) -> None:
    assert np.flatnonzero(_matching_rows(text, COLUMNS)).tolist() == rows


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("length < 30", "columns are row, nx, policy"),
        ("(SELECT count(*) FROM read_csv('/etc/passwd')) > 0", "not a query"),
        ("nx", "true or false"),
        ("1 < nx < 4", "join conditions by and"),
        ("nx = 'a'", "cannot compare"),
        ("nx = 3; drop table x", "invalid expression"),
        ("\x1b[2J", "unable to parse"),
        ("nx = 3 or " * 500 + "nx = 3", "up to 2000 characters"),
    ],
)
def test_any_other_text_is_refused_in_one_line(text: str, says: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        _matching_rows(text, COLUMNS)
    assert says in str(caught.value) and str(caught.value).isprintable()


def test_selected_episodes_are_the_source_s_and_tell_of_every_selection(tmp_path: Path) -> None:
    made = written(tmp_path / "a.h5", episodes([3, 1, 4, 2]))
    out = select(made, where="length > 2 and truncated", out=tmp_path / "b.h5")
    found = open_episodes(out)
    assert found.episodes.differences(open_episodes(made).episodes.select([0, 2])) == []
    (how,) = found.attributes["selection"]
    assert (how["rows"], how["kept"], how["where"]) == (4, 2, "length > 2 and truncated")
    assert kept(out) == "2 of 4 rows"
    again = select(out, where="episode <> 0", out=tmp_path / "c.h5")
    assert [one["kept"] for one in open_episodes(again).attributes["selection"]] == [2, 1]
    with pytest.raises(InvalidInput, match="none of the 2 rows"):
        select(out, where="length > 7", out=tmp_path / "d.h5")
    assert not (tmp_path / "d.h5").exists()


def test_a_sample_is_drawn_from_the_seed(tmp_path: Path) -> None:
    made = written(tmp_path / "a.h5", episodes([1] * 20))
    lengths = []
    for name, seed in (("b", 0), ("c", 0), ("d", 1)):
        out = select(made, sample=5, seed=seed, out=tmp_path / f"{name}.h5")
        lengths.append(open_episodes(out).episodes.episodes["seed"].tolist())
    assert lengths[0] == lengths[1] != lengths[2] and len(lengths[0]) == 5
    with pytest.raises(InvalidInput, match="can't sample 21"):
        select(made, sample=21, out=tmp_path / "e.h5")


@pytest.mark.parametrize("other, kept", [((-4.0, 5.0), True), ((-3.0, 5.0), False)])
def test_merged_sets_of_one_name_keep_all_digests_and_equal_scores(
    other: tuple[float, float], kept: bool, tmp_path: Path
) -> None:
    name, made = "knotgym/tie-nx2/x-v0", list[str]()
    for seed, scores in enumerate(((-4.0, 5.0), other)):
        about = MinariMetadata(
            dataset_id=name, algorithm_name="a", description="", digests={"s": seed},
            ref_min_score=scores[0], ref_max_score=scores[1],
        )  # fmt: skip
        made.append(str(publish([episodes([2], seed)], TASK, about, tmp_path / str(seed))))
    merge(made, tmp_path, "knotgym/both-v0")
    whole = open_episodes(tmp_path / "knotgym/both-v0").metadata or {}
    assert whole["description"].startswith(f"Merged of {name}, {name}")
    assert whole["algorithm_name"] == "random"
    assert whole["digests"] == {name: {"s": 0}, f"{name} (2)": {"s": 1}}
    assert whole["ref_min_score"] == (-4.0 if kept else None)


def test_a_selection_becomes_a_minari_dataset_that_says_how_it_was_made(tmp_path: Path) -> None:
    part = select(TINY["expert"], where="length < 10", out=tmp_path / "short.h5")
    merge([str(part)], tmp_path, "knotgym/tie-nx2/short-v0")
    found = open_episodes(tmp_path / "knotgym/tie-nx2/short-v0")
    assert found.episodes.episodes.rows == 1 and found.name == "knotgym/tie-nx2/short-v0"
    assert (found.path.parent / "main_data.hdf5").is_file()
    assert found.attributes["selection"][0]["where"] == "length < 10"


def test_rows_are_deleted_by_number(tmp_path: Path, states_path: str) -> None:
    states = read_states(states_path)
    left = read_states(delete(states_path, "0, 2-3", tmp_path / "b.h5"))
    np.testing.assert_array_equal(left.qpos, states.qpos[[1, *range(4, len(states))]])
    assert left.attributes["selection"][0]["deleted"] == "0, 2-3"
    for rows in ("", "a", "3-1", "0-99999999999", f"{len(states)}", "-1"):
        with pytest.raises(InvalidInput, match="are numbers such as 3,7-9 below"):
            delete(states_path, rows, tmp_path / "c.h5")


def test_split_episodes_share_no_goal(tmp_path: Path) -> None:
    made = episodes([1] * 40)
    goals = np.arange(40) // 4
    made = made._replace(episodes=made.episodes.replaced(goal=goals, start=np.arange(40) % 3))
    path = written(tmp_path / "a.h5", made)
    parts = split(path, "train=0.7,val=0.3", out=tmp_path / "b.h5")
    assert [one.name for one in parts] == ["b-train.h5", "b-val.h5"]
    rows = [open_episodes(one).episodes.episodes for one in parts]
    shown = [
        {int(k) for k, code in zip(one["goal"], one["goal_visits"], strict=True) if code.any()}
        for one in rows
    ]
    assert not shown[0] & shown[1]
    assert rows[0].rows + rows[1].rows == 40 and rows[0].rows > rows[1].rows
    # plain loops, in which all of them begin, are in both
    first, own = ({*one["goal"].tolist()} for one in rows)
    said = f"3 of its 3 starts, {len(first & own)} of its {len(own)} goals stand in b-train.h5"
    assert f"{said}, too; only states without crossings may" in kept(parts[1], parts[0])
    for wrong in ("a=1", "a=0.5,b=0.6", "a=x,b=1", "a=0.5,a=0.5", "a=0.5,A=0.5", ""):
        with pytest.raises(InvalidInput):
            split(path, wrong, out=tmp_path / "c.h5")


def test_parts_are_replaced_together_or_not_at_all(tmp_path: Path, monkeypatch: Patch) -> None:
    path, root, calls = written(tmp_path / "a.h5", episodes([1] * 8)), tmp_path / "made", [0, 1]

    def second_fails(*words: Any) -> Path:
        if calls.pop():
            return _write_rows(*words)
        raise KeyboardInterrupt

    def cut(seed: int) -> None:
        split(path, "train=0.5,val=0.5", root / "b.h5", seed=seed, overwrite=True)

    cut(0)
    before = {file: file.read_bytes() for file in root.rglob("*.h5")}
    monkeypatch.setattr("knotgym.datasets.subsets._write_rows", second_fails)
    with pytest.raises(KeyboardInterrupt):
        cut(1)
    assert {file: file.read_bytes() for file in root.rglob("*.h5")} == before and len(before) == 2


def test_states_are_selected_by_the_same_function(states_path: str, tmp_path: Path) -> None:
    states = read_states(states_path)
    where = "nx >= 1 and row not in (6, 8) and split = 'train'"
    rows = np.flatnonzero((states.nx >= 1) & (states.split == "train"))[2:]
    found = read_states(select(states_path, where=where, out=tmp_path / "a.h5"))
    np.testing.assert_array_equal(found.qpos, states.qpos[rows])


def test_states_without_demonstrations_are_split(tmp_path: Path) -> None:
    states = read_states(shipped("hard-unknots"))
    bare = states.replaced({"source/trajectory": np.full(len(states), -1)})
    write_states(tmp_path / "s.h5", bare)
    parts = split(tmp_path / "s.h5", "a=0.5,b=0.5", out=tmp_path / "p.h5")
    assert [len(read_states(one)) for one in parts] == [4, 4]


def test_what_does_not_belong_together_is_not_merged(states_path: str, tmp_path: Path) -> None:
    one = str(written(tmp_path / "a.h5", episodes([2])))
    two = str(written(tmp_path / "b.h5", episodes([2], seed=1), replace(TASK, horizon=3)))
    three = str(written(tmp_path / "c.h5", episodes([2], seed=1).recording()))
    for given, says in (
        ([one, one], "are the same"),
        ([one, two], "one horizon"),
        ([one, three], "one form"),
        ([one, states_path], "all of states or all of episodes"),
    ):
        with pytest.raises(InvalidInput, match=says):
            merge(given, tmp_path / "m.h5")
    known = read_states(states_path).take([12])
    copies = States.from_points(known.points[:, ::-1] + [0.1, 0, 0], "test")  # from another base
    for name, own in (("k", known.replaced({"split": np.array(["train"])})), ("l", copies)):
        write_states(tmp_path / f"{name}.h5", own)
    with pytest.raises(InvalidInput, match="near-duplicates: 0.0 mm"):
        merge([str(tmp_path / "k.h5"), str(tmp_path / "l.h5")], tmp_path / "m.h5")
    with pytest.raises(MissingFile):
        merge([one, "nothing"], tmp_path / "m.h5")
    assert not (tmp_path / "m.h5").exists()
