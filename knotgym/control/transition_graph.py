"""Distances from codes to a goal, in macro-actions: shortest paths over counted changes of code.

A change that was seen in s of t macro-actions costs (t + doubt) / s macro-actions. Dijkstra's
algorithm, run backwards from the goal, gives the distances of all codes; a code that it doesn't
reach counts as farther than the last one that it does, by an amount that grows with the difference
in crossings.

The counts cover codes of up to four crossings and some of five. For goals and ropes beyond that,
single Reidemeister moves extend the graph, each at the average cost of its kind (`diagram_moves`):
backwards from the goal during the search, and downwards from a code when it is looked up.
"""

import heapq
import math
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import NonNegative, configuration
from knotgym.control.diagram_moves import DOWN_COST, below, leading_to
from knotgym.control.transition_counts import ELEMENTS, MacroTemplate, TransitionCounts
from knotgym.topology.diagrams import chiralities
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import canonical_form, images

TRANSITIONS = Path(str(files("knotgym.control") / "data" / "transitions.h5"))  # that ships
_IMAGES = len(ELEMENTS)  # images of a code
_COUNTED_NX = 4  # the counts are complete up to here; codes with more crossings use moves too
_MOST_MOVED = 1000  # most codes per goal that are expanded by single moves, nearest first
_FARTHEST_DOWN = 3  # moves down are tried from codes with at most this many crossings too many
_GOALS_KEPT = 128  # goals whose distances are cached; one or two megabytes each


@configuration
class TransitionGraphConfig:
    """How counts become distances.

    Attributes:
        doubt: failures added to those counted, so that a change seen in two of three macro-actions
            doesn't pass for likely.
        strange: cost in macro-actions of each crossing too many or too few where no path is known.
    """

    doubt: NonNegative = 30.0
    strange: NonNegative = 30.0


class Step(NamedTuple):
    """A change of code that leads nearer to a goal.

    Attributes:
        after: the code after the change.
        chance: probability that a random macro-action makes the change.
        gain: by how many macro-actions the distance to the goal falls.
        examples: templates of the change, for the canonical form of the code before it.
        image: index into ELEMENTS of the symmetry from that form to the code before the change.
        arcs: number of arcs of the code before the change.
    """

    after: GaussCode
    chance: float
    gain: float
    examples: list[MacroTemplate]
    image: int
    arcs: int

    def template(self, number: int) -> MacroTemplate:
        """Example `number`, transformed to apply to the code before the change."""
        return self.examples[number].transformed(ELEMENTS[self.image], self.arcs)


