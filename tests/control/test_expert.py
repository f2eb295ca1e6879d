from importlib.resources import files
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.common.errors import InvalidFile, InvalidInput
from knotgym.control import planner
from knotgym.control.action_sequence import step_ropes
from knotgym.control.checked_plan import Stand, plan_checked
from knotgym.control.expert import BLIND, Expert
from knotgym.control.planner import Node, Plan, plan, reason
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.transition_counts import (
    ELEMENTS,
    ArcCoordinates,
    MacroTemplate,
    TransitionCounts,
    transformed,
)
from knotgym.control.transition_graph import (
    TransitionGraph,
    TransitionGraphConfig,
    shipped_transition_graph,
)
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.rope.chain.chain_simulation import ChainSimulation
from knotgym.rope.engines import ENGINES
from knotgym.rope.model import Rope
from knotgym.rope.mujoco_simulation import MujocoSimulation
from knotgym.rope.simulation import Simulation
from knotgym.states.state_file import read_states, shipped
from knotgym.topology.crossings import find_crossings, label
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import codes_of

KINK = GaussCode.parse("1+a,1-a")
FLAT = GaussCode.parse("")
GRAPH = TransitionGraphConfig()
SHIPPED = Path(str(files("knotgym.control") / "data" / "transitions.h5"))


def kinks() -> TransitionCounts:
    """A made-up table: half of the macro-actions kink a loop, a quarter undo it."""
    table = TransitionCounts()
    for k in range(8):
        table.set_out(FLAT)
        table.set_out(KINK)
        if k % 2:
            table.change(FLAT, KINK, MacroTemplate("curl", 1, 0.25, 0.5), 6)
        if k % 4 == 0:
            table.change(KINK, FLAT, MacroTemplate("spread", 0, 1.5, -1.0), 6)
    return table


@given(
    st.sampled_from([code for nx in range(4) for code in codes_of("0_1", nx)]),
    st.tuples(*[st.booleans()] * 3),
)
def test_a_symmetry_element_undoes_itself(
    code: GaussCode, element: tuple[bool, bool, bool]
) -> None:
    assert transformed(transformed(code, element), element) == code


def test_changes_are_counted_alike_for_a_rope_and_its_mirror() -> None:
    table = kinks()
    table.set_out(FLAT)
    table.change(FLAT, KINK.mirrored(), MacroTemplate("curl", -1, 0.25, 0.5), 6)
    assert sorted(table.seen.values()) == [2, 5]


def test_the_distance_is_one_over_the_doubted_chance() -> None:
    graph = TransitionGraph(kinks(), GRAPH)
    distances = graph.distances(GaussCode.parse("1+,1-"))
    assert distances(FLAT) == pytest.approx((8 + GRAPH.doubt) / 4)
    assert distances(KINK) == 0
    assert distances(GaussCode.parse("1+a,1-a,2+c,2-c")) > distances(FLAT)


def test_every_member_of_a_class_is_as_far_as_the_goal_turned_with_it() -> None:
    graph = TransitionGraph(kinks(), GRAPH)
    assert graph.distances(GaussCode.parse("1-,1+"))(FLAT) == graph.distances(
        GaussCode.parse("1+,1-")
    )(FLAT)


def test_distances_are_those_of_plain_shortest_paths() -> None:
    table = TransitionCounts.load(SHIPPED).pruned(max_nx=3, least=40)
    graph, cost = TransitionGraph(table, GRAPH), dict[tuple[GaussCode, GaussCode], float]()
    for (before, after), seen in table.seen.items():
        for element in ELEMENTS:
            pair = transformed(before, element), transformed(after, element)
            cost[pair] = min(
                cost.get(pair, np.inf), 1 / (seen / (table.tried[before] + GRAPH.doubt))
            )
    goal = graph.distances(GaussCode.parse("1+,1-"))
    far = dict.fromkeys(goal.goals, 0.0)
    while nearer := {
        before: far[after] + step
        for (before, after), step in cost.items()
        if after in far and far[after] + step < far.get(before, np.inf)
    }:
        far |= nearer
    assert goal.far == pytest.approx(far) and len(far) > 20
    code = max(far, key=lambda code: far[code])
    towards = {step.after: step.gain for step in graph.steps(code, goal)}
    assert towards == pytest.approx(
        {
            after: far[code] - far[after]
            for before, after in cost
            if before == code and far.get(after, np.inf) < far[code] - 1e-9
        }
    )


