"""The order of the passes at a diagram, and the search of the policy `expert`.

Play counted to which diagrams passes lead (`moves`), and values turn the counts into an order: at
the same diagram and goal always the same passes, the best first. The search goes through them depth
first, in the chain engine. It draws nothing at random, so the passes that it finds are a function
of the rope's state.

After a change run `pytest tests/control/planning/test_passes.py`: images of a state and goal must
have the same order, and the tables that ship say what was counted; then as `planners` says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from knotgym.common import Array
from knotgym.control.planning.batched_search import BatchedSearch, Report, Search
from knotgym.control.planning.moves import Moves
from knotgym.control.planning.sights import IMAGES, Diagram, Sight, first_goal
from knotgym.control.policy_config import PassPlannerConfig
from knotgym.rope import Pass, TowBound
from knotgym.states import SPLITS
from knotgym.topology import GaussCode

_DATA = Path(str(files("knotgym.control.planning") / "data"))

# Failures added to those counted, so that two of two doesn't pass for sure; and the discount of a
# pass, because fewer are better. Both were chosen by hand; others do as well: of 128 ties and
# conversions of nx 3, 115 succeed by passes alone, with a doubt of 1.5 or 6 117 or 118, with a
# discount of 0.94 117. Paths of so many passes count.
_DOUBT, _DISCOUNT, _SWEEPS = 3.0, 0.97, 16
_BOUNDED = 4  # times as many candidates where towing is limited: the order doesn't know what tows
_STEPS = 50  # pulls of a path to the goal, at most: the horizon of the tasks


class PassValues:
    """Chances to reach goals by passes, and from them the order of the passes at a diagram.

    A pass is worth the chance that it leads to a diagram of more worth, times what that is worth:
    then the best pass is the one by which, from here on, first choices are most likely right.
    `doubt` failures are added to those counted, and paths of up to `sweeps` passes count.
    """

    def __init__(self, moves: Moves, doubt: float = _DOUBT, sweeps: int = _SWEEPS) -> None:
        self.moves, self._sweeps = moves, sweeps
        # by outcome: seen of tried, as if `doubt` more tries had failed
        self._chance = _DISCOUNT * moves.seen / (moves.tried + doubt)
        self._values: dict[GaussCode, tuple[Array, Array]] = {}
        self._orders: dict[tuple[GaussCode, Diagram], list[tuple[int, float]]] = {}

    @staticmethod
    def table(split: str = "train", *, every_code: bool = False) -> Path:
        """Return the table that ships for a task's split.

        Args:
            split: splits by code have a table of their own, from play that met no start and no goal
                that is held out: nobody who is tested on them may know what `train` goals say.
            every_code: whether the table was counted towards every code of 2 to 4 crossings, or
                towards train goals alone; makes no difference to splits by code.
        """
        name = "passes-every-code" if every_code else "passes"
        return _DATA / f"{'passes-by-code' if SPLITS[split].by_code else name}.h5"

    @classmethod
    def of_split(cls, split: str = "train", *, every_code: bool = False) -> PassValues:
        """Return the values of the table that ships for a task's split; see `table`."""
        return _loaded(cls.table(split, every_code=every_code))

    def reach(self, goal: GaussCode, diagram: Diagram) -> float:
        """The chance to reach a goal from a diagram; 0 if the table doesn't know how."""
        first, image = first_goal(goal)
        index = self.moves.index.get(diagram.image(image))
        return 0.0 if index is None else float(self._of(first)[0][index])

    def chances(self, goal: GaussCode) -> Array:
        """The chance to reach a goal that is the first of its images, by node."""
        return self._of(goal)[0]

    def passes(self, goal: GaussCode, sight: Sight) -> Iterator[tuple[Pass, float]]:
        """Yield the passes that lead a rope nearer to a goal, the best first, each once.

        Beside each stands what it is worth, in (0, 1].
        """
        known = set[Pass]()
        for number, image, worth in self.order(goal, sight.diagram):
            # Several templates may name the same two beads where arcs are short; and both beads may
            # be the same.
            move = self.moves.templates[number].on(sight, image)
            if move not in known and move.bead != move.target:
                known.add(move)
                yield move, worth

    def order(self, goal: GaussCode, diagram: Diagram) -> Iterator[tuple[int, int, float]]:
        """Yield the numbers of the moves of a diagram that lead nearer to a goal, the best first.

        Beside each stand the symmetry that brings the diagram to its first image, for which moves
        are counted, and the worth of the move. The order is the same for every image of
        (diagram, goal).
        """
        first, seen_as = first_goal(goal)
        moved = diagram.image(seen_as)
        image = moved.canonical()[1]
        if (first, moved) not in self._orders:
            self._orders[first, moved] = self._ordered(first, moved, image)
        for number, worth in self._orders[first, moved]:
            yield number, seen_as ^ image, worth

    def _ordered(self, goal: GaussCode, diagram: Diagram, image: int) -> list[tuple[int, float]]:
        (reach, first), moves = self._of(goal), self.moves
        begun, outcomes = moves.of(diagram.image(image))
        if begun.start == begun.stop:
            return []
        worth = self._chance[outcomes] * first[moves.after[image][outcomes]]
        worth = np.where(moves.nearer(reach, image, outcomes), worth, 0.0)
        move = np.zeros(len(worth), np.int64)  # of each outcome
        move[moves.start[begun][1:] - outcomes.start] = 1
        sums = np.zeros(begun.stop - begun.start)
        np.add.at(sums, move.cumsum(), worth)
        # rounded, so that the order doesn't depend on how a machine adds
        sums = np.round(sums, 6)
        best = [k for k in np.argsort(-sums, kind="stable").tolist() if sums[k] > 0]
        return [(int(moves.number[begun.start + k]), float(sums[k])) for k in best]

    def _of(self, goal: GaussCode) -> tuple[Array, Array]:
        """By node, the chance to reach the goal; and that if only passes that raise it count."""
        if goal not in self._values:
            moves, chance, shown = self.moves, self._chance, self.moves.shown(goal, 1.0, 0.0)
            reach = moves.values(shown, chance, self._sweeps)
            nearer = [np.where(moves.nearer(reach, k), chance, 0.0) for k in range(IMAGES)]
            self._values[goal] = reach, moves.values(shown, nearer, self._sweeps)
        return self._values[goal]


