"""How far a code is from a goal, in macro-actions: shortest paths over counted changes of codes.

A change that one macro-action in n makes costs n macro-actions, and more where few were tried. The
distances of all codes to a goal come from Dijkstra's algorithm, run backwards from the goal; a code
that the counts don't reach is as far as the last one reached and farther by its crossings.
"""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from knotgym.configuration import check_numbers
from knotgym.control.transition_counts import MacroTemplate, TransitionCounts, elements, transformed
from knotgym.topology.diagrams import chiralities
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import canonical_form


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
        templates: examples.
    """

    after: GaussCode
    chance: float
    gain: float
    templates: tuple[MacroTemplate, ...]


@dataclass
class Distances:
    """Macro-actions to one goal.

    Attributes:
        nx: its crossings.
        goals: the codes with chirality that show it.
        strange: as of the graph's configuration.
        far: code -> expected macro-actions, for the codes known.
        hops: code -> changes of code on the way.
        beyond: what codes not in `far` are at least away.
    """

    nx: int
    goals: frozenset[GaussCode]
    strange: float
    far: dict[GaussCode, float] = field(default_factory=dict)
    hops: dict[GaussCode, int] = field(default_factory=dict)
    beyond: float = 0.0

    def __call__(self, code: GaussCode) -> float:
        """Expected macro-actions from a code with chirality."""
        unknown = self.beyond + self.strange * max(1, abs(code.nx - self.nx))
        return self.far.get(code, unknown)


class TransitionGraph:
    """The graph of codes that transitions make, every symmetry used."""

    def __init__(self, transitions: TransitionCounts, config: TransitionGraphConfig) -> None:
        self._transitions, self._config = transitions, config
        # class -> changes out of it, with their chances
        self._after: dict[GaussCode, list[tuple[GaussCode, float]]] = {}
        # class shown -> changes that lead to it
        self._before: dict[GaussCode, list[tuple[GaussCode, GaussCode, float]]] = {}
        for (before, after), seen in transitions.seen.items():
            chance = seen / (transitions.tried[before] + config.doubt)
            self._after.setdefault(before, []).append((after, chance))
            self._before.setdefault(canonical_form(after), []).append((before, after, chance))
        self._known: dict[GaussCode, Distances] = {}
        self._backwards: dict[GaussCode, list[tuple[GaussCode, float]]] = {}

    def distances(self, goal: GaussCode) -> Distances:
        """Distances of all codes to a goal, whose chirality is left open.

        They take about a sixth of a second, the first a second, and are kept.
        """
        if goal.plain not in self._known:
            self._known[goal.plain] = self._search(goal.plain)
        return self._known[goal.plain]

    def steps(self, code: GaussCode, distances: Distances) -> list[Step]:
        """Changes out of a code that lead nearer to the goal, for a rope that shows this code."""
        towards = []
        base, here, arcs = canonical_form(code), distances(code), 2 * code.nx + 1
        for element in elements(code):
            for shown, chance in self._after.get(base, []):
                after = transformed(shown, element)
                if distances(after) < here - 1e-9:
                    templates = tuple(
                        template.transformed(element, arcs)
                        for template in self._transitions.templates[base, shown]
                    )
                    towards.append(Step(after, chance, here - distances(after), templates))
        return towards

    def _search(self, goal: GaussCode) -> Distances:
        goals = frozenset(GaussCode(goal.visits, letters) for letters in chiralities(goal))
        distances = Distances(goal.nx, goals, self._config.strange)
        ties = itertools.count()
        queue: list[tuple[float, int, int, GaussCode]] = [
            (0.0, next(ties), 0, code) for code in sorted(goals, key=lambda code: code.chiral)
        ]
        while queue:
            far, _, hops, code = heapq.heappop(queue)
            if code in distances.far:
                continue
            distances.far[code], distances.hops[code], distances.beyond = far, hops, far
            for before, chance in self._leading_to(code):
                if before not in distances.far:
                    heapq.heappush(queue, (far + 1 / chance, next(ties), hops + 1, before))
        return distances

    def _leading_to(self, code: GaussCode) -> list[tuple[GaussCode, float]]:
        """Codes from which a change leads to this one, with its chance."""
        if code in self._backwards:
            return self._backwards[code]
        best: dict[GaussCode, float] = {}
        for before, after, chance in self._before.get(canonical_form(code), []):
            for shown, origin in zip(_images(after), _images(before), strict=True):
                if shown == code:
                    best[origin] = max(best.get(origin, 0.0), chance)
        self._backwards[code] = list(best.items())
        return self._backwards[code]


@lru_cache(maxsize=20_000)
def _images(code: GaussCode) -> tuple[GaussCode, ...]:
    """What a rope that shows a code shows after each symmetry element, eight codes, some twice."""
    walked = (code, code.reversed())
    switched = [one for way in walked for one in (way, way.mirrored())]
    return tuple([one for image in switched for one in (image, image.reflected())])


@lru_cache(maxsize=4)
def shipped_transition_graph(config: TransitionGraphConfig) -> TransitionGraph:
    """The graph of the counts that come with the package; an empty one if they were left out."""
    path = Path(str(files("knotgym.control") / "data" / "transitions.h5"))
    counts = TransitionCounts.load(path) if path.is_file() else TransitionCounts()
    return TransitionGraph(counts, config)
