"""Planned sequences: the planner finds action sequences to codes that play has not reached.

It starts from the nearest known state, so a sequence is that state's sequence and the plan.
"""

from dataclasses import replace
from typing import NamedTuple

from knotgym.common.streams import generator_of
from knotgym.control.checked_plan import Stand, plan_checked
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.transition_graph import shipped_transition_graph
from knotgym.generate.states.archive import Elite
from knotgym.generate.states.search import SearchConfig, readings
from knotgym.quality.measures import Limits
from knotgym.rope.engines import CHAIN, simulation_of
from knotgym.topology.gauss import GaussCode

PACE = 7  # actions allowed per change of code on the way to the goal


class Target(NamedTuple):
    """A code to find an action sequence to."""

    search: SearchConfig  # settings of play, for the length limit and the rope
    # settings of the first search; every further search has twice the budget
    planner: PlannerConfig
    elites: tuple[Elite, ...]  # possible start states
    goal: GaussCode  # the code, without chirality
    mirrored: bool  # whether a sequence to the mirror image also counts
    # other codes, without chirality, to keep if the planner reaches them
    wanted: frozenset[GaussCode]
    number: int  # earlier searches for this code; search n starts from the nth nearest elite
    seed: tuple[int, ...]  # key of the random stream


class Found(NamedTuple):
    """Result of a search for a target."""

    # states for the archive; none has the goal code if the planner failed
    elites: tuple[Elite, ...]
    spent: int  # number of simulated actions


def reach(target: Target) -> Found:
    """Plan a sequence to a target; return elites of the goal and of other requested codes."""
    graph = shipped_transition_graph(target.planner.graph)
    distances = graph.distances(target.goal)
    # The distance from an elite to the mirrored goal is that from the mirrored elite to the goal,
    # so one distance table serves both.
    near = [(elite, elite.code, target.goal) for elite in target.elites]
    if target.mirrored:
        goal = target.goal.mirrored()
        near += [(elite, elite.code.mirrored(), goal) for elite in target.elites]
    near.sort(key=lambda one: distances(one[1]) + len(one[0].sequence))
    elite, shown, goal = near[min(target.number, len(near) - 1)]
    hops = distances.hops.get(shown, target.planner.unknown_hops)
    # Every further search for a code may be longer, by the actions of one change of code.
    steps = min(target.search.longest - len(elite.sequence), PACE * (hops + target.number))
    simulation = simulation_of(1, target.search.rope, target.search.engine)
    wanted, met = target.wanted | {goal.plain}, dict[GaussCode, Stand]()  # first with each code
    planned = plan_checked(
        simulation_of(target.planner.batch_size, target.search.rope, CHAIN),
        simulation,
        elite.state,
        goal,
        graph,
        replace(target.planner, budget=target.planner.budget * 2**target.number),
        generator_of(target.seed),
        steps=steps,
        met=lambda stand: met.setdefault(stand.code.plain, stand),
    )
    elites: list[Elite] = []
    for code, stand in met.items():
        if code in wanted:
            simulation.restore(stand.state[None], [0])
            sequence = elite.sequence + stand.pulls
            shown_now = readings(simulation.points[0], Limits(), target.search.rope)
            elites += [reading.elite(sequence, stand.state) for reading in shown_now]
    return Found(tuple(elites), planned.spent)
