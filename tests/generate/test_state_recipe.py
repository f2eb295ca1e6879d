"""States from three sources: drawn, met by play, met by random walks; and their demonstrations."""

import contextlib
import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest_types import Patch

from knotgym.common import Failed, Stream, from_json
from knotgym.generate import drawing_source, generate_config, state_recipe
from knotgym.generate import faults as dataset_faults
from knotgym.generate.drawing_source import WantedCodes, drawn_rows
from knotgym.generate.generate_config import GenerateConfig, PlayConfig
from knotgym.generate.play_source import PhasedPulls, rows_of_ropes
from knotgym.generate.state_recipe import make_states
from knotgym.generate.state_rows import Selection, judge
from knotgym.quality import Limits
from knotgym.rope import Rope
from knotgym.runs import Result, RunOptions, compute
from knotgym.states import SOURCES, States, pairs_within, read_states
from knotgym.topology import GaussCode

ALONE = RunOptions(workers=1, quiet=True)
DRAWN = GenerateConfig(nx=(0, 1), every_code=1, demonstrations=False, engine="chain")
LIVES = PlayConfig(settle=20, opening=30, rounds=1, scripted=6, spreading=4, ropes=8)
PLAYED = replace(DRAWN, every_code=0, count=4, source="play", play=LIVES)
WALK = PlayConfig(settle=0, random=40, opening=0, rounds=0, first=16, every=4, ropes=8)
WALKED = replace(PLAYED, nx=(1,), count=2, source="random-walk", walk=WALK)


def folder_of(config: GenerateConfig, factory: pytest.TempPathFactory) -> Path:
    return make_states(config, factory.mktemp(config.source) / "out", ALONE)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a state of each of the three codes up to nx 1, demonstrated; only read."""
    return folder_of(replace(DRAWN, demonstrations=True), tmp_path_factory)


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with four loops and four states of nx 1, met by play; only read."""
    return folder_of(PLAYED, tmp_path_factory)


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two states of random walks; only read."""
    return folder_of(WALKED, tmp_path_factory)


def shaken_rows(config: GenerateConfig, report: dict[str, Any], apart_from: Any) -> Any:
    """Make the rows of a source of a stranger's: drawn ones, under another name."""
    rows = yield from drawn_rows(config, report, apart_from=apart_from)
    return rows.replaced(**{"source/policy": np.full(rows.rows, "shaken")})


def test_a_source_is_a_record(monkeypatch: Patch, tmp_path: Path) -> None:
    shaken = SOURCES["drawing"]._replace(
        doc="drawn and shaken.",
        rows=shaken_rows,
        splits=lambda config, rows: np.full(rows.rows, "train"),
        engine="chain",
    )
    monkeypatch.setitem(SOURCES, "shaken", shaken)
    config = GenerateConfig(nx=(1,), count=2, source="shaken", demonstrations=False)
    assert config.engine_used == "chain"
    folder = make_states(config, tmp_path / "out", ALONE)
    states = states_in(folder)
    assert states.engine == "chain" and set(states.split.tolist()) == {"train"}
    assert "- `shaken`: drawn and shaken.\n" in (folder / "README.md").read_text()
    assert list(dataset_faults(folder)) == []
    # seeds of another stream, and rows of a source that nobody knows, are faults
    monkeypatch.setitem(SOURCES, "shaken", shaken._replace(stream=Stream.IMPORT))
    assert "is not a key of the stream IMPORT" in next(dataset_faults(folder))
    monkeypatch.delitem(SOURCES, "shaken")
    fault = next(dataset_faults(folder))
    assert "source must be one of drawing, play, random-walk, import" in fault


def same(one: Result, other: Result) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[k], other[k]) for k in one)


def states_in(folder: Path) -> States:
    return read_states(folder / "states.h5", images=False)


def test_many_states_of_few_codes_are_taken_by_play_and_the_others_drawn() -> None:
    (main,) = GenerateConfig(nx=(3,), count=40).parts
    assert (main.source, main.engine) == ("drawing", "mujoco")
    many = GenerateConfig(nx=(4, 1, 0), count=50).parts
    assert [(one.source, one.nx) for one in many] == [("play", (1, 0)), ("drawing", (4,))]
    assert {one.engine for one in many} == {"chain"}  # a file of states has one engine


