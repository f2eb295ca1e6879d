"""Guidance: which macro-action promises to lead a rope towards the goal code.

Some are drawn, those that made a change towards the goal before among them, and the one whose
surrogate rollout comes nearest to the goal is taken.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from knotgym.control.macro_actions import (
    MacroAction,
    cumulative_shares,
    move_aside,
    pass_strand,
    propose,
)
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.surrogate import surrogate_rollout
from knotgym.control.transition_counts import MacroTemplate, Places
from knotgym.control.transition_graph import Distances, Step, TransitionGraph
from knotgym.rope.model import Array
from knotgym.topology.crossings import find_crossings, label_many
from knotgym.topology.gauss import GaussCode

# code set out from, nearest code in a surrogate rollout -> macro-actions chosen for it
Promises = Counter[tuple[GaussCode, GaussCode]]


class Towards:
    """Changes out of a code that lead nearer to the goal, and how often each shall be tried."""

    def __init__(self, steps: list[Step]) -> None:
        self.steps = steps
        weights = np.array([step.chance * step.gain for step in steps])
        self._shares = cumulative_shares(weights) if steps else weights

    def draw(self, rng: np.random.Generator) -> MacroTemplate:
        """A template of one of them."""
        step = self.steps[int(self._shares.searchsorted(rng.random(), side="right"))]
        return step.template(int(rng.integers(len(step.examples))))


def promising(
    points: Array,
    graph: TransitionGraph,
    distances: Distances,
    config: PlannerConfig,
    rng: np.random.Generator,
) -> MacroAction:
    """A macro-action that promises to lead towards the goal of `distances`."""
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
    """Of some macro-actions the one whose surrogate rollout comes nearest to the goal.

    Every second one follows a template that made a change towards the goal before. What a rollout
    promises counts the less the oftener a macro-action was chosen for the same promise; the choice
    is counted in `promises`.
    """
    places = Places(find_crossings(points), len(points))
    here, best, promise, chosen = distances(code), -np.inf, code, None
    for number in range(config.surrogate_rollouts):
        if towards.steps and number % 2 == 0:
            template = towards.draw(rng)
            macro_action = _from_template(points, template, places, config, rng)
        else:
            macro_action = propose(points, rng, config.macro_actions)
        frames = surrogate_rollout(
            points, macro_action, config.macro_actions.arrived, config.surrogate
        )
        nearest = min(label_many(frames), key=distances)
        gain = (here - distances(nearest)) / (1 + promises[code, nearest] / config.trust)
        if gain > best:
            best, promise, chosen = gain, nearest, macro_action
    assert chosen is not None  # there is at least one, and no distance is infinite
    promises[code, promise] += 1
    return chosen


def _from_template(
    points: Array,
    template: MacroTemplate,
    places: Places,
    config: PlannerConfig,
    rng: np.random.Generator,
) -> MacroAction:
    """The macro-action of a template on a rope, its places along the arcs varied a little."""

    def bead(place: float) -> int:
        along = np.clip(place % 1.0 + rng.normal(0, config.template_noise), 0.0, 0.999)
        return places.bead(int(place) + float(along))

    kind, side, led = template.kind, template.side, bead(template.bead)
    if template.target >= 0:
        target = bead(template.target)
        return pass_strand(points, kind, led, target, side, rng, config.macro_actions)
    return move_aside(points, kind, led, side, rng, config.macro_actions)
