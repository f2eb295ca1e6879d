"""Guidance: choose a macro-action that is likely to lead a rope towards the goal code.

Several candidates are drawn, some of them modelled on macro-actions that made a useful change of
code before. The one whose surrogate rollout comes nearest to the goal is chosen.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from knotgym.control.planner_config import PlannerConfig
from knotgym.control.surrogate import surrogate_rollout
from knotgym.control.transition_counts import ArcCoordinates, MacroTemplate
from knotgym.control.transition_graph import Distances, Step, TransitionGraph
from knotgym.rope.macro_actions import (
    MacroAction,
    cumulative_shares,
    move_aside,
    pass_strand,
    propose,
)
from knotgym.rope.model import Array
from knotgym.topology.crossings import find_crossings, label_many
from knotgym.topology.gauss import GaussCode

# (code at the start, code nearest to the goal in the surrogate rollout) -> times chosen for it
Promises = Counter[tuple[GaussCode, GaussCode]]


class Towards:
    """Changes of a code that lead nearer to the goal, drawn by chance times gain."""

    def __init__(self, steps: list[Step]) -> None:
        self.steps = steps
        # the expected gain of a random macro-action through this change
        weights = np.array([step.chance * step.gain for step in steps])
        self._shares = cumulative_shares(weights) if steps else weights

    def draw(self, rng: np.random.Generator) -> MacroTemplate:
        """Draw a change, then one of its templates."""
        step = self.steps[int(self._shares.searchsorted(rng.random(), side="right"))]
        return step.template(int(rng.integers(len(step.examples))))


def promising(
    points: Array,
    graph: TransitionGraph,
    distances: Distances,
    config: PlannerConfig,
    rng: np.random.Generator,
) -> MacroAction:
    """Choose a macro-action for a rope at `points`, float64 (beads, 3), without a planner."""
    code = find_crossings(points).code
    steps = Towards(graph.steps(code, distances))
    return most_promising(points, code, steps, distances, config, rng, Counter())


def most_promising(
    points: Array,
    code: GaussCode,
    towards: Towards,
    distances: Distances,
    config: PlannerConfig,
    rng: np.random.Generator,
    promises: Promises,
) -> MacroAction:
    """Draw macro-actions and choose the one whose surrogate rollout gains most on the goal.

    Every second candidate follows a template. A predicted change of code counts
    less the more often it was chosen before, for surrogate rollouts are often wrong.

    Args:
        points: float64 (beads, 3), metres.
        code: Gauss code of the rope at `points`.
        towards: useful changes of that code.
        distances: to the goal.
        config: number of candidates, and settings of macro-actions and rollouts.
        rng: source of all draws.
        promises: predictions chosen so far; the choice is added.
    """
    arcs = ArcCoordinates(find_crossings(points), len(points))
    here, best, promise, chosen = distances(code), -np.inf, code, None
    for number in range(config.surrogate_rollouts):
        # the random half finds changes that no template makes, and works without any counts
        if towards.steps and number % 2 == 0:
            template = towards.draw(rng)
            macro_action = _from_template(points, template, arcs, config, rng)
        else:
            macro_action = propose(points, rng, config.macro_actions)
        # the whole way counts, not only its end: the planner keeps every state with a new code
        frames = surrogate_rollout(
            points, macro_action, config.macro_actions.arrived, config.surrogate
        )
        nearest = min(label_many(frames), key=distances)
        # halved once the same prediction was chosen `trust` times
        gain = (here - distances(nearest)) / (1 + promises[code, nearest] / config.trust)
        if gain > best:
            best, promise, chosen = gain, nearest, macro_action
    assert chosen is not None  # there is at least one candidate, and distances are finite
    promises[code, promise] += 1
    return chosen


def _from_template(
    points: Array,
    template: MacroTemplate,
    arcs: ArcCoordinates,
    config: PlannerConfig,
    rng: np.random.Generator,
) -> MacroAction:
    """Apply a template to a rope, with noise on its positions along the arcs."""

    def bead(position: float) -> int:
        # the noise keeps within the arc: another arc would be another change of the code
        along = np.clip(position % 1.0 + rng.normal(0, config.template_noise), 0.0, 0.999)
        return arcs.bead(int(position) + float(along))

    kind, side, led = template.kind, template.side, bead(template.bead)
    if template.target >= 0:  # a pass or curl; spreads and shifts have no target
        target = bead(template.target)
        return pass_strand(points, kind, led, target, side, rng, config.macro_actions)
    return move_aside(points, kind, led, side, rng, config.macro_actions)