@dataclass
class Distances:
    """Distances to one goal.

    Attributes:
        nx: crossings of the goal.
        goals: the codes with chirality that count as the goal.
        strange: as in the graph's configuration.
        far: code -> expected macro-actions; with `by_moves`, codes are added as they are looked up.
        hops: code -> changes of code on the shortest path.
        beyond: lower bound on the distance of codes that aren't in `far`.
        by_index: float64, distances of the graph's codes in the graph's order.
        by_moves: whether single moves extend the counts.
        moved: code -> single moves from it that lead nearer to the goal.
    """

    nx: int
    goals: frozenset[GaussCode]
    strange: float
    far: dict[GaussCode, float] = field(default_factory=dict)
    hops: dict[GaussCode, int] = field(default_factory=dict)
    beyond: float = 0.0
    by_index: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    by_moves: bool = False
    moved: dict[GaussCode, list[Step]] = field(default_factory=dict)

    def __call__(self, code: GaussCode) -> float:
        """Expected number of macro-actions from a code with chirality to the goal."""
        far = self.far.get(code)
        return self._unknown(code) if far is None else far

    def _unknown(self, code: GaussCode) -> float:
        far = self.beyond + self.strange * max(1, abs(code.nx - self.nx))
        # Removing crossings one move at a time ends at codes that the search has reached. The
        # recursion ends because every move lowers the number of crossings; `far` memoizes it.
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
    """Graph of codes with the counted changes as edges, extended to all images by symmetry.

    The images of a code are stored as one block of eight, so image k of the code at index i is at
    i ^ k: blocks begin at multiples of eight, and the elements compose by xor. A code that is its
    own image appears several times in its block; only the first index is used (`_first`).
    """

    def __init__(self, transitions: TransitionCounts, config: TransitionGraphConfig) -> None:
        self._transitions, self._config = transitions, config
        self._codes: list[GaussCode] = []
        self._index: dict[GaussCode, int] = {}  # the first index of each code
        keys = list(transitions.seen)
        before = np.array([self._add(key[0]) for key in keys], dtype=np.int64)
        after = np.array([self._add(key[1]) for key in keys], dtype=np.int64)
        # estimated probabilities, shrunk towards 0 by `doubt` failures that weren't seen
        chance = np.array(
            [
                seen / (transitions.tried[key[0]] + config.doubt)
                for key, seen in transitions.seen.items()
            ],
            dtype=np.float64,
        )
        self._first = np.array([self._index[code] for code in self._codes], dtype=np.int64)
        self._nx = np.array([code.nx for code in self._codes], dtype=np.int64)
        # class -> changes out of it: keys, indices of the codes after, probabilities
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
        """Distances of all codes to a goal.

        A search takes about 0.08 s, or 0.3 s with single moves; recent ones are cached.

        Args:
            goal: compared without chirality.
            start: code of the rope. Single moves are used if it has more than five crossings, or
                the goal more than four.
        """
        by_moves = goal.nx > _COUNTED_NX or (start is not None and start.nx > _COUNTED_NX + 1)
        key = goal.plain, by_moves
        if key not in self._known:
            if len(self._known) >= _GOALS_KEPT:  # drop the oldest
                del self._known[next(iter(self._known))]
            self._known[key] = self._search(goal.plain, by_moves)
        return self._known[key]

    def steps(self, code: GaussCode, distances: Distances) -> list[Step]:
        """List the changes of a code that lead nearer to the goal.

        Args:
            code: with chirality.
            distances: of this graph to the goal.
        """
        base = canonical_form(code)
        towards = distances.moved.get(code, [])
        if base not in self._out:
            return towards
        towards = towards.copy()
        # Changes are stored for the canonical form. Each element that maps it to the code maps its
        # changes to changes of the code; a code with symmetries has several such elements.
        here, arcs = distances(code), 2 * code.nx + 1
        keys, shown, chances = self._out[base]
        for image, member in enumerate(images(code)):
            if member != base:
                continue
            indices = self._first[shown ^ image]
            far = distances.by_index[indices]
            # the tolerance keeps out changes between codes at the same distance
            for change in np.flatnonzero(far < here - 1e-9).tolist():
                after, gain = self._codes[indices[change]], here - float(far[change])
                examples = self._transitions.templates[keys[change]]
                towards.append(Step(after, chances[change], gain, examples, image, arcs))
        return towards

    def _add(self, code: GaussCode) -> int:
        """Return the first index of a code; add a new code with all its images."""
        if code not in self._index:
            for image in images(code):
                self._index.setdefault(image, len(self._codes))
                self._codes.append(image)
        return self._index[code]

    def _leading_to(
        self, before: NDArray[np.int64], after: NDArray[np.int64], chance: NDArray[np.float64]
    ) -> dict[int, list[tuple[int, float]]]:
        """Reverse edges: index of a code -> (index of a code before it, cost of the change).

        Edges are in the order in which their first change was counted, which decides ties in the
        search.
        """
        # Every counted change gives eight edges, one per image: (before, after) ^ k.
        element = np.arange(_IMAGES)
        target = self._first[after[:, None] ^ element].reshape(-1)
        origin = self._first[before[:, None] ^ element].reshape(-1)
        # Images coincide for codes with symmetries: of parallel edges the likeliest is kept. A pair
        # of indices is packed into one integer for np.unique.
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
        """Dijkstra's algorithm, backwards from all codes with chirality that show the goal."""
        goals = frozenset(GaussCode(goal.visits, letters) for letters in chiralities(goal))
        distances = Distances(goal.nx, goals, self._config.strange, by_moves=by_moves)
        queue: list[tuple[float, int, int, int]] = []  # distance, tie breaker, hops, index
        # codes that only single moves reach are numbered after the graph's own, for this goal alone
        codes, new = self._codes.copy(), dict[GaussCode, int]()

        def index_of(code: GaussCode) -> int:
            index = self._index.get(code, new.get(code))
            if index is None:
                index = new[code] = len(codes)
                codes.append(code)
            return index

        for code in sorted(goals, key=lambda code: code.chiral):
            queue.append((0.0, len(queue), 0, index_of(code)))
        nearest = {index: far for far, _, _, index in queue}  # upper bounds so far
        ties, moved = len(queue), 0
        while queue:
            far, _, hops, index = heapq.heappop(queue)
            code = codes[index]
            if code in distances.far:  # an outdated entry: the code was settled at less
                continue
            distances.far[code], distances.hops[code], distances.beyond = far, hops, far
            leading = self._leading.get(index, [])
            if by_moves and code.nx > _COUNTED_NX and moved < _MOST_MOVED:
                moved += 1
                leading = leading.copy()
                for before, cost, templates in leading_to(code):
                    leading.append((index_of(before), cost))
                    # the gain is known only when both ends are settled, and is set below
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
        by_index = np.array([nearest.get(index, math.inf) for index in range(len(self._codes))])
        by_index = by_index[self._first]
        # codes that weren't reached, as in Distances.__call__
        strange = distances.beyond + self._config.strange * np.maximum(
            1, np.abs(self._nx - goal.nx)
        )
        distances.by_index = np.where(np.isfinite(by_index), by_index, strange)
        return distances


@lru_cache(maxsize=4)
def shipped_transition_graph(config: TransitionGraphConfig) -> TransitionGraph:
    """The graph of the counts that ship with the package; an empty one if the file is missing."""
    counts = TransitionCounts.load(TRANSITIONS) if TRANSITIONS.is_file() else TransitionCounts()
    return TransitionGraph(counts, config)
