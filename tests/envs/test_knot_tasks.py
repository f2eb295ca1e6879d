"""Tasks connect states of one knot type; errors list what the file has."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common import InvalidInput
from knotgym.envs.environment import KnotEnv
from knotgym.states import States, merge_states, read_states, shipped, write_states
from knotgym.topology import GaussCode


@pytest.fixture
def path(trefoils: States, tmp_path: Path) -> str:
    write_states(tmp_path / "trefoils.h5", trefoils)
    return str(tmp_path / "trefoils.h5")


def made(task: str, path: str, **settings: Any) -> KnotEnv:
    return KnotEnv(task, states=path, observation="symbolic", **settings)


@pytest.mark.parametrize("task", ["tie", "convert"])
def test_a_knot_starts_at_its_least_diagram(path: str, trefoils: States, task: str) -> None:
    env = made(task, path, nx=4)
    for seed in range(4):
        info = env.reset(seed=seed)[1]
        assert (info["crossings"], GaussCode.parse(info["goal_gauss_code"]).nx) == (3, 4)
        assert trefoils.nx[info["start"]] == 3


@pytest.mark.parametrize("split", ["train", "test"])
def test_a_tie_to_the_least_diagram_starts_with_another_code(path: str, split: str) -> None:
    env = made("tie", path, nx=3, split=split)
    told = [env.reset(seed=seed)[1] for seed in range(12)]
    assert all(info["gauss_code"] != info["goal_gauss_code"] for info in told)
    assert len({info["goal_gauss_code"] for info in told}) == 2


def test_a_tie_whose_only_goal_is_its_start_is_refused(path: str) -> None:
    with pytest.raises(InvalidInput, match="its only goal's code already"):
        made("tie", path, nx=3, max_goals=1)


@pytest.mark.parametrize(("task", "nx"), [("unknot", 3), ("unknot", 4), ("convert", 3)])
def test_what_no_pull_reaches_is_refused_with_what_is_there(path: str, task: str, nx: int) -> None:
    with pytest.raises(InvalidInput, match=r"nx 3 \(train, test\), 4 .* of 3_1"):
        made(task, path, nx=nx)


def test_a_file_of_two_knots_is_refused(trefoils: States, tmp_path: Path) -> None:
    loops = read_states(shipped())
    loops = loops.take(np.flatnonzero(loops.nx == 3))
    bare = States(loops.table.only(*trefoils.table), loops.attributes)
    both = merge_states([trefoils, bare])
    write_states(tmp_path / "both.h5", both)
    with pytest.raises(InvalidInput, match="as 0_1, 3_1 and end as 0_1.* of 0_1, 3_1"):
        made("unknot", str(tmp_path / "both.h5"), nx=3)


@pytest.mark.parametrize("task", ["unknot", "tie", "convert"])
def test_tasks_draw_from_the_splits_by_code(task: str) -> None:
    states = read_states(shipped(), images=False)
    env = KnotEnv(task, nx=3, split="test-code", observation="symbolic")
    side = "start" if task == "unknot" else "goal"
    assert np.array_equal(env.episodes.rows[side], states.rows(3, "test-code"))


def test_a_split_by_code_without_codes_to_hold_out_is_refused(path: str, trefoils: States) -> None:
    with pytest.raises(InvalidInput, match="too few diagrams"):
        made("tie", path, nx=3, split="test-code")
