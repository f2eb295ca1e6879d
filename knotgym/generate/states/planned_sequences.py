"""Planned sequences: action sequences to codes that play has not reached.

The demonstrator or the planner starts from a known state, so a sequence is that state's sequence
and what they add.
"""

from dataclasses import replace
from typing import NamedTuple

from knotgym.common.streams import generator_of
from knotgym.control.action_sequence import ActionSequence
from knotgym.control.checked_plan import plan_checked
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.transition_graph import shipped_transition_graph
from knotgym.generate.states.archive import Elite
from knotgym.generate.states.led_sequences import LedRope, Met, lead
from knotgym.generate.states.search import SearchConfig, readings
from knotgym.quality.measures import Limits
from knotgym.rope.engines import CHAIN, simulation_of
from knotgym.rope.model import Array
from knotgym.topology.gauss import GaussCode

_LED = 8  # nearest states from which ropes are led in the first search for a code
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
    number: int  # earlier searches for this code; each starts from other elites
    seed: tuple[int, ...]  # key of the random stream


class Found(NamedTuple):
    """Result of a search for a target."""

    # states for the archive; none has the goal code if both failed
    elites: tuple[Elite, ...]
    spent: int  # number of simulated actions


def reach(target: Target) -> Found:
    """Find a sequence to a target; return elites of the goal and of other requested codes.

    The demonstrator leads ropes from the nearest elites; where it can't, the planner searches.
    """
    distances = shipped_transition_graph(target.planner.graph).distances(target.goal)
    # The distance from an elite to the mirrored goal is that from the mirrored elite to the goal,
    # so one distance table serves both.
    near = [(elite, elite.code, target.goal) for elite in target.elites]
    if target.mirrored:
        goal = target.goal.mirrored()
        near += [(elite, elite.code.mirrored(), goal) for elite in target.elites]
    near.sort(key=lambda one: distances(one[1]) + len(one[0].sequence))
    goals = {goal for *_, goal in near}
    wanted, met = target.wanted | goals, dict[GaussCode, tuple[ActionSequence, Array]]()

    def keep(code: GaussCode, sequence: ActionSequence, state: Array) -> None:
        if code in wanted:
            met.setdefault(code, (sequence, state))  # the first with each code

    # those beyond the elites of earlier searches, twice as many each time
    first, count = (2**target.number - 1) * _LED, 2**target.number * _LED
    led = near[first : first + count] or near[-count:]
    starts = [LedRope(elite, goal) for elite, _, goal in led]
    ropes = simulation_of(len(starts), target.search.rope, target.search.engine)
    spent = lead(ropes, starts, target.search.longest, keep)
    if not goals & met.keys():
        spent += _plan(target, *near[min(target.number, len(near) - 1)], keep)
    elites: list[Elite] = []
    for sequence, state in met.values():
        ropes.restore(state[None], [0])
        shown_now = readings(ropes.points[0], Limits(), target.search.rope)
        elites += [reading.elite(sequence, state) for reading in shown_now]
    return Found(tuple(elites), spent)


def _plan(target: Target, elite: Elite, shown: GaussCode, goal: GaussCode, met: Met) -> int:
    """Plan for a goal from an elite that shows a code, for both perhaps in the mirror.

    Returns:
        The number of simulated actions.
    """
    graph = shipped_transition_graph(target.planner.graph)
    hops = graph.distances(target.goal).hops.get(shown, target.planner.unknown_hops)
    # Every further search for a code may be longer, by the actions of one change of code.
    steps = min(target.search.longest - len(elite.sequence), PACE * (hops + target.number))
    planned = plan_checked(
        simulation_of(target.planner.batch_size, target.search.rope, CHAIN),
        simulation_of(1, target.search.rope, target.search.engine),
        elite.state,
        goal,
        graph,
        replace(target.planner, budget=target.planner.budget * 2**target.number),
        generator_of(target.seed),
        steps=steps,
        met=lambda stand: met(stand.code.plain, elite.sequence + stand.pulls, stand.state),
    )
    return planned.spent
