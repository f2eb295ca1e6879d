"""Guidance: draw macro-actions that made a useful change of code before.

Half of them, or so, are modelled on counted ones; the rest are random, which finds changes that
no template makes.
"""

import numpy as np

from knotgym.control.planner_config import PlannerConfig
from knotgym.control.transition_counts import ArcCoordinates, MacroTemplate
from knotgym.control.transition_graph import Step
from knotgym.rope.macro_actions import (
    MacroAction,
    cumulative_shares,
    move_aside,
    pass_strand,
    propose,
)
from knotgym.rope.model import Array
from knotgym.topology.crossings import find_crossings


class Towards:
    """Changes of a code that lead nearer to the goal, drawn by chance times gain."""

    def __init__(self, steps: list[Step]) -> None:
        self._steps = steps
        # the expected gain of a random macro-action through this change
        weights = np.array([step.chance * step.gain for step in steps])
        self._shares = cumulative_shares(weights) if steps else weights

    def propose(
        self, points: Array, config: PlannerConfig, rng: np.random.Generator
    ) -> MacroAction:
        """Draw a macro-action for a rope of the code at `points`, float64 (beads, 3), metres."""
        if not self._steps or rng.random() >= config.guided:
            return propose(points, rng, config.macro_actions)
        step = self._steps[int(self._shares.searchsorted(rng.random(), side="right"))]
        template = step.template(int(rng.integers(len(step.examples))))
        return _from_template(points, template, config, rng)


def _from_template(
    points: Array, template: MacroTemplate, config: PlannerConfig, rng: np.random.Generator
) -> MacroAction:
    """Apply a template to a rope, with noise on its positions along the arcs."""
    arcs = ArcCoordinates(find_crossings(points), len(points))

    def bead(position: float) -> int:
        # the noise keeps within the arc: another arc would be another change of the code
        along = np.clip(position % 1.0 + rng.normal(0, config.template_noise), 0.0, 0.999)
        return arcs.bead(int(position) + float(along))

    kind, side, led = template.kind, template.side, bead(template.bead)
    if template.target >= 0:  # a pass or curl; spreads and shifts have no target
        target = bead(template.target)
        return pass_strand(points, kind, led, target, side, rng, config.macro_actions)
    return move_aside(points, kind, led, side, rng, config.macro_actions)
