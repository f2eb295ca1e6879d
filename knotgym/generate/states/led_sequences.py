"""Led sequences: the demonstrator leads ropes from known states to a code, several side by side.

Each rope is led like an episode of the expert: a search simulates passes in the chain engine, the
first pass of the way found is acted out in the engine of the run, and then it searches again. What
the planner needs minutes for takes seconds where the counts of passes know a way.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from knotgym.control.action_sequence import NO_ACTIONS, ActionSequence, step_ropes
from knotgym.control.demonstrator import DemonstratorConfig, find_way
from knotgym.control.macro_lanes import MacroLanes
from knotgym.control.pass_counts import shipped_values
from knotgym.generate.states.archive import Elite
from knotgym.rope.macro_actions import LONGEST, WaypointController, pass_straight
from knotgym.rope.model import Array
from knotgym.rope.simulation import Simulation
from knotgym.topology.crossings import label_many
from knotgym.topology.gauss import GaussCode

# called with a code without chirality, a sequence to it and the integration state there
Met = Callable[[GaussCode, ActionSequence, Array], object]

_SEARCHING = DemonstratorConfig(budget=800)


@dataclass(frozen=True, eq=False)
class LedRope:
    """A rope to lead.

    Attributes:
        elite: the known state that it starts from.
        goal: the code to lead it to, without chirality.
    """

    elite: Elite
    goal: GaussCode


def lead(ropes: Simulation, starts: Sequence[LedRope], longest: int, met: Met) -> int:
    """Lead ropes to their goals until one is there or all are stuck.

    Args:
        ropes: one rope of the run's engine for each start; overwritten.
        starts: where they start, and their goals.
        longest: most actions of a sequence, with those that led to its start.
        met: called after every action; the sequence is that of the start and the actions since.

    Returns:
        The number of simulated actions, of both engines.
    """
    values, spent = shipped_values(every_code=True), 0
    lanes = MacroLanes(len(starts), _SEARCHING.macro_actions, ropes.rope)
    controller = WaypointController(len(starts), _SEARCHING.macro_actions)
    ropes.restore(np.stack([start.elite.state for start in starts]))
    pulls = [NO_ACTIONS] * len(starts)
    left = [longest - len(start.elite.sequence) for start in starts]
    able = [rope for rope in range(len(starts)) if left[rope] > 0]
    while able:
        states, points = lanes.at_rest(ropes.qpos(able))
        searches = [
            find_way(values, starts[rope].goal, replace(_SEARCHING, steps=left[rope]), *where)
            for rope, *where in zip(able, states, points, strict=True)
        ]
        found = dict(lanes.run(searches))
        spent += sum(one.spent for one in found.values())
        moves = {rope: found[row].way[0].move for row, rope in enumerate(able) if found[row].way}
        for rope, move in moves.items():
            at = ropes.points[rope]
            controller.begin(rope, pass_straight(at, *move, _SEARCHING.macro_actions), at)
        able, before = list(moves), left.copy()
        for _ in range(LONGEST):
            controller.advance(ropes.points)
            able = [rope for rope in able if left[rope] > 0]
            pulled = [rope for rope in able if not controller.idle[rope]]
            if not pulled:
                break
            beads = controller.beads[pulled].astype(np.int16)
            forces = controller.forces(ropes.points)[pulled].astype(np.float32)
            _, stable = step_ropes(ropes, beads, forces, np.array(pulled))
            spent += len(pulled)
            codes = label_many(ropes.points[pulled])
            for row, rope in enumerate(pulled):
                if not stable[row]:
                    able.remove(rope)
                    continue
                left[rope] -= 1
                pulls[rope] += ActionSequence(beads[[row]], forces[[row]])
                sequence = starts[rope].elite.sequence + pulls[rope]
                met(codes[row].plain, sequence, ropes.states([rope])[0])
                if codes[row].matches(starts[rope].goal):
                    return spent
        able = [rope for rope in able if left[rope] < before[rope]]
    return spent
