"""Nearness to an exemplar, and plans that heed it."""

import numpy as np
import pytest

from knotgym.control import exemplar as exemplars
from knotgym.control.exemplar import WEIGHT, Exemplar, Potential
from knotgym.control.macro_actions import MacroActionConfig
from knotgym.control.planner import Plan, plan
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.surrogate import SurrogateConfig, surrogate_rollout
from knotgym.control.transition_graph import TransitionGraphConfig, shipped_transition_graph
from knotgym.datasets.states import States, read_states, shipped
from knotgym.rope import Array, Rope
from knotgym.simulation import Simulation
from knotgym.topology.gauss import GaussCode

CONFIG = MacroActionConfig()
GRAPH = shipped_transition_graph(TransitionGraphConfig())


@pytest.fixture(scope="module")
def knotted(states: States) -> Array:
    return states.points[states.rows(3, "train")[0]]


def test_where_it_lies_how_turned_or_mirrored_is_all_one(knotted: Array) -> None:
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    alike = [knotted @ turn.T + [0.2, -0.1, 0.3], knotted * [1, -1, 1], knotted * [-1, 1, 1] + 1]
    assert Exemplar(knotted).apart(np.array(alike)) == pytest.approx(0, abs=1e-8)


def test_vertices_that_lie_elsewhere_count_by_their_mean_square(knotted: Array) -> None:
    larger = 1.1 * knotted
    spread = np.sqrt(((knotted - knotted.mean(axis=0))[:, :2] ** 2).sum(axis=1).mean())
    assert Exemplar(knotted).apart(larger[None])[0] == pytest.approx(0.1 * spread)
    renumbered = np.roll(knotted, 30, axis=0)
    assert Exemplar(knotted).apart(renumbered[None])[0] > 0.02


def test_what_is_proposed_brings_the_rope_nearer(knotted: Array, rope: Rope) -> None:
    exemplar, rng, loop = Exemplar(knotted), np.random.default_rng(0), rope.loop()
    nearer = []
    for _ in range(20):
        macro_action = exemplar.propose(loop, rng, CONFIG)
        frames = surrogate_rollout(loop, macro_action, CONFIG.arrived, SurrogateConfig())
        nearer.append(exemplar.apart(frames[-1:])[0] < exemplar.apart(loop[None])[0])
    assert np.mean(nearer) > 0.8


def test_a_rope_that_lies_as_the_exemplar_is_led_nowhere(knotted: Array) -> None:
    macro_action = Exemplar(knotted).propose(knotted + 1e-9, np.random.default_rng(0), CONFIG)
    assert np.isfinite(macro_action.waypoints).all()


def test_the_potential_is_the_distance_of_the_code_and_of_the_shape(
    knotted: Array, rope: Rope
) -> None:
    goal = GaussCode.parse("1+,2-,3+,1-,2+,3-")
    distances, frames = GRAPH.distances(goal), np.array([rope.loop(), knotted])
    codes = [GaussCode(()), GaussCode.parse("1+a,2-a,3+a,1-a,2+a,3-a")]
    far = [distances(code) for code in codes]
    assert Potential(distances)(codes, frames).tolist() == far
    apart = Exemplar(knotted).apart(frames)
    both = Potential(distances, Exemplar(knotted))(codes, frames)
    assert both == pytest.approx(np.array(far) + WEIGHT * apart)


def planned(goal: str, exemplar: Array | None, budget: int = 40) -> tuple[Plan, list[int]]:
    """A plan, and after how many steps each state was met."""
    simulation, steps = Simulation(4), list[int]()
    made = plan(
        simulation,
        simulation.states([0])[0],
        GaussCode.parse(goal).plain,
        GRAPH,
        PlannerConfig(budget=budget, batch_size=4),
        np.random.default_rng(0),
        steps=50,
        exemplar=exemplar,
        met=lambda node: steps.append(node.steps),
    )
    return made, steps


def beyond() -> str:
    """A code of more crossings than counts have."""
    return str(read_states(shipped("hard-unknots"), images=False).gauss_code[0])


def test_an_exemplar_is_heeded_where_counts_end_and_nowhere_else(knotted: Array) -> None:
    for goal, heeded in ((beyond(), True), ("1+,1-,2+,2-,3+,3-,4+,4-", False)):
        (plain, _), (guided, _) = planned(goal, None), planned(goal, knotted)
        assert np.array_equal(plain.actions, guided.actions) is not heeded


def test_a_search_begins_anew_until_its_budget_is_spent(
    knotted: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert max(planned(beyond(), knotted, 160)[1]) > 10
    monkeypatch.setattr(exemplars, "ANEW", 40)
    anew, steps = planned(beyond(), knotted, 160)
    assert anew.spent == 160 and max(steps) <= 10