def test_single_moves_lead_to_what_was_never_counted() -> None:
    before = GaussCode.parse("1+a,2+c,2-c,1-a,3+a,4+c,4-c,3-a")  # two fingers, then a kink
    goal = GaussCode.parse("1+a,2+c,2-c,1-a,3+a,4+c,4-c,3-a,5+c,5-c")
    table = TransitionCounts.load(SHIPPED).pruned(max_nx=4, least=40)
    graph = TransitionGraph(table, GRAPH)
    distances = graph.distances(goal.plain)
    assert 0 == distances(goal) < distances(before) < distances(FLAT) < distances.beyond
    (step,) = (step for step in graph.steps(before, distances) if step.after == goal)
    ways = [step.template(number) for number in range(len(step.examples))]
    assert {(way.kind, int(way.bead), int(way.target)) for way in ways} == {
        ("curl", 8, 8)
    }  # on the last arc


def test_of_a_rope_of_many_crossings_it_is_known_how_many_moves_take_them_out() -> None:
    rope = GaussCode.parse("1+a,2+c,2-c,1-a,3+a,4+c,4-c,3-a,5+a,6+c,6-c,5-a")
    distances = TransitionGraph(kinks(), GRAPH).distances(FLAT.plain, rope)
    assert distances(rope) < distances.beyond + 6 * distances.strange
    assert distances.hops[rope] == 3


def test_steps_come_with_templates_turned_for_the_rope() -> None:
    graph = TransitionGraph(kinks(), GRAPH)
    steps = graph.steps(FLAT, graph.distances(GaussCode.parse("1-,1+")))
    assert {str(step.after) for step in steps} == {"1-,1+"}
    held = {
        (template.side, round(template.bead, 2))
        for step in steps
        for template in map(step.template, range(len(step.examples)))
    }
    assert held == {(-1, 0.25), (1, 0.75)}  # below on the way, or above seen from the other end


def test_transitions_come_back_from_their_file(tmp_path: Path) -> None:
    table = kinks()
    table.save(tmp_path / "t.h5")
    back = TransitionCounts.load(tmp_path / "t.h5")
    assert (back.tried, back.seen, back.templates) == (table.tried, table.seen, table.templates)


def test_a_foreign_file_holds_no_transitions(tmp_path: Path) -> None:
    (tmp_path / "t.h5").write_text("no")
    with pytest.raises(InvalidFile):
        TransitionCounts.load(tmp_path / "t.h5")
    with pytest.raises(FileNotFoundError):
        TransitionCounts.load(tmp_path / "absent.h5")


@pytest.mark.parametrize("base_shift", [0, 14, 86])
def test_a_bead_is_found_again_by_its_arc(base_shift: int, rope: Rope, states_path: str) -> None:
    episodes = EpisodeBatch(TaskConfig(task="unknot", nx=3, states=states_path))
    episodes.begin(0, np.random.default_rng(0))
    arcs = ArcCoordinates(find_crossings(episodes.simulation.points[0]), 100, base_shift)
    assert [arcs.bead(arcs.arc(bead)) for bead in range(100)] == list(range(100))
    assert int(max(arcs.arc(bead) for bead in range(100))) == 6


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ("", "1+a,1-a", "R1+ pass"),
        ("1+a,1-a", "", "R1- pass"),
        ("", "1+a,2+c,2-c,1-a", "R2+ pass"),
        ("1+a,2+c,1-a,2-c", "1+c,2-a,1-c,2+a", "slide pass"),
        ("1+a,1-a", "1-a,1+a", "slide pass"),
        ("1+a,1-a", "1+c,1-c", "other pass"),
        ("1+a,1-a", "1+a,1-a", "none pass"),
    ],
)
def test_the_reason_names_the_move(before: str, after: str, expected: str) -> None:
    assert reason(GaussCode.parse(before), GaussCode.parse(after), "pass") == expected


def out_of_reach(every: dict[int, int]) -> list[str]:
    """Codes to which the shipped graph leads from nowhere, or not from the loop; looks at every so
    many of each nx, and at one at least, for a goal takes tenths of a second.
    """
    graph = shipped_transition_graph(GRAPH)
    goals = [code for nx, step in every.items() for code in codes_of("0_1", nx)[::step]]
    assert len(goals) >= len(every)
    return [str(goal) for goal in goals if FLAT not in graph.distances(goal).far]


