"""The state file gives back what was written, and refuses what it cannot read in one line."""

import hashlib
import os
import pickle
from collections import Counter
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from knotgym.common import InvalidFile, InvalidInput, Table
from knotgym.generate import judge
from knotgym.quality import Limits
from knotgym.states.schema import ATTRIBUTES, STATES
from knotgym.states.sources import SETS, shipped
from knotgym.states.state_file import DIGEST, States, merge_states, read_states, write_states
from knotgym.topology import GaussCode, Symmetry, canonical

from ..fresh_interpreter import python


def test_states_come_back_as_written(states: States, states_path: str) -> None:
    read = read_states(states_path)
    assert Table.digest(read.table) == Table.digest(states.table) == read.digest
    assert read.attributes == states.attributes
    assert not any(column.flags.writeable for column in read.table.values())


def test_states_are_pickled_whole(states: States) -> None:
    again = pickle.loads(pickle.dumps(states))
    assert Table.digest(again.table) == Table.digest(states.table)
    merged = merge_states([again.take(slice(0, 3)), states.take(slice(3, 30))])
    assert Table.digest(merged.table) == Table.digest(states.table)


def test_states_without_images_are_not_written(states_path: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="read without"):
        write_states(tmp_path / "a.h5", read_states(states_path, images=False))


def test_what_no_rope_has_is_not_written(states: States, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="column points holds nan"):
        write_states(tmp_path / "a.h5", states.replaced({"points": states.points * np.nan}))


def test_rows_are_those_of_nx_and_split(states: States) -> None:
    for nx in range(5):
        for split in ("train", "test"):
            rows = states.rows(nx, split)
            assert len(rows) == 3
            assert set(states.nx[rows]) == {nx} and set(states.split[rows]) == {split}
    assert len(states.rows(9, "train")) == 0
    with pytest.raises(InvalidInput, match="split must be one of train, test, train-code"):
        states.rows(2, "dev")


def test_codes_and_origin_are_completed(states: States) -> None:
    bare = {name: states.table[name] for name in states.table if "code" not in name}
    bare |= {"source/steps": states.nx, "gauss_code": states.gauss_code}
    full = States.of({**bare, "gauss_code_chiral": states.gauss_code_chiral})
    assert np.array_equal(full.pd_code, states.pd_code)
    assert set(full.source["dataset"]) == {""} and set(full.source["trajectory"]) == {-1}


def test_merged_states_are_sorted_by_nx_and_keep_all_configurations(states: States) -> None:
    merged = merge_states([states.take(slice(24, 30)), states.take(slice(0, 24))], distinct=True)
    assert Table.digest(merged.table) == Table.digest(states.table)
    assert merged.attributes["config"] == [{"made": "by hand"}] * 2


def test_states_with_other_columns_or_the_same_rows_are_not_merged(states: States) -> None:
    with pytest.raises(InvalidFile, match="file 1 can't be merged with the others: column source/"):
        merge_states([states, read_states(shipped())])
    with pytest.raises(InvalidFile, match="must have one engine"):
        merge_states([states, states.replaced({}, engine="chain")])
    with pytest.raises(InvalidFile, match="30 states occur twice, first in rows 0 and 6"):
        merge_states([states, states], distinct=True)


@pytest.mark.parametrize("name", SETS)
def test_shipped_states_have_every_column_and_attribute(name: str) -> None:
    states = read_states(shipped(name), images=name != "bench")
    assert DIGEST not in states.attributes
    if name != "bench":  # it is stored by vertices
        drawn_again = {"source/actions"} if name == "random-walk" else set()
        assert {*states.table} == {c.name for c in STATES.columns} - drawn_again
        assert {*ATTRIBUTES} <= {*states.attributes}


def test_bench_has_as_many_states_of_each_kind_and_keeps_the_limits_of_readable() -> None:
    states = read_states(shipped("bench"), images=False)
    kinds = Counter(zip(states.nx.tolist(), states.split.tolist(), strict=True))
    assert kinds == {(nx, split): 256 for nx in range(6) for split in ("train", "test")}
    for row in range(0, len(states), 97):
        code = GaussCode.parse(str(states.gauss_code_chiral[row]))
        assert judge(states.points[row], [Limits()], code=code).faults == []


def test_vertices_are_laid_the_same_on_processors_with_other_instructions() -> None:
    script = (
        "from knotgym.states import read_states; import hashlib\n"
        "states = read_states('bench', images=False)\n"
        "print(hashlib.sha256(states.qpos.tobytes() + states.points.tobytes()).hexdigest())"
    )
    narrow = {"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"}  # AVX2 is left
    states = read_states("bench", images=False)
    here = hashlib.sha256(states.qpos.tobytes() + states.points.tobytes()).hexdigest()
    there = python("-c", script, env=os.environ | narrow, check=True).stdout
    assert there == f"{here}\n"


@pytest.mark.parametrize("name", SETS)
def test_splits_by_code_share_no_diagram_and_are_parts_of_the_splits(name: str) -> None:
    states = read_states(shipped(name), images=False)
    for nx in (0, 1, 2, 3, 4, 7):
        train, test = states.rows(nx, "train-code"), states.rows(nx, "test-code")
        assert {*train} <= {*states.rows(nx, "train")} and {*test} <= {*states.rows(nx, "test")}
        if nx < 2:  # loops and curls have no other diagram
            assert np.array_equal(test, states.rows(nx, "test"))
            continue
        diagrams = [
            {
                canonical(GaussCode.parse(code), Symmetry.DIAGRAM)
                for code in states.gauss_code[rows].tolist()
            }
            for rows in (train, test)
        ]
        assert not diagrams[0] & diagrams[1]
        if name != "hard-unknots" and nx < 7:
            assert len(train) >= 10 and len(test) >= 1


def test_states_of_closed_curves_whose_first_point_is_repeated_have_no_bead_more() -> None:
    points = read_states(shipped(), images=False).points[[0, 100]]
    made = States.from_points(np.concatenate([points, points[:, :1]], axis=1))
    again = States.from_points(points)
    assert all(np.array_equal(made.table[name], again.table[name]) for name in made.table)


def test_an_environment_resets_to_states_made_of_points_shown_by_another(tmp_path: Path) -> None:
    env = gym.make("knotgym/Tie-v0", nx=1, observation="state", engine="chain")
    loop, curl = env.reset(seed=0)[0].reshape(2, 100, 3)
    made = States.from_points([loop, curl, loop, curl], ["train", "train", "test", "test"])
    assert made.nx.tolist() == [0, 1, 0, 1] and {*made.knot} == {"0_1"}
    write_states(tmp_path / "own.h5", made)
    own = gym.make("knotgym/Tie-v0", nx=1, states=str(tmp_path / "own.h5"), engine="chain")
    assert own.reset(seed=0)[1]["goal_gauss_code"] == made.gauss_code[1]
