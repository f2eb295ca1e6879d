"""The expert's table as the guide of the planner of pulls: distances to a goal, and macro-actions.

The table says how likely passes lead from a diagram to a goal. The planner of pulls knows codes
alone, so a code stands for that of its diagrams from which the chance is highest. Chances multiply
along a way, so minus their logarithms add up, as distances do. A code from which no way is known
counts as farther than all from which one is, and the farther the more crossings differ.

After a change run `pytest tests/control/planning/test_guidance.py`: images of a code and goal must
be equally far; then as `planners` says.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import islice

import numpy as np

from knotgym.control.planning.passes import PassValues
from knotgym.control.planning.sights import first_goal, see
from knotgym.rope import Array, MacroAction
from knotgym.topology import GaussCode, images

# Tried at tie nx 3 in the chain, 64 episodes, all solved: 544 pulls simulated for an episode; 685
# with 20 passes for the second, 735 with twice the third. A first of 1 would never leave a code for
# which the table knows only passes that fail.
_GUIDED = 0.8  # share of macro-actions that are passes of the table, where it has any
_BEST = 8  # passes of a rope that are drawn from, by what they are worth
_UNIT = 10.0  # distance at which the chance to reach the goal is 1 / e
# Where no way is known, only the order counts: what codes of so many crossings are farther by.
_STRANGE = 30.0
_GOALS_KEPT = 128  # goals whose distances are kept, a megabyte or two each


class Guide:
    """Distances from codes to one goal, and macro-actions towards it."""

    def __init__(self, values: PassValues, goal: GaussCode) -> None:
        """Take the table and a goal, which is compared without chirality."""
        self._values, self._goal = values, goal
        first, self._image = first_goal(goal)
        chances = values.chances(first)
        self._best = dict[GaussCode, float]()
        for node, index in values.moves.index.items():
            self._best[node.code] = max(self._best.get(node.code, 0.0), float(chances[index]))
        known = [chance for chance in self._best.values() if chance > 0]
        self._farthest = _UNIT * -math.log(min(known, default=1.0))

    def distance(self, code: GaussCode) -> float:
        """The distance from a code with chirality to the goal, at least 0."""
        chance = self._chance(code)
        if chance:
            return _UNIT * -math.log(chance)
        return self._farthest + _STRANGE * max(1, abs(code.nx - self._goal.nx))

    def hops(self, code: GaussCode) -> int | None:
        """About how many passes lead to the goal, if each works half the time; None if unknown."""
        chance = self._chance(code)
        if chance == 1.0:
            return 0
        return max(1, round(-math.log2(chance))) if chance else None

    def propose(self, points: Array, rng: np.random.Generator) -> MacroAction:
        """Draw a macro-action for a rope: like one of the table's passes, or any.

        Args:
            points: float64 (beads, 3), metres: where the rope lies.
            rng: source of all draws.
        """
        if rng.random() < _GUIDED:
            (sight,) = see(points[None])
            found = [*islice(self._values.passes(self._goal, sight), _BEST)]
            if found:
                move, _ = found[drawn_index(np.array([worth for _, worth in found]), rng)]
                return MacroAction.passing(points, move, rng)
        return MacroAction.drawn(points, rng)

    def _chance(self, code: GaussCode) -> float:
        """The chance to reach the goal; 0 if none is known, 1 if the code is the goal's."""
        if code.matches(self._goal):
            return 1.0
        return self._best.get(images(code)[self._image], 0.0)


@lru_cache(maxsize=_GOALS_KEPT)
def guide_to(goal: GaussCode, values: PassValues) -> Guide:
    """The guide to a goal, which is given without chirality."""
    return Guide(values, goal)


def drawn_index(weights: Array, rng: np.random.Generator) -> int:
    """Draw an index with probability proportional to its weight."""
    # `Generator.choice` draws the same index from the same number of the stream, but its checks of
    # the arguments take far longer.
    shares = (weights / weights.sum()).cumsum()
    # divided again, as `choice` does: rounding may leave the last sum a little off 1
    return int((shares / shares[-1]).searchsorted(rng.random(), side="right"))