@pytest.mark.slow
def test_the_graph_that_ships_leads_to_codes_of_up_to_three_crossings() -> None:
    assert out_of_reach({1: 2, 2: 8, 3: 46}) == []


@pytest.mark.slow
def test_the_graph_that_ships_leads_to_every_thirtieth_code_of_four_crossings() -> None:
    assert out_of_reach({1: 1, 2: 1, 3: 1, 4: 30}) == []


def act_out(simulation: Simulation, planned: Plan) -> None:
    """Take a plan's actions with rope 0."""
    for bead, force in zip(planned.pulls.beads, planned.pulls.forces, strict=True):
        step_ropes(simulation, np.array([bead]), force[None], [0])


@pytest.mark.thorough
def test_a_plan_that_is_solved_ends_in_the_goal_when_acted_out(states_path: str) -> None:
    episodes = EpisodeBatch(
        TaskConfig(task="unknot", nx=1, states=states_path, split="test", observation="state")
    )
    episodes.begin(0, np.random.default_rng(3))
    config = PlannerConfig(budget=600, batch_size=4)
    start = episodes.simulation.states([0])[0]
    goal = GaussCode(())
    planned = plan(
        MujocoSimulation(4),
        start,
        goal,
        shipped_transition_graph(GRAPH),
        config,
        np.random.default_rng(0),
        steps=50,
    )
    assert planned.solved and len(planned.pulls) == len(planned.moves) <= 50
    act_out(episodes.simulation, planned)
    assert label(episodes.simulation.points[0]).matches(goal)


@pytest.mark.thorough
@pytest.mark.parametrize("engine", ENGINES)
def test_plans_are_checked_in_the_engine_of_the_episode(states_path: str, engine: str) -> None:
    task = TaskConfig(
        task="tie", nx=1, states=states_path, split="test", observation="state", engine=engine
    )
    episodes, expert = EpisodeBatch(task), Expert(PlannerConfig(budget=600))
    episodes.begin(0, np.random.default_rng(3))
    expert.begin(episodes, 0, np.random.default_rng(0))
    for _ in range(task.horizon):
        choice = expert.act(episodes, np.array([0]))
        assert not choice.moves[0].startswith(BLIND)
        episodes.step(choice.actions, np.array([0]))
        if episodes.codes[0].matches(episodes.goals[0]):
            return
    pytest.fail(f"the plan doesn't end in the goal in the engine {engine}")


@pytest.mark.thorough
def test_a_plan_made_in_the_chain_ends_in_the_goal_in_mujoco(states_path: str) -> None:
    states, check = read_states(states_path, images=False), MujocoSimulation(1)
    check.lay(states.qpos[[int(np.flatnonzero(states.nx == 3)[0])]])
    start, met = check.states()[0], list[Stand]()
    planned = plan_checked(
        ChainSimulation(8),
        check,
        start,
        KINK.plain,
        shipped_transition_graph(GRAPH),
        PlannerConfig(batch_size=8),
        np.random.default_rng(0),
        steps=50,
        met=met.append,
    )
    assert planned.solved and len(planned.pulls) <= 50
    check.restore(start[None])
    act_out(check, planned)
    assert label(check.points[0]).matches(KINK.plain)
    # what it says of states on the way is so in MuJoCo too
    assert np.array_equal(check.states()[0], met[-1].state) and met[-1].code.matches(KINK.plain)
    assert planned.spent >= len(met) >= len(planned.pulls)


@pytest.mark.slow
def test_a_hard_unknot_is_hauled_loose() -> None:
    states = read_states(shipped("hard-unknots"), images=False)
    simulation = MujocoSimulation(8)
    simulation.lay(states.qpos[:1], [0])
    start = simulation.states([0])[0]
    planned = plan(
        simulation,
        start,
        FLAT,
        shipped_transition_graph(GRAPH),
        PlannerConfig(budget=1000),
        np.random.default_rng(1),
        steps=50,
        hauling=True,
    )
    assert planned.solved and any(move.endswith("haul") for move in planned.moves)
    simulation.restore(start[None], [0])
    act_out(simulation, planned)
    assert label(simulation.points[0]) == FLAT


