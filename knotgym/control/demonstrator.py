"""The demonstrator: the same state and goal, the same macro-action.

At a state it goes through the passes that lead nearer to the goal, in one order for the diagram and
the goal (`pass_counts`), and takes the first that begins a way to the goal. Ways are found in the
chain engine, depth first, with the rope at rest at every look. Each pass is acted out until its
end, the goal, or LONGEST pulls; then it looks again. So what it does is a function of where
the rope lies, which a network can learn; `planner` is a better player and a worse teacher.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from knotgym.common.configuration import check_numbers
from knotgym.control.macro_lanes import Outcome, Search, Trial
from knotgym.control.pass_counts import DiagramValues, PassChoice, templates
from knotgym.control.seen_diagrams import SeenDiagram, seen_diagram
from knotgym.control.transition_counts import ArcCoordinates
from knotgym.rope.macro_actions import LONGEST, MacroActionConfig, Pass
from knotgym.rope.model import Array
from knotgym.topology.crossings import find_crossings
from knotgym.topology.gauss import GaussCode


@dataclass(frozen=True, kw_only=True)
class DemonstratorConfig:
    """Settings of the demonstrator.

    Attributes:
        candidates: passes tried at a state, at most.
        budget: actions simulated for a look, at most.
        steps: actions of a way, at most.
        macro_actions: settings of the passes.
    """

    candidates: int = 12
    budget: int = 2000
    steps: int = 50
    macro_actions: MacroActionConfig = MacroActionConfig()

    def __post_init__(self) -> None:
        check_numbers(self, counts=("candidates", "budget", "steps"))


class Decision(NamedTuple):
    """A pass on the way to a goal.

    Attributes:
        points: float64 (beads, 3), metres: where the rope lay at rest.
        code: with chirality.
        move: the pass.
        rank: how many passes were tried there, this one included.
        pulls: actions that it took.
    """

    points: Array
    code: GaussCode
    move: Pass
    rank: int
    pulls: int


@dataclass(eq=False)
class _Look:
    """A search from one state.

    Attributes:
        values: order of the passes.
        goal: compared without chirality.
        config: settings.
        spent: actions simulated.
    """

    values: DiagramValues
    goal: GaussCode
    config: DemonstratorConfig
    spent: int = 0
    failed: set[tuple[GaussCode, Pass]] = field(default_factory=set)

    def way(self, state: Array, points: Array, steps: int) -> Search[list[Decision] | None]:
        """Find the first way to the goal, depth first; None if there is none within the limits."""
        crossings = find_crossings(points)
        diagram = seen_diagram(points, crossings)
        here = self.values.reach(self.goal, diagram)
        arcs = ArcCoordinates(crossings, len(points))
        for rank, (move, _) in enumerate(self._passes(diagram, arcs, len(points)), 1):
            if rank > self.config.candidates or self.spent >= self.config.budget:
                return None
            outcome: Outcome = yield Trial(state, move, self.goal, min(LONGEST, steps))
            self.spent += outcome.pulls
            decision = Decision(points, diagram.code, move, rank, outcome.pulls)
            if outcome.code.matches(self.goal):
                return [decision]
            left = steps - outcome.pulls
            if left > 0 and outcome.code != diagram.code:
                there = seen_diagram(outcome.points, find_crossings(outcome.points))
                if self.values.reach(self.goal, there) > here:
                    rest = yield from self.way(outcome.state, outcome.points, left)
                    if rest is not None:
                        return [decision, *rest]
        return None

    def _passes(
        self, diagram: SeenDiagram, arcs: ArcCoordinates, beads: int
    ) -> Iterator[tuple[Pass, PassChoice]]:
        """Yield the passes in their order, each once."""
        known: set[Pass] = set()
        for choice in self.values.order(self.goal, diagram):
            template = templates(diagram.nx)[choice.template]
            move = template.on(arcs, choice.element, diagram.nx, beads)
            if move not in known and move.bead != move.target:
                known.add(move)
                yield move, choice


def find_way(
    values: DiagramValues, goal: GaussCode, config: DemonstratorConfig, state: Array, points: Array
) -> Search[tuple[list[Decision] | None, int]]:
    """Search for the demonstrator's way from a state at rest; see `MacroLanes.run`.

    Returns:
        The decisions on the way, None if none was found; and the actions simulated.
    """
    look = _Look(values, goal, config)
    way = yield from look.way(state, points, config.steps)
    return way, look.spent