@lru_cache(maxsize=3)
def _loaded(path: Path) -> PassValues:
    return PassValues(Moves.load(path))


ActOut = Callable[[Pass], tuple[Array, int]]


class TriedPass(NamedTuple):
    """A pass that a search simulated: where the rope lay, which pass, and where it led."""

    points: Array
    move: Pass
    landing: Report


class PassPlan(NamedTuple):
    """What a search of passes found.

    Attributes:
        passes: those that lead to the goal, one after another; empty if none were found.
        spent: pulls simulated.
        tried: all passes that were simulated, in this order, also where they led into dead ends.
    """

    passes: list[TriedPass]
    spent: int
    tried: list[TriedPass]


@dataclass(eq=False)
class PassSearch:
    """A search for the first passes that lead to a goal; see `BatchedSearch`. It takes one slot.

    Attributes:
        values: order of the passes.
        goal: compared without chirality.
        config: settings.
        bound: region in which the rope's centre must stay; None for no limit.
        act_out: carries a pass out in the engine that counts and returns the points (beads, 3) that
            it led to, and its pulls. The first pass must lead nearer to the goal there too. None
            where the chain engine is the one that counts.
        spent: pulls simulated so far.
        tried: passes simulated so far.
    """

    values: PassValues
    goal: GaussCode
    config: PassPlannerConfig
    bound: TowBound | None = None
    act_out: ActOut | None = None
    spent: int = 0
    tried: list[TriedPass] = field(default_factory=list)

    def run(self, state: Array, points: Array) -> Search[PassPlan]:
        """Search from a state of the chain engine, and its points (beads, 3)."""
        (sight,) = Sight.of(points[None])
        passes = yield from self._passes(state, points, sight, _STEPS, self.act_out)
        return PassPlan(passes, self.spent, self.tried)

    def _passes(
        self, state: Array, points: Array, sight: Sight, left: int, act_out: ActOut | None = None
    ) -> Search[list[TriedPass]]:
        here, goal = sight.diagram, self.goal
        chance = self.values.reach(goal, here)
        candidates = self.config.candidates * (1 if self.bound is None else _BOUNDED)
        for move, _ in islice(self.values.passes(goal, sight), candidates):
            if self.spent >= self.config.budget:
                break
            landing = yield from BatchedSearch.try_pass(state, move, goal, left, self.bound)
            self.spent += landing.pulls
            tried = TriedPass(points, move, landing)
            self.tried.append(tried)
            remaining, passes = left - landing.pulls, list[TriedPass]()
            # the goal may be shown before the pass is over, which then ends there
            if landing.code.matches(goal) and not landing.lost:
                passes = [tried]
            # Only diagrams nearer to the goal are followed, so a search never comes back to one.
            # All that can be done from this landing comes before the next pass from here.
            elif remaining > 0 and not landing.lost and landing.code != here.code:
                (there,) = Sight.of(landing.points[None])
                if self.values.reach(goal, there.diagram) > chance:
                    rest = yield from self._passes(landing.state, landing.points, there, remaining)
                    passes = [tried, *rest] if rest else []
            if passes and act_out is not None:
                landed, pulls = act_out(move)
                self.spent += pulls
                diagram = Sight.of(landed[None])[0].diagram
                if not diagram.code.matches(goal) and self.values.reach(goal, diagram) <= chance:
                    continue
            if passes:
                return passes
        return []
