"""The states of a run: slots dealt to shards, codes drawn, sequences planned, all of it resumed."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knotgym.common.configuration import as_json
from knotgym.common.errors import KnotgymError
from knotgym.common.streams import Stream, key
from knotgym.control.planner_config import PlannerConfig
from knotgym.datasets.state_verification import folder_faults, state_faults
from knotgym.generate.states import planned_sequences
from knotgym.generate.states.archive import Archive
from knotgym.generate.states.code_order import CodeOrder
from knotgym.generate.states.demonstrations import DemonstrationTask, demonstrate
from knotgym.generate.states.drawn_states import DrawnUnit, draw_states
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.generate.states.planned_sequences import Target, reach
from knotgym.generate.states.search import SearchConfig, new_archive
from knotgym.generate.states.state_recipe import StateRecipe
from knotgym.quality.measures import Limits
from knotgym.rope.model import Rope
from knotgym.rope.mujoco_simulation import MujocoSimulation
from knotgym.runs.engine import CHECKPOINT
from knotgym.runs.executors import InProcess
from knotgym.runs.shards import Shard
from knotgym.states.state_file import merge_states, read_states, shipped
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import knot_type, shows
from knotgym.topology.symmetry import mirror_images

from ..conftest import curled, trefoil
from ..small_job import SMALL, knotgym

WANTED = ("--no-demonstrations", "--nx", "0-1", "--every-code", 1, "--workers", 1, "--quiet")


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
    moved = states.replaced({"source/seed": seed})
    assert any("drawing" in fault for fault in state_faults(moved))


def test_drawn_states_merge_with_searched_ones_and_are_counted(
    drawn_folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    searched = read_states(shipped())
    merged = merge_states([searched, read_states(drawn_folder / "states.h5")], distinct=True)
    assert sorted(set(merged.source["drawing"]))[0] == "" and len(merged) == len(searched) + 3
    assert knotgym("dataset", "show", drawn_folder) == 0
    assert "sources: drawing 3" in capsys.readouterr().out


def follow(recipe: StateRecipe, folder: Path, waves: int = 1000) -> StateRecipe:
    """Follow a recipe for some waves, saved after each."""
    for batch in recipe.batches(folder):
        for _ in batch.follow(InProcess()):
            pass
        if batch is CHECKPOINT:
            recipe.save(folder)
            waves -= 1
        if not waves:
            break
    return recipe


def signature(recipe: StateRecipe) -> list[object]:
    """What a run came to, every bit of it."""
    states = {slot: (one.seed, one.qpos.tobytes()) for slot, one in recipe.states.items()}
    ways = {slot: one.points.tobytes() for slot, one in recipe.demonstrations.items()}
    return [states, ways, recipe.report(), recipe.archive.growth]


@pytest.mark.thorough
def test_a_run_saved_after_any_wave_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    config = replace(SMALL, nx=(1,), every_code=1, wave=1)
    whole = StateRecipe(config)
    whole.begin()
    follow(whole, tmp_path)
    assert whole.cycle >= 3 and len(whole.states) == 2
    for waves in range(1, whole.cycle):
        folder = tmp_path / str(waves)
        folder.mkdir()
        first, resumed = StateRecipe(config), StateRecipe(config)
        first.begin()
        follow(first, folder, waves)
        assert resumed.load(folder)
        assert signature(follow(resumed, folder)) == signature(whole)


@pytest.fixture(scope="module", params=["demonstrator", "planner"])
def planned(request: pytest.FixtureRequest) -> Archive:
    """An archive with a sequence to a code with one crossing, and what is on the way."""
    search = SearchConfig(max_nx=2)
    archive = new_archive(search)
    elites = tuple(archive.niches[GaussCode(chirality="")])
    goal = GaussCode.parse("1+,1-")
    planner = PlannerConfig(budget=800)
    target = Target(search, planner, elites[:1], goal, True, frozenset(), 0, (7, 0, 0, 0, 0))
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "planner":  # as if the demonstrator found no way
            patch.setattr(planned_sequences, "lead", lambda *_: 0)
        found = reach(target)
    assert any(one.exact and one.code.plain in (goal, goal.mirrored()) for one in found.elites)
    assert found.spent > 0
    for elite in found.elites:
        archive.offer(elite, search.archive)
    return archive


def test_a_planned_sequence_is_demonstrated_to_the_code_and_to_its_mirror_image(
    planned: Archive, rope: Rope
) -> None:
    goal = GaussCode.parse("1+,1-")
    elites = tuple(
        one
        for niche, elites in planned.niches.items()
        if goal in {image.plain for image in mirror_images(niche)}
        for one in elites
        if one.exact
    )
    for index, code in enumerate((goal, goal.mirrored())):
        seed = key(Stream.CANDIDATE, 0, 1, index)
        task = DemonstrationTask(SMALL, "0_1", code, index, rope.loop(), elites, seed)
        made = demonstrate(task).demonstration
        assert made is not None and label(made.points[-1]).matches(code)
        assert not any(label(points).matches(code) for points in made.points[:-1])
        simulation = MujocoSimulation(1, rope)
        simulation.lay(made.start_qpos[None])
        for action in made.actions:
            assert simulation.act(action[None]).all()
        assert np.array_equal(simulation.points[0], made.points[-1])
        episode = made.episode(made.points[-1], code)
        assert episode.hold == 1 and episode.is_success[-1]


def test_what_play_met_and_keeps_all_limits_is_a_state(rope: Rope, tmp_path: Path) -> None:
    loose = Limits(
        margin=-99.0,
        crossing_angle=0.0,
        base_spacing=0.0,
        strand_spacing=0.0,
        smallest_region=0.0,
        clearance=0.0,
        noise_survival=0.0,
    )
    recipe = StateRecipe(replace(SMALL, nx=(1,), limits=loose, every_code=1))
    recipe.begin()
    follow(recipe, tmp_path)
    state = next(one for one in recipe.states.values() if one.policy == "play")
    simulation = MujocoSimulation(1, rope)
    simulation.lay(state.start_qpos[None])
    for action in state.actions:
        simulation.act(action[None])
    assert np.array_equal(simulation.qpos()[0], state.qpos)
    made = recipe.demonstrations[1, state.index, 0]
    assert np.array_equal(made.points[-1], state.points)  # it ends in the very state


def test_a_code_without_a_sequence_is_passed_over_for_the_next() -> None:
    recipe = StateRecipe(replace(SMALL, nx=(2,), count=4, searches=1))
    recipe.begin()
    order = [index for index, _ in recipe.codes[2].slots()]
    assert [index for _, index, _ in recipe._window(2, {})[1]] == order[:5]  # a quarter more
    recipe.searches[2, order[0]] = 1
    assert [index for _, index, _ in recipe._window(2, {})[1]] == order[1:6]
    assert recipe.report()["passed_over"]["2"] == [str(recipe.codes[2][order[0]])]


def test_sequences_begin_at_the_curve_of_a_file_even_of_an_unknot(tmp_path: Path) -> None:
    np.save(tmp_path / "curled.npy", curled(2))
    recipe = StateRecipe(replace(SMALL, nx=(1,), knot=str(tmp_path / "curled.npy")))
    recipe.begin()
    assert recipe.knot == "0_1" and recipe.search.max_nx == 2
    assert recipe.archive.settings["start"] == recipe.start.points.tolist()


def test_an_archive_that_begins_elsewhere_is_refused(tmp_path: Path, rope: Rope) -> None:
    new_archive(SearchConfig(), rope.from_curve(trefoil())).save(tmp_path / "archive.h5")
    with pytest.raises(KnotgymError, match="start from another curve"):
        StateRecipe(SMALL, archive=tmp_path / "archive.h5").begin()


def test_codes_whose_sequences_are_known_first_fill_the_count() -> None:
    recipe = StateRecipe(replace(SMALL, nx=(2,), count=4))
    order = [index for index, _ in recipe.codes[2].slots()]
    known = {recipe.codes[2][index].plain: list[Any]([None]) for index in order[1:5]}
    ready, unknown = recipe._window(2, known)
    assert [index for _, index, _ in ready] == order[1:5]
    assert [index for _, index, _ in unknown] == order[:1]


def test_shards_deal_out_every_state_once() -> None:
    for config in (GenerateConfig(every_code=1), GenerateConfig(nx=(0,), count=17)):
        nx = config.nx[0]
        orders = [CodeOrder(config, "0_1", Shard(number, 3), nx) for number in (1, 2, 3)]
        found = [slot for order in orders for slot in order.slots()]
        assert len(set(found)) == len(found) == sum(order.wanted for order in orders)
        assert len(found) == (46 if nx else 17)


def test_more_codes_than_states_are_all_tried_once_before_any_twice() -> None:
    slots = list(CodeOrder(GenerateConfig(nx=(2,), count=20), "0_1", Shard(), 2).slots())
    assert len({index for index, _ in slots[:8]}) == 8 and len(slots) == 24


def test_with_more_crossings_than_are_listed_codes_are_drawn_at_random() -> None:
    config = GenerateConfig(nx=(7,), count=3, demonstrations=False)
    codes = StateRecipe(config).codes[7]
    assert len({codes[k] for k in range(3)}) == 3 and codes[0].nx == 7
    assert codes.wanted == 3 and codes.listed is None


def test_a_code_asked_for_by_name_keeps_its_chirality() -> None:
    config = GenerateConfig(nx=(1,), codes=("1+c,1-c",))
    made = draw_states(DrawnUnit(config, "0_1", GaussCode.parse("1+c,1-c"), 0, 0, 5, 1))
    assert [one.code.chiral for one in made.states] == ["1+c,1-c"]


@pytest.mark.parametrize(
    ("knot", "letters"), [pytest.param("3_1", "ccc", marks=pytest.mark.slow), ("m3_1", "aaa")]
)
def test_a_knot_is_drawn_with_its_hand(knot: str, letters: str) -> None:
    config = GenerateConfig(knot=knot, every_code=1)
    codes = StateRecipe(config).codes[3]
    assert codes.listed is not None and codes.existing == 2
    made = draw_states(DrawnUnit(config, knot, codes[1], 1, 1, 10, 1))
    assert [one.code.chirality for one in made.states] == [letters]


def test_a_large_knot_is_drawn_as_the_tables_diagram_from_every_base() -> None:
    codes = StateRecipe(GenerateConfig(knot="m8_19", nx=(8,), count=3)).codes[8]
    assert codes.listed is not None and codes.wanted == 3 and codes.existing is None
    assert {knot_type(code) for code in codes.listed} == {"8_19"}
    assert all(shows(code, "m8_19") for code in codes.listed)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"nx": (12,)}, "from 0 to 11, got 12"),
        ({"nx": (2,), "codes": ("1+,2-,1-,2+",)}, "no closed curve shows the code"),
        ({"nx": (3,), "codes": ("1+,2-,3+,1-,2+,3-",)}, "shows the knot 3_1, not 0_1"),
        ({"nx": (2,), "codes": ("1+,1-",)}, "nx must include the crossings"),
        ({"knot": "9_50"}, "no knot '9_50'; there are 0_1, .*; or a file"),
        ({"knot": "9_42", "nx": (8,)}, "no diagram of 9_42 has 8 crossings; it has at least 9"),
        ({"knot": "9_42", "nx": (9,), "codes": ("1+,1-",)}, "nx must include the crossings"),
        (
            {"knot": "m3_1", "codes": ("1-c,2+c,3-c,1+c,2-c,3+c",)},
            r"shows the knot 3_1, not m3_1 \(handedness differs\)",
        ),
        ({"stir": -1}, "stir must be a whole number of at least 0"),
        ({"nx": (7,)}, "limited to 6 crossings, got nx 7; --no-demonstrations"),
    ],
)
def test_what_cannot_be_drawn_is_refused(changes: dict[str, object], problem: str) -> None:
    with pytest.raises(KnotgymError, match=problem) as caught:
        StateRecipe(GenerateConfig(**changes))  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_every_code_of_seven_crossings_is_refused() -> None:
    with pytest.raises(KnotgymError, match="too many codes with 7 crossings to list"):
        GenerateConfig(nx=(7,), every_code=1)


def test_the_configuration_is_json() -> None:
    assert json.loads(json.dumps(as_json(GenerateConfig())))["drawing"]["easing"]["first"] > 0
