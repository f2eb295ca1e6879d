"""Planned sequences: the planner finds action sequences to codes that play has not reached.

It starts from the nearest known state, so a sequence is that state's sequence and the plan.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from knotgym.common.streams import generator_of
from knotgym.control.action_sequence import ActionSequence, step_ropes
from knotgym.control.planner import Node, plan
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.transition_graph import shipped_transition_graph
from knotgym.generate.states.archive import Elite
from knotgym.generate.states.search import SearchConfig, readings
from knotgym.quality.measures import Limits
from knotgym.rope.engines import simulation_of
from knotgym.rope.model import Array
from knotgym.rope.simulation import Simulation
from knotgym.topology.gauss import GaussCode

PACE = 7  # actions allowed per change of code on the way to the goal


class Target(NamedTuple):
    """A code to find an action sequence to.

    Attributes:
        search: settings of play, for the length limit and the rope.
        planner: settings of the first search; every further search has twice the budget.
        elites: possible start states.
        goal: the code, without chirality.
        mirrored: whether a sequence to the mirror image also counts.
        wanted: other codes, without chirality, to keep if the planner reaches them.
        number: earlier searches for this code; search n starts from the nth nearest elite.
        seed: key of the random stream.
    """

    search: SearchConfig
    planner: PlannerConfig
    elites: tuple[Elite, ...]
    goal: GaussCode
    mirrored: bool
    wanted: frozenset[GaussCode]
    number: int
    seed: tuple[int, ...]


class Found(NamedTuple):
    """Result of a search for a target.

    Attributes:
        elites: states for the archive; none has the goal code if the planner failed.
        spent: number of simulated actions.
    """

    elites: tuple[Elite, ...]
    spent: int


class _Way(NamedTuple):
    """A sequence from the start, and the integration state at its end."""

    sequence: ActionSequence
    state: Array


def reach(target: Target) -> Found:
    """Plan a sequence to a target; return elites of the goal and of other requested codes."""
    simulation = simulation_of(target.planner.batch_size, target.search.rope, target.search.engine)
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
    begin = _Way(elite.sequence, elite.state)
    met: dict[GaussCode, Node] = {}  # first node with each code
    planned = plan(
        simulation,
        begin.state,
        goal,
        graph,
        replace(target.planner, budget=target.planner.budget * 2**target.number),
        generator_of(target.seed),
        steps=steps,
        met=lambda node: met.setdefault(node.code.plain, node),
    )
    ways: dict[Node, _Way] = {}
    elites: list[Elite] = []
    for code, node in met.items():
        if code == goal.plain or code in target.wanted:
            sequence, state = _act_out(simulation, node, begin, ways)
            simulation.restore(state[None], [0])
            shown_now = readings(simulation.points[0], Limits(), target.search.rope)
            elites += [reading.elite(sequence, state) for reading in shown_now]
    return Found(tuple(elites), planned.spent + sum(len(node.actions) for node in ways))


def _act_out(simulation: Simulation, node: Node, begin: _Way, ways: dict[Node, _Way]) -> _Way:
    """Replay the plan up to a node with beads and forces; `ways` caches nodes already replayed."""
    if node.before is None:
        return begin
    if node not in ways:
        before = _act_out(simulation, node.before, begin, ways)
        simulation.restore(before.state[None], [0])
        beads = np.zeros(len(node.actions), dtype=np.int16)
        forces = np.zeros((len(node.actions), 3), dtype=np.float32)
        for step, action in enumerate(node.actions):
            (beads[step],), force = simulation.read_actions(action[None], [0])
            forces[step] = force[0] / simulation.max_force
            step_ropes(simulation, beads[[step]], forces[[step]], [0])
        sequence = before.sequence + ActionSequence(beads, forces)
        ways[node] = _Way(sequence, simulation.states([0])[0])
    return ways[node]
