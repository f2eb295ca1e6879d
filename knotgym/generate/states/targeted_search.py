"""Targeted search: the planner leads a rope to a code that the search hasn't met.

Or that it has met, but not as the rope is numbered.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from knotgym.control.action_sequence import NO_ACTIONS, ActionSequence, step_ropes
from knotgym.control.planner import plan
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.transition_graph import shipped_transition_graph
from knotgym.generate.states.archive import Elite
from knotgym.generate.states.search import SearchConfig, readings
from knotgym.quality import Limits
from knotgym.rope import Array
from knotgym.simulation_pool import simulation_of
from knotgym.streams import generator_of
from knotgym.topology.gauss import GaussCode


class Target(NamedTuple):
    """A code to reach from a configuration (beads, 3) at rest; `seed` decides what is tried.

    With an `elite` from its state, and its sequence comes first.
    """

    search: SearchConfig
    planner: PlannerConfig
    start: Array
    goal: GaussCode
    seed: tuple[int, ...]
    elite: Elite | None = None


class TargetPlan(NamedTuple):
    """What came of a target.

    Attributes:
        elites: for the archive, none if the planner failed.
        spent: simulated actions.
    """

    elites: tuple[Elite, ...]
    spent: int


def reach(target: Target) -> TargetPlan:
    """Plan a sequence to a target that the search could have found, and act it out."""
    search, planner = target.search, target.planner
    simulation = simulation_of(planner.batch_size, search.rope)
    rope = simulation.rope
    simulation.lay(rope.qpos(target.start)[None], [0])
    state, before = simulation.states([0])[0], NO_ACTIONS
    if target.elite is not None:
        state, before = target.elite.state, target.elite.sequence
    planned = plan(
        simulation,
        state,
        target.goal,
        shipped_transition_graph(planner.graph),
        planner,
        generator_of(target.seed),
        steps=search.longest - len(before),
    )
    if not planned.solved:
        return TargetPlan((), planned.spent)
    simulation.restore(state[None], [0])
    beads = np.zeros(len(planned.actions), dtype=np.int16)
    forces = np.zeros((len(planned.actions), 3), dtype=np.float32)
    for step, action in enumerate(planned.actions):
        (beads[step],), force = simulation.read_actions(action[None], [0])
        forces[step] = force[0] / rope.config.max_force
        step_ropes(simulation, beads[[step]], forces[[step]], [0])
    end, sequence = simulation.states([0])[0], before + ActionSequence(beads, forces)
    shown = readings(simulation.points[0], Limits(), search.rope)
    elites = tuple(reading.elite(sequence, end) for reading in shown)
    return TargetPlan(elites, planned.spent + len(beads))
