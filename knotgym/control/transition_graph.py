"""How far a code is from a goal, in macro-actions: shortest paths over counted changes of codes.

A change that one macro-action in n makes costs n macro-actions, and more where few were tried. The
distances of all codes to a goal come from Dijkstra's algorithm, run backwards from the goal; a code
that the counts don't reach is as far as the last one reached and farther by its crossings.

Counts reach to four crossings, and some way into five. For goals and ropes beyond, Reidemeister's
single moves, which every code has, go on where the counts end, each at the cost that its like has
among those counted: backwards from the goal at the search, and down from a code when it is met.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.configuration import check_numbers
from knotgym.control.diagram_moves import DOWN_COST, below, leading_to
from knotgym.control.transition_counts import ELEMENTS, MacroTemplate, TransitionCounts
from knotgym.topology.diagrams import chiralities
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import canonical_form, images

TRANSITIONS = Path(str(files("knotgym.control") / "data" / "transitions.h5"))  # that ships
_IMAGES = len(ELEMENTS)  # of a code
_COUNTED_NX = 4  # codes of more crossings are led to by single moves too
_MOST_MOVED = 1000  # codes that moves leading to them are looked for, for one goal, nearest first
_FARTHEST_DOWN = 3  # crossings more than goal and counts have, from which moves down are looked for
_GOALS_KEPT = 128  # whose distances are remembered; a megabyte or two each


@dataclass(frozen=True, kw_only=True)
class TransitionGraphConfig:
    """How counts become distances.

    Attributes:
        doubt: failures added to those counted: a change seen in two of three macro-actions isn't
            taken at its word.
        strange: macro-actions that a crossing too many or too few costs where nothing is known.
    """

    doubt: float = 30.0
    strange: float = 30.0

    def __post_init__(self) -> None:
        check_numbers(self, non_negative=("doubt", "strange"))


class Step(NamedTuple):
    """A change of code that leads towards a goal.

    Attributes:
        after: the code it shows.
        chance: that a random macro-action makes it.
        gain: macro-actions that it saves.
        examples: templates of its class.
        image: the symmetry element between the two, a place in `ELEMENTS`.
        arcs: of the code set out from.
    """

    after: GaussCode
    chance: float
    gain: float
    examples: list[MacroTemplate]
    image: int
    arcs: int

    @property
    def templates(self) -> tuple[MacroTemplate, ...]:
        """The examples, as they go for this change."""
        return tuple(self.template(number) for number in range(len(self.examples)))

    def template(self, number: int) -> MacroTemplate:
        """One of them."""
        return self.examples[number].transformed(ELEMENTS[self.image], self.arcs)


@dataclass
class Distances:
    """Macro-actions to one goal.

    Attributes:
        nx: its crossings.
        goals: the codes with chirality that show it.
        strange: as of the graph's configuration.
        far: code -> expected macro-actions, for the codes known; where single moves go on, those
            asked for are put in.
        hops: code -> changes of code on the way.
        beyond: what codes not in `far` are at least away.
        by_place: float64, the distances of all the graph's codes, in its own order.
        by_moves: single moves go on where counts end.
        moved: code -> steps that single moves are.
    """

    nx: int
    goals: frozenset[GaussCode]
    strange: float
    far: dict[GaussCode, float] = field(default_factory=dict)
    hops: dict[GaussCode, int] = field(default_factory=dict)
    beyond: float = 0.0
    by_place: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    by_moves: bool = False
    moved: dict[GaussCode, list[Step]] = field(default_factory=dict)

    def __call__(self, code: GaussCode) -> float:
        """Expected macro-actions from a code with chirality."""
        far = self.far.get(code)
        return self._unknown(code) if far is None else far

    def _unknown(self, code: GaussCode) -> float:
        far = self.beyond + self.strange * max(1, abs(code.nx - self.nx))
        if self.by_moves and code.nx <= max(self.nx, _COUNTED_NX) + _FARTHEST_DOWN:
            hops = None
            for lower in below(code):
                if self(lower) + DOWN_COST < far:
                    far, hops = self(lower) + DOWN_COST, self.hops.get(lower)
            self.far[code] = far
            if hops is not None:
                self.hops[code] = hops + 1
        return far


class TransitionGraph:
    """The graph of codes that transitions make, every symmetry used.

    A code's images stand together, so that image k of the code at place p is at p ^ k; a code that
    is its own image has several places, of which the first counts (`_first`).
    """

    def __init__(self, transitions: TransitionCounts, config: TransitionGraphConfig) -> None:
        self._transitions, self._config = transitions, config
        self._codes: list[GaussCode] = []  # by place
        self._place: dict[GaussCode, int] = {}  # the first
        keys = list(transitions.seen)
        before = np.array([self._placed(key[0]) for key in keys], dtype=np.int64)
        after = np.array([self._placed(key[1]) for key in keys], dtype=np.int64)
        chance = np.array(
            [
                seen / (transitions.tried[key[0]] + config.doubt)
                for key, seen in transitions.seen.items()
            ],
            dtype=np.float64,
        )
        self._first = np.array([self._place[code] for code in self._codes], dtype=np.int64)
        self._nx = np.array([code.nx for code in self._codes], dtype=np.int64)
        # class -> changes out of it: keys, places of the codes shown, chances
        rows: dict[GaussCode, list[int]] = {}
        for row, key in enumerate(keys):
            rows.setdefault(key[0], []).append(row)
        self._out = {
            code: ([keys[row] for row in own], after[own], chance[own].tolist())
            for code, own in rows.items()
        }
        self._leading = self._leading_to(before, after, chance)
        self._known: dict[tuple[GaussCode, bool], Distances] = {}

    def distances(self, goal: GaussCode, start: GaussCode | None = None) -> Distances:
        """Distances of all codes to a goal, whose chirality is left open.

        They take about a twelfth of a second, with single moves a third, and are kept for a while.

        Args:
            goal: compared without chirality.
            start: the code of the rope; single moves count too where it has more than five
                crossings, or the goal more than four.
        """
        by_moves = goal.nx > _COUNTED_NX or (start is not None and start.nx > _COUNTED_NX + 1)
        key = goal.plain, by_moves
        if key not in self._known:
            if len(self._known) >= _GOALS_KEPT:
                del self._known[next(iter(self._known))]
            self._known[key] = self._search(goal.plain, by_moves)
        return self._known[key]

    def steps(self, code: GaussCode, distances: Distances) -> list[Step]:
        """Changes out of a code that lead nearer to the goal, for a rope that shows this code.

        Args:
            code: with chirality.
            distances: to the goal, of this graph.
        """
        base = canonical_form(code)
        towards = distances.moved.get(code, [])
        if base not in self._out:
            return towards
        towards = towards.copy()
        here, arcs = distances(code), 2 * code.nx + 1
        keys, shown, chances = self._out[base]
        for image, member in enumerate(images(code)):
            if member != base:
                continue
            places = self._first[shown ^ image]
            far = distances.by_place[places]
            for change in np.flatnonzero(far < here - 1e-9).tolist():
                after, gain = self._codes[places[change]], here - float(far[change])
                examples = self._transitions.templates[keys[change]]
                towards.append(Step(after, chances[change], gain, examples, image, arcs))
        return towards

    def _placed(self, code: GaussCode) -> int:
        """A code's first place; a new one's class is given places."""
        if code not in self._place:
            for image in images(code):
                self._place.setdefault(image, len(self._codes))
                self._codes.append(image)
        return self._place[code]

    def _leading_to(
        self, before: NDArray[np.int64], after: NDArray[np.int64], chance: NDArray[np.float64]
    ) -> dict[int, list[tuple[int, float]]]:
        """Place of a code -> places from which a change leads to it, and the change's cost.

        They come in the order of the first change counted between the two.
        """
        element = np.arange(_IMAGES)
        target = self._first[after[:, None] ^ element].reshape(-1)
        origin = self._first[before[:, None] ^ element].reshape(-1)
        pair, first, which = np.unique(
            target * len(self._codes) + origin, return_index=True, return_inverse=True
        )
        best = np.zeros(len(pair))
        np.maximum.at(best, which, np.repeat(chance, _IMAGES))
        leading: dict[int, list[tuple[int, float]]] = {}
        order = np.argsort(first)
        for to, start, likely in zip(
            target[first][order].tolist(),
            origin[first][order].tolist(),
            best[order].tolist(),
            strict=True,
        ):
            leading.setdefault(to, []).append((start, 1 / likely))
        return leading

    def _search(self, goal: GaussCode, by_moves: bool) -> Distances:
        goals = frozenset(GaussCode(goal.visits, letters) for letters in chiralities(goal))
        distances = Distances(goal.nx, goals, self._config.strange, by_moves=by_moves)
        queue: list[tuple[float, int, int, int]] = []  # distance, tie, hops, place
        codes, new = self._codes.copy(), dict[GaussCode, int]()  # what the counts don't have

        def place_of(code: GaussCode) -> int:
            place = self._place.get(code, new.get(code))
            if place is None:
                place = new[code] = len(codes)
                codes.append(code)
            return place

        for code in sorted(goals, key=lambda code: code.chiral):
            queue.append((0.0, len(queue), 0, place_of(code)))
        nearest = {place: far for far, _, _, place in queue}
        ties, moved = len(queue), 0
        while queue:
            far, _, hops, place = heapq.heappop(queue)
            code = codes[place]
            if code in distances.far:
                continue
            distances.far[code], distances.hops[code], distances.beyond = far, hops, far
            leading = self._leading.get(place, [])
            if by_moves and code.nx > _COUNTED_NX and moved < _MOST_MOVED:
                moved += 1
                leading = leading.copy()
                for before, cost, templates in leading_to(code):
                    leading.append((place_of(before), cost))
                    if templates:
                        step = Step(code, 1 / cost, cost, templates, 0, 2 * before.nx + 1)
                        distances.moved.setdefault(before, []).append(step)
            for start, cost in leading:
                if far + cost < nearest.get(start, math.inf):
                    nearest[start] = far + cost
                    heapq.heappush(queue, (far + cost, ties, hops + 1, start))
                    ties += 1
        for before, steps in distances.moved.items():
            here = distances.far[before]
            nearer = [step._replace(gain=here - distances.far[step.after]) for step in steps]
            distances.moved[before] = [step for step in nearer if step.gain > 1e-9]
        by_place = np.array([nearest.get(place, math.inf) for place in range(len(self._codes))])
        by_place = by_place[self._first]
        strange = distances.beyond + self._config.strange * np.maximum(
            1, np.abs(self._nx - goal.nx)
        )
        distances.by_place = np.where(np.isfinite(by_place), by_place, strange)
        return distances


@lru_cache(maxsize=4)
def shipped_transition_graph(config: TransitionGraphConfig) -> TransitionGraph:
    """The graph of the counts that come with the package; an empty one if they were left out."""
    counts = TransitionCounts.load(TRANSITIONS) if TRANSITIONS.is_file() else TransitionCounts()
    return TransitionGraph(counts, config)