def test_states_of_two_sources_are_in_order_and_apart(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(generate_config, "_DRAWN", 1)
    config = replace(PLAYED, nx=(2, 0), count=2, source="auto", engine="auto")
    folder = make_states(config, tmp_path / "both", ALONE)
    states = states_in(folder)
    assert states.nx.tolist() == [2, 2, 0, 0]
    assert states.source["policy"].tolist() == ["drawing"] * 2 + ["play"] * 2
    assert list(dataset_faults(folder)) == []
    assert pairs_within(states.points[:2], states.points[2:]) == []
    card = (folder / "README.md").read_text()
    assert re.search("set: (drawing and play|play and drawing);", card)
    assert "ropes were tried" in card


@pytest.mark.parametrize("source", ["drawn", "played", "walked"])
def test_every_row_is_recomputed_and_replayed(source: str, request: pytest.FixtureRequest) -> None:
    assert list(dataset_faults(request.getfixturevalue(source))) == []


@pytest.mark.parametrize(
    ("source", "limits"), [("played", [Limits(), Limits.UNTWISTED]), ("walked", [Limits.UNTWISTED])]
)
def test_the_splits_share_no_rope_and_the_states_keep_their_limits(
    source: str, limits: list[Limits], request: pytest.FixtureRequest
) -> None:
    states = states_in(request.getfixturevalue(source))
    ropes = states.source["trajectory"]
    train, test = (set(ropes[states.split == split].tolist()) for split in ("train", "test"))
    assert train and test and not train & test
    found = Counter(zip(states.nx.tolist(), states.split.tolist(), strict=True))
    assert len(set(found.values())) == 1  # as many as asked for
    assert all(judge(points, limits).faults == [] for points in states.points)
    assert pairs_within(states.points) == []
    assert ("actions" in states.source) == (source == "played")


@pytest.mark.parametrize("config", [DRAWN, WALKED])
def test_shards_are_merged_to_the_rows_of_the_whole_run(config: GenerateConfig) -> None:
    source = drawn_rows if config is DRAWN else rows_of_ropes
    memory = dict[str, Result]()
    for number in (1, 2):
        with contextlib.suppress(Failed):  # results of the other are missing
            compute(
                source(config, {}),
                memory,
                shard=from_json(RunOptions, {"shard": f"{number}/2"}).shard,
            )
    assert len(memory)
    assert same(compute(source(config, {}), memory), compute(source(config, {})))


def test_a_code_without_demonstration_is_on_the_card(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr("knotgym.generate.state_recipe.HORIZON", 1)
    config = replace(DRAWN, nx=(1,), count=1, every_code=0, demonstration_attempts=1)
    folder = make_states(replace(config, demonstrations=True), tmp_path / "out", ALONE)
    code = str(states_in(folder).gauss_code[0])
    assert f"reached no goal of these codes: `{code}`" in (folder / "README.md").read_text()
    assert json.loads((folder / "manifest.json").read_text())["report"]["demonstrations"] == 0


def test_a_run_that_gives_up_goes_on_with_more_attempts(tmp_path: Path) -> None:
    few = replace(WALKED, attempts=4, walk=replace(WALK, ropes=1, random=17), twist=Limits())
    with pytest.raises(Failed, match="states are missing for nx 1 train, nx 1 test after"):
        make_states(few, tmp_path / "out", ALONE)
    more = replace(few, attempts=5)
    with pytest.raises(Failed, match="after 12 ropes"):
        make_states(more, tmp_path / "out", replace(ALONE, resume=True))


def test_several_calls_draw_the_last_codes_and_more_attempts_give_what_they_would_have_given(
    monkeypatch: Patch,
) -> None:
    config = replace(DRAWN, nx=(1,), every_code=0, count=3, attempts=30)
    ((stubborn, wanted),) = WantedCodes(config, 1)._lacking().most_common(1)
    made, real = list[tuple[int, int]](), drawing_source._drawn

    def picky(config: GenerateConfig, order: Any, number: int, *rest: Any) -> Any:
        made.append((order.which, number))
        refused = order.which == stubborn and number < 100
        return ["refused"] if refused else real(config, order, number, *rest)

    memory = dict[str, Result]()
    monkeypatch.setattr(drawing_source, "_drawn", picky)
    with pytest.raises(Failed, match="missing states: 1 with nx = 1"):
        compute(drawn_rows(config, {}), memory)
    # 60 drawings for two missing states, in several calls
    tries = [key for key in memory if key.startswith(f"drawing 1:{stubborn}:")]
    assert wanted == 2 and len(tries) > 3
    more = compute(drawn_rows(replace(config, attempts=60), {}), memory)
    assert len(made) == len({*made})
    assert same(more, compute(drawn_rows(replace(config, attempts=60), {})))


def test_starts_of_demonstrations_are_apart_from_the_set_and_by_split(drawn: Path) -> None:
    states = read_states(drawn / "states.h5")
    train = states.replaced({"split": np.full(len(states), "train")})
    starts, split = compute(state_recipe._start_rows(DRAWN, train))
    assert set(split.tolist()) == {"train", "test"}
    assert pairs_within(starts["points"], train.points) == []
    sides = [starts["points"][split == name] for name in ("train", "test")]
    assert pairs_within(*sides) == []


def test_the_filter_names_what_is_wrong(rope: Rope, monkeypatch: Patch) -> None:
    coiled, loop = PhasedPulls.coil(rope), rope.loop()
    assert judge(loop, [Limits(), Limits.UNTWISTED]).faults == []
    assert "crossing_angle" in judge(coiled, [Limits()]).faults
    assert judge(loop, [Limits(total_curvature=0.9)]).faults == ["total_curvature"]
    assert judge(loop, [], code=GaussCode.parse("1+a,1-a")).faults == ["code lost at rest"]
    other = GaussCode.parse("1+a,1-a")
    monkeypatch.setattr("knotgym.generate.state_rows.pyknotid_code", lambda _: other)
    assert judge(loop, []).faults == ["labellers disagree"]


def test_a_selection_refuses_near_duplicates_up_to_symmetry(played: Path) -> None:
    states = states_in(played)
    rows = states.table.take(states.nx == 1)
    mirrored = rows.replaced(points=rows["points"] * (1, 1, -1))
    selection = Selection()
    assert selection.offer(rows, 0)
    assert not selection.offer(mirrored, 0)
    assert selection.rejected[1] == {"near-duplicate": 1} and len(selection.rows()["nx"]) == 1
