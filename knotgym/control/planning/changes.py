"""Changes of code by macro-actions: distances to a goal, and which changes lead nearer to it.

A change that was seen in s of t macro-actions costs (t + doubt) / s macro-actions: it is tried
until it succeeds. Distances are shortest paths, which `Moves.values` computes; a code that none
reaches counts as farther than the last one that is reached, by an amount that grows with the
difference in crossings.

The table that ships covers codes of up to four crossings and some of five. For goals and ropes
beyond that, single Reidemeister moves extend it, nearest to the goal first. Their costs are one
over the mean rate at which macro-actions from codes of four crossings make such a move in the table
(three crossings for a finger), with the same doubt: 1.9 % for adding a kink (R1), 1.2 % for a
finger laid over an arc (R2), 4.5 % and 5.1 % for undoing them, 2.1 % for a third move (R3) and
2.2 % for a move of the base point.

After a change run `pytest tests/control/planning/test_changes.py`: distances from the plain loop
must be those that were counted; then as `planners` says.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from functools import cache, lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Column, Schema
from knotgym.control.planning.moves import MoveRow, Moves
from knotgym.control.planning.passes import DATA
from knotgym.control.planning.sights import Diagram, see
from knotgym.rope import Array, MacroAction, cumulative_shares, move_aside, pass_strand, propose
from knotgym.topology import (
    REVERSE,
    SWITCH,
    GaussCode,
    canonical,
    chiralities,
    images,
    removals,
    sideways,
)

CHANGES = DATA / "changes.h5"  # the table that ships
EXAMPLES = Schema(
    "examples",
    (
        Column("before", "int32", doc="as in `outcomes`"),
        Column("label", "int32", doc="as in `outcomes`: which change"),
        Column("side", "int8", doc="+1 over a strand or upwards, -1 under or downwards, 0 neither"),
        Column("bead", "float16", doc="position of the bead: arc plus fraction"),
        Column("target", "float16", doc="position of the strand to pass; -1: none, -2: outwards"),
    ),
    row="a macro-action that made a change of code",
)  # fmt: skip

# failures added to those counted, so that two of three doesn't pass for likely; not measured
DOUBT = 30.0
# macro-actions that R1 and R2 take that add crossings, either of them undone, and other moves
KINK_COST, FINGER_COST, DOWN_COST, SIDEWAYS_COST = 54.0, 83.0, 21.0, 47.0
# Set by hand when the planner was written; no record says what others gave. What must hold after a
# change is in `planners`.
GUIDED = 0.8  # share of macro-actions that imitate counted ones, where there are any
TEMPLATE_NOISE = 0.1  # standard deviation of an imitated macro-action's positions, in arcs
STRANGE = 30.0  # macro-actions that a crossing too many or too few counts for, if no path is known
_SPOTS = (0.2, 0.5, 0.8)  # fractions of an arc at which examples of single moves place their beads
_COUNTED_NX = 4  # the table is complete up to here; codes with more crossings use single moves
_MOST_MOVED = 1000  # most codes for a goal to which single moves lead, nearest first
_FARTHEST_DOWN = 3  # moves down are tried from codes with at most this many crossings too many
_NEW = 1 << 20  # labels of single moves begin here
_GOALS_KEPT = 128  # goals whose distances are kept, a megabyte or two each


class Example(NamedTuple):
    """A macro-action in terms of a diagram.

    Attributes:
        side: +1 over the strand or upwards, -1 under it or downwards, 0 for neither.
        bead: position of the bead, see `diagrams`.
        target: position of the strand to pass; -1 to lead the bead in any direction, -2 away from
            the rope's middle.
    """

    side: int
    bead: float
    target: float

    def image(self, number: int, arcs: int) -> Example:
        """The macro-action for the image of a rope whose diagram has so many arcs."""
        side, bead, target = self
        if number & REVERSE:  # position 0 and position `arcs` are both the base bead
            bead, target = arcs - bead, arcs - target if target >= 0 else target
        return Example(-side if number & SWITCH else side, bead, target)


class Change(NamedTuple):
    """A change of code that leads nearer to a goal.

    Attributes:
        promise: its chance, times the macro-actions that it gains.
        examples: for the canonical form of the code before it.
        image: the symmetry from that form to the code.
    """

    promise: float
    examples: list[Example]
    image: int


Examples = dict[tuple[Diagram, int], list[Example]]  # by node and label


class Guide:
    """Distances to any goal."""

    def __init__(self, moves: Moves, examples: Examples) -> None:
        """Take a table of changes, whose nodes are codes, with their examples."""
        self.moves, self.examples = moves, examples
        self._known: dict[tuple[GaussCode, bool], Distances] = {}

    def to(self, goal: GaussCode, start: GaussCode) -> Distances:
        """Distances to a goal.

        Args:
            goal: compared without chirality.
            start: code of the rope. Single moves are used if it has more than five crossings, or
                the goal more than four.
        """
        # whether single moves are needed is part of the key, as they make other distances of a goal
        key = goal.plain, goal.nx > _COUNTED_NX or start.nx > _COUNTED_NX + 1
        if key not in self._known:
            if len(self._known) >= _GOALS_KEPT:  # drop the oldest
                del self._known[next(iter(self._known))]
            self._known[key] = Distances(self, *key)
        return self._known[key]


class Distances:
    """Distances from codes to one goal, in macro-actions."""

    def __init__(self, guide: Guide, goal: GaussCode, single_moves: bool) -> None:
        self._goal, self._single_moves = goal, single_moves
        self._moves, self._examples = guide.moves, guide.examples
        self._values = self._solve()
        done, moved = set[GaussCode](), 0  # codes to which single moves lead; how many were nearest
        while single_moves and (near := self._nearest(done)[: _MOST_MOVED - moved]):
            moved += len(near)
            # what leads to one of a code's images stands for what leads to all of them
            # one of each class of images, in order of distance
            codes = [*dict.fromkeys(map(canonical, near))]
            done.update(image for code in codes for image in images(code))
            rows, examples = _single_moves(codes, _NEW + len(self._moves.rows))
            self._moves, self._examples = self._moves.extended(rows), self._examples | examples
            self._values = self._solve()
        moves = self._moves
        # hops: the same values with a reward of -1 for the moves of shortest paths alone
        tight = [
            np.where(self._values[a] - 1 / self._chance == self._values[b], -1.0, -math.inf)
            for a, b in zip(moves.after, moves.before, strict=True)
        ]
        self._hops = -moves.values(self._shown, tight, np.ones(len(moves.rows)), 1000)
        known = np.isfinite(self._values)
        self._beyond = float(-self._values[known].min()) if known.any() else 0.0
        far_away = self._far_away(np.array(moves.nx, np.int64))
        self._values = np.where(known, self._values, -far_away)
        self._down: dict[GaussCode, tuple[float, int | None]] = {}

    def __call__(self, code: GaussCode) -> float:
        """Expected number of macro-actions from a code with chirality to the goal."""
        return self._look_up(code)[0]

    def hops(self, code: GaussCode) -> int | None:
        """Changes of code on the shortest path; None if none is known."""
        return self._look_up(code)[1]

    def nearer(self, code: GaussCode) -> list[Change]:
        """List the changes of a code that lead nearer to the goal."""
        found, here, moves = list[Change](), -self(code), self._moves
        # Changes are stored for one of a code's images, single moves for others. The symmetry that
        # maps that image to the code maps its changes to those of the code. A code with symmetries
        # of its own has several.
        for k, member in enumerate(images(code)):
            own, outcomes = moves.of(Diagram(member))
            there = self._values[moves.after[k][outcomes]]
            # the tolerance keeps out changes between codes at the same distance
            for n in np.flatnonzero(there > here + 1e-9).tolist():
                examples = self._examples.get((Diagram(member), int(moves.label[own.start + n])))
                if examples:
                    promise = float(self._chance[outcomes.start + n] * (there[n] - here))
                    found.append(Change(promise, examples, k))
        return found

    def _solve(self) -> Array:
        """Distances by node, negative, with the moves so far."""
        moves = self._moves
        self._chance = moves.seen / (moves.tried + DOUBT)
        self._shown = moves.shown(self._goal, 0.0, -math.inf)
        sure = np.ones(len(self._chance))
        return moves.values(self._shown, -1 / self._chance, sure, 1000)

    def _nearest(self, done: set[GaussCode]) -> list[GaussCode]:
        """The codes to which single moves should lead next: the goal's, then the nearest.

        All that are about as far as the nearest are taken at once: no single move from one of them
        can shorten the distance of another.
        """
        goals = [GaussCode(self._goal.visits, letters) for letters in chiralities(self._goal)]
        left = {
            node.code: -float(self._values[index])
            for node, index in self._moves.index.items()
            if self._moves.nx[index] > _COUNTED_NX and node.code not in done
        }
        left |= {code: 0.0 for code in goals if code.nx > _COUNTED_NX and code not in done}
        most = min(left.values(), default=math.inf) + SIDEWAYS_COST
        return sorted((code for code, far in left.items() if far < most), key=lambda one: left[one])

    def _look_up(self, code: GaussCode) -> tuple[float, int | None]:
        if code.matches(self._goal):
            return 0.0, 0
        index = self._moves.index.get(Diagram(code))
        if index is not None and math.isfinite(self._hops[index]):
            return -float(self._values[index]), int(self._hops[index])
        if code not in self._down:
            found: tuple[float, int | None] = float(self._far_away(np.array(code.nx))), None
            # every move lowers the number of crossings, so this ends
            if self._single_moves and code.nx <= max(self._goal.nx, _COUNTED_NX) + _FARTHEST_DOWN:
                for lower in _below(code):
                    far, hops = self._look_up(lower)
                    if far + DOWN_COST < found[0]:
                        found = far + DOWN_COST, None if hops is None else hops + 1
            self._down[code] = found
        return self._down[code]

    def _far_away(self, nx: NDArray[np.int64]) -> Array:
        return self._beyond + STRANGE * np.maximum(1, np.abs(nx - self._goal.nx))


class Proposals:
    """Draws macro-actions for ropes of one code that lead nearer to a goal."""

    def __init__(self, changes: list[Change]) -> None:
        self._changes = changes
        weights = np.array([change.promise for change in changes])
        self._shares = cumulative_shares(weights) if changes else weights

    def draw(self, points: Array, rng: np.random.Generator) -> MacroAction:
        """Draw a change by its promise, and a macro-action like one that made it.

        Args:
            points: float64 (beads, 3), metres: where the rope lies.
            rng: source of all draws.
        """
        if not self._changes or rng.random() >= GUIDED:
            return propose(points, rng)
        # a change by its promise, then any of the macro-actions that made it
        change = self._changes[int(self._shares.searchsorted(rng.random(), side="right"))]
        (sight,) = see(points[None])
        example = change.examples[int(rng.integers(len(change.examples)))]
        side, at, past = example.image(change.image, 2 * sight.diagram.nx + 1)

        def bead(position: float) -> int:
            # the noise keeps within the arc: another arc would be another change of the code
            along = np.clip(position % 1.0 + rng.normal(0, TEMPLATE_NOISE), 0.0, 0.999)
            return sight.bead(int(position) + float(along))

        led = bead(at)
        if past >= 0:
            return pass_strand(points, led, bead(past), side, rng)
        return move_aside(points, "shift" if past == -1 else "spread", led, side, rng)


@cache
def shipped_guide() -> Guide:
    """Return the guide by the table that ships."""
    moves, (table,) = Moves.load(CHANGES, EXAMPLES)
    examples = defaultdict[tuple[Diagram, int], list[Example]](list)
    columns = (column.tolist() for column in table.values())
    for before, label, *example in zip(*columns, strict=True):
        examples[moves.nodes[before], label].append(Example(*example))
    return Guide(moves, dict(examples))


def _single_moves(codes: list[GaussCode], label: int) -> tuple[list[MoveRow], Examples]:
    """Rows of single moves that lead to codes, numbered from `label`, as if each was seen once."""
    rows, examples = list[MoveRow](), Examples()
    for code in codes:
        for number, (before, cost, known) in enumerate(_leading_to(code), label + len(rows)):
            # in as many tries as give this cost
            rows.append(MoveRow(Diagram(before), number, Diagram(code), 1, round(cost - DOUBT)))
            examples[Diagram(before), number] = known
    return rows, examples


def _leading_to(code: GaussCode) -> Iterator[tuple[GaussCode, float, list[Example]]]:
    """Yield the codes with at most as many crossings from which a single move leads to `code`.

    Beside each stand its cost and examples; there are none for codes with equally many crossings.
    """
    # a move that adds crossings is found as one that removes them, run backwards
    for move in removals(code):
        cost = KINK_COST if move.kink else FINGER_COST
        yield move.code, cost, _examples(move.over, move.under)
    for before in sideways(code):
        yield before, SIDEWAYS_COST, []


@lru_cache(maxsize=50_000)
def _below(code: GaussCode) -> tuple[GaussCode, ...]:
    """Codes with fewer crossings that one move leads to, without repetitions."""
    return tuple(dict.fromkeys(move.code for move in removals(code)))


@lru_cache(maxsize=4096)
def _examples(over: int, under: int) -> list[Example]:
    """Examples that lead a bead of one arc past the other; past its own arc for a kink.

    `over` and `under` are the arcs that become the upper and the lower strand. Either one may move:
    the upper over the lower, or the lower under the upper.
    """
    found = [
        example
        for at, past in product(_SPOTS, repeat=2)
        for example in (Example(1, over + at, under + past), Example(-1, under + at, over + past))
    ]
    # within a kink's single arc the two may coincide
    return [example for example in found if example.bead != example.target]
