"""Targeted search: the planner leads a rope to a code that the search hasn't met.

Or that it has met, but not as the rope is numbered.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from knotgym.common.streams import generator_of
from knotgym.control.action_sequence import NO_ACTIONS, ActionSequence, step_ropes
from knotgym.control.planner import Node, plan
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.transition_graph import shipped_transition_graph
from knotgym.generate.states.archive import Elite
from knotgym.generate.states.search import SearchConfig, readings
from knotgym.quality.measures import Limits
from knotgym.rope.model import Array
from knotgym.rope.simulation import Simulation
from knotgym.rope.simulation_pool import simulation_of
from knotgym.topology.gauss import GaussCode


class Target(NamedTuple):
    """A code to reach from a configuration (beads, 3) at rest; `seed` decides what is tried.

    With an `elite` from its state, and its sequence comes first. States that show a code of
    `wanted`, given without chirality, are kept too where the planner meets them.
    """

    search: SearchConfig
    planner: PlannerConfig
    start: Array
    goal: GaussCode
    seed: tuple[int, ...]
    elite: Elite | None = None
    wanted: frozenset[GaussCode] = frozenset()


class TargetPlan(NamedTuple):
    """What came of a target.

    Attributes:
        elites: for the archive; of the goal none if the planner failed.
        spent: simulated actions.
    """

    elites: tuple[Elite, ...]
    spent: int


class _Way(NamedTuple):
    """A sequence from where a target sets out, and the integration state that it ends in."""

    sequence: ActionSequence
    state: Array


def reach(target: Target) -> TargetPlan:
    """Plan a sequence to a target that the search could have found, and act it out."""
    search, planner = target.search, target.planner
    simulation = simulation_of(planner.batch_size, search.rope)
    rope = simulation.rope
    simulation.lay(rope.qpos(target.start)[None], [0])
    begin = _Way(NO_ACTIONS, simulation.states([0])[0])
    if target.elite is not None:
        begin = _Way(target.elite.sequence, target.elite.state)
    met: dict[GaussCode, Node] = {}  # the first that shows a code
    planned = plan(
        simulation,
        begin.state,
        target.goal,
        shipped_transition_graph(planner.graph),
        planner,
        generator_of(target.seed),
        steps=search.longest - len(begin.sequence),
        met=lambda node: met.setdefault(node.code.plain, node),
    )
    ways: dict[Node, _Way] = {}
    elites: list[Elite] = []
    for code, node in met.items():
        if code != target.goal.plain and code not in target.wanted:
            continue
        sequence, state = _act_out(simulation, node, begin, ways)
        simulation.restore(state[None], [0])
        shown = readings(simulation.points[0], Limits(), search.rope)
        elites += [reading.elite(sequence, state) for reading in shown]
    return TargetPlan(tuple(elites), planned.spent + sum(len(node.actions) for node in ways))


def _act_out(simulation: Simulation, node: Node, begin: _Way, ways: dict[Node, _Way]) -> _Way:
    """Lead a rope to a state that the planner met, by bead and force; `ways` holds those known."""
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