@pytest.mark.thorough
def test_ropes_of_few_crossings_are_not_hauled(states_path: str) -> None:
    def planned(hauling: bool) -> Plan:
        simulation = MujocoSimulation(4)
        simulation.lay(read_states(states_path, images=False).qpos[-1:], [0])
        return plan(
            simulation,
            simulation.states([0])[0],
            FLAT,
            shipped_transition_graph(GRAPH),
            PlannerConfig(budget=80, batch_size=4),
            np.random.default_rng(0),
            steps=50,
            hauling=hauling,
        )

    np.testing.assert_array_equal(planned(True).pulls.forces, planned(False).pulls.forces)


def test_a_plan_holds_the_goal_as_long_as_asked(states_path: str) -> None:
    task = TaskConfig(task="tie", nx=1, states=states_path, hold=3, observation="state")
    episodes, expert = EpisodeBatch(task), Expert(PlannerConfig(budget=3000, batch_size=4))
    episodes.begin(0, np.random.default_rng(0))
    expert.begin(episodes, 0, np.random.default_rng(1))
    ended = False
    while not ended:
        _, terminated, truncated = episodes.step(
            expert.act(episodes, np.array([0])).actions, np.array([0])
        )
        ended = bool(terminated[0] or truncated[0])
    assert episodes.info(0)["is_success"] and episodes.held[0] == 3


def test_without_counts_the_crossings_guide() -> None:
    simulation = MujocoSimulation(4)
    start = simulation.states([0])[0]
    planned = plan(
        simulation,
        start,
        KINK.plain,
        TransitionGraph(TransitionCounts(), GRAPH),
        PlannerConfig(budget=2000, batch_size=4),
        np.random.default_rng(0),
        steps=50,
    )
    assert planned.solved


def test_planning_keeps_its_budget_and_says_what_it_spent() -> None:
    simulation = MujocoSimulation(4)
    goal = codes_of("0_1", 4)[0]
    planned = plan(
        simulation,
        simulation.states([0])[0],
        goal,
        shipped_transition_graph(GRAPH),
        PlannerConfig(budget=30, batch_size=4),
        np.random.default_rng(0),
        steps=50,
    )
    assert not planned.solved and planned.spent == 28


def test_a_search_that_has_had_its_chance_begins_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    def searched(budget: int) -> tuple[list[Node], Plan]:
        simulation, met = ChainSimulation(4), list[Node]()
        planned = plan(
            simulation,
            simulation.states([0])[0],
            codes_of("0_1", 4)[0],
            shipped_transition_graph(GRAPH),
            PlannerConfig(batch_size=4),
            np.random.default_rng(0),
            steps=50,
            budget=budget,
            met=met.append,
        )
        return met, planned

    def root(node: Node) -> Node:
        return node if node.before is None else root(node.before)

    monkeypatch.setattr(planner, "RESTART", 240)  # long enough for each search to keep a state
    met, planned = searched(720)
    assert planned.spent == 720 and not planned.solved
    assert len({id(root(node)) for node in met}) == 3
    first, _ = searched(240)
    assert [node.code for node in met[: len(first)]] == [node.code for node in first]


def test_with_its_budget_gone_the_expert_goes_on_without_looking_ahead(states_path: str) -> None:
    episodes = EpisodeBatch(TaskConfig(task="tie", nx=4, states=states_path, observation="state"))
    expert = Expert(PlannerConfig(budget=0))
    episodes.begin(0, np.random.default_rng(0))
    expert.begin(episodes, 0, np.random.default_rng(1))
    choice = expert.act(episodes, np.array([0]))
    assert choice.moves[0].startswith(BLIND) and np.abs(choice.actions[0, 3:]).max() > 0
    assert expert.effort(0).actions == 0


@pytest.mark.parametrize(
    "settings",
    [
        {"budget": -1},
        {"batch_size": 0},
        {"guided": 2.0},
        {"greed": -1.0},
        {"patience": 0.0},
        {"kept": 0},
    ],
)
def test_settings_no_planner_can_have_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput):
        PlannerConfig(**settings)


def test_changed_counts_are_refused(tmp_path: Path) -> None:
    kinks().save(tmp_path / "transitions.h5")
    with h5py.File(tmp_path / "transitions.h5", "a") as file:
        file["seen"][0] = 7
    with pytest.raises(InvalidFile, match="is corrupted"):
        TransitionCounts.load(tmp_path / "transitions.h5")
