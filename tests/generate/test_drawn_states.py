"""States drawn from codes: made, judged, checked, resumed and merged like the others."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from knotgym.common.configuration import as_json
from knotgym.common.errors import KnotgymError
from knotgym.datasets.state_verification import folder_faults, state_faults
from knotgym.generate.states.drawn_states import DrawnStatesConfig, DrawnUnit, draw_states
from knotgym.generate.states.drawn_states_recipe import DrawnStatesRecipe
from knotgym.runs.shards import Shard
from knotgym.states.state_file import merge_states, read_states, shipped
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import knot_type, shows

from ..small_job import knotgym

WANTED = ("--source", "drawing", "--nx", "0-1", "--every-code", 1, "--workers", 1, "--quiet")


@pytest.fixture(scope="module")
def drawn_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a state of each of the three codes to nx 1; only ever read."""
    folder = tmp_path_factory.mktemp("drawn") / "nx0-1"
    settings = folder.parent / "settings.json"  # the last to be named counts
    settings.write_text("{}")
    assert knotgym("generate", *WANTED, "--settings", settings, "--out", folder) == 0
    return folder


def test_every_code_is_drawn_and_the_folder_has_no_fault(drawn_folder: Path) -> None:
    states = read_states(drawn_folder / "states.h5", images=False)
    assert len(states) == len(set(states.gauss_code)) == 3
    assert set(states.source["policy"]) == {"drawing"} and set(states.knot) == {"0_1"}
    assert (states.quality["noise_survival"] >= 0.95).all()
    assert list(folder_faults(drawn_folder)) == []


def test_a_start_that_its_seed_does_not_draw_is_a_fault(drawn_folder: Path) -> None:
    states = read_states(drawn_folder / "states.h5").taken(np.array([1]))
    seed = states.source["seed"].copy()
    seed[0, -1] += 1
    moved = replace(states, source={**states.source, "seed": seed})
    assert any("drawing" in fault for fault in state_faults(moved))


def test_drawn_states_merge_with_searched_ones_and_are_counted(
    drawn_folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    searched = read_states(shipped())
    merged = merge_states([searched, read_states(drawn_folder / "states.h5")], distinct=True)
    assert sorted(set(merged.source["drawing"]))[0] == "" and len(merged) == len(searched) + 3
    assert knotgym("dataset", "show", drawn_folder) == 0
    assert "sources: drawing 3" in capsys.readouterr().out


def test_a_run_saved_half_way_goes_on_to_the_same_states(tmp_path: Path) -> None:
    config = DrawnStatesConfig(nx=(1,), every_code=1, wave=1)
    whole, first, resumed = (DrawnStatesRecipe(config, Shard()) for _ in range(3))

    def follow(recipe: DrawnStatesRecipe, batches: int) -> None:
        for number, batch in enumerate(recipe.batches(tmp_path)):
            for unit in batch.units:
                batch.absorb(unit, batch.work(unit))
            if number == batches:
                break

    follow(whole, 100)
    follow(first, 1)
    first.save(tmp_path)
    assert resumed.load(tmp_path) and resumed.accepted[1]
    follow(resumed, 100)
    for nx in config.nx:
        assert [one.number for one in resumed.accepted[nx]] == [
            one.number for one in whole.accepted[nx]
        ]
        for one, other in zip(resumed.accepted[nx], whole.accepted[nx], strict=True):
            assert np.array_equal(one.qpos, other.qpos)


def test_shards_deal_out_every_code_once() -> None:
    config = DrawnStatesConfig(nx=(3,), every_code=1)
    orders = [DrawnStatesRecipe(config, Shard(number, 3)).codes[3] for number in (1, 2, 3)]
    found = [order.index(k) for order in orders for k in range(order.wanted)]
    assert len(found) == 46 and set(found) == set(range(46))


def test_with_more_crossings_than_are_listed_codes_are_drawn_at_random() -> None:
    codes = DrawnStatesRecipe(DrawnStatesConfig(nx=(7,), count=3), Shard()).codes[7]
    assert len({codes[k] for k in range(3)}) == 3 and codes[0].nx == 7
    assert codes.wanted == 3 and codes.listed is None


def test_a_code_asked_for_by_name_keeps_its_chirality() -> None:
    config = DrawnStatesConfig(nx=(1,), codes=("1+c,1-c",))
    made = draw_states(DrawnUnit(config, GaussCode.parse("1+c,1-c"), 0, 0, 5, 1))
    assert [one.code.chiral for one in made.states] == ["1+c,1-c"]


@pytest.mark.parametrize(
    ("knot", "letters"), [pytest.param("3_1", "ccc", marks=pytest.mark.slow), ("m3_1", "aaa")]
)
def test_a_knot_is_drawn_with_its_hand(knot: str, letters: str) -> None:
    config = DrawnStatesConfig(knot=knot, every_code=1)
    codes = DrawnStatesRecipe(config, Shard()).codes[3]
    assert codes.listed is not None and codes.existing == 2
    made = draw_states(DrawnUnit(config, codes[1], 1, 1, 10, 1))
    assert [one.code.chirality for one in made.states] == [letters]


def test_a_large_knot_is_drawn_as_the_tables_diagram_from_every_base() -> None:
    codes = DrawnStatesRecipe(DrawnStatesConfig(knot="m8_19", nx=(8,), count=3), Shard()).codes[8]
    assert codes.listed is not None and codes.wanted == 3 and codes.existing is None
    assert {knot_type(code) for code in codes.listed} == {"8_19"}
    assert all(shows(code, "m8_19") for code in codes.listed)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"nx": (12,)}, "from 0 to 11, got 12"),
        ({"nx": (2,), "codes": ("1+,2-,1-,2+",)}, "no closed curve shows the code"),
        ({"nx": (3,), "codes": ("1+,2-,3+,1-,2+,3-",)}, "shows the knot 3_1, not 0_1"),
        ({"nx": (2,), "codes": ("1+,1-",)}, "nx must name the crossings"),
        ({"knot": "9_50"}, "no knot '9_50'; there are 0_1"),
        ({"knot": "9_42", "nx": (8,)}, "no diagram of 9_42 has 8 crossings; it takes 9"),
        ({"knot": "9_42", "nx": (9,), "codes": ("1+,1-",)}, "nx must name the crossings"),
        (
            {"knot": "m3_1", "codes": ("1-c,2+c,3-c,1+c,2-c,3+c",)},
            "shows the knot 3_1, not m3_1 of this hand",
        ),
        ({"stir": -1}, "stir must be a whole number of at least 0"),
    ],
)
def test_what_cannot_be_drawn_is_refused(changes: dict[str, object], problem: str) -> None:
    with pytest.raises(KnotgymError, match=problem) as caught:
        DrawnStatesConfig(**changes)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_every_code_of_seven_crossings_is_refused() -> None:
    with pytest.raises(KnotgymError, match="too many to be listed"):
        DrawnStatesRecipe(DrawnStatesConfig(nx=(7,), every_code=1), Shard())


def test_the_configuration_is_json() -> None:
    assert json.loads(json.dumps(as_json(DrawnStatesConfig())))["drawing"]["easing"]["first"] > 0
