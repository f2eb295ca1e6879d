"""The table of moves, its file, and the one computation of values.

A move leads from a node to other nodes, each with a chance. A node is a diagram as seen from above.
A move is a pass in terms of a diagram, a `PassTemplate`. What is counted for a move holds for its
images under the eight symmetries, so the table holds every move once and stands for eight: nodes
are stored in blocks of their images, and image k of the node at index i is at i ^ k.

Values follow one equation, V(node) = max over its moves of the sum of weight * V(after), and V = 1
at the goal. With weight = discount * chance, V is the chance to arrive, discounted by moves.

After a change run `pytest tests/control/planning/test_moves.py`: chances must be those of brute
force.
"""

from __future__ import annotations

import itertools
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Column, InvalidFile, Schema, Table, read_tables, write_tables
from knotgym.control.planning.sights import IMAGES, Diagram, Sight
from knotgym.rope import Pass
from knotgym.topology import GaussCode, Symmetry

FORMAT, VERSION = "knotgym-moves", 2
NODES = Schema(
    "nodes",
    (
        Column("visits", "int8", ("visits",), doc="Gauss code: +label over, -label under, then 0"),
        Column("signs", "uint16", doc="bit k - 1 is set if crossing k is positive"),
        Column("outer", "uint32", doc="bit d is set if dart d has the outer face; 0 for any face"),
    ),
    row="a diagram; rows 8 i to 8 i + 7 are the images of one diagram",
)  # fmt: skip
MOVES = Schema(
    "moves",
    (
        Column("kind", "uint8", doc="what `target` is, a row of KINDS"),
        Column("bead", "int16", (), "0.01 arcs", "position of the bead that is led"),
        Column("target", "int16", (), "0.01 arcs", "of the strand to pass, or beads to it"),
        Column("side", "int8", doc="+1 over the strand, -1 under it"),
    ),
    row="a move of a diagram",
)  # fmt: skip
OUTCOMES = Schema(
    "outcomes",
    (
        Column("before", "int32", doc="row of `nodes` in which the move was made, divisible by 8"),
        Column("move", "int32", doc="row of `moves`"),
        Column("after", "int32", doc="row of `nodes` to which it led"),
        Column("seen", "int32", doc="how often it did"),
        Column("tried", "int32", doc="how often the move was made"),
    ),
    row="a node to which a move led; sorted by `before`, `move`, `after`",
)  # fmt: skip

_NAMES = [column.name for column in OUTCOMES.columns]
AT, ALONG = range(2)


class MoveKind(NamedTuple):
    """What the target of a move is.

    Attributes:
        bead: (target, bead, flip, sight) -> the bead that it means, where `bead` is the one that is
            led, and flip is 0, or 2 nx + 1 if the rope is walked backwards.
        reversed: (target, nx) -> the target of the same move, walked backwards.
    """

    bead: Callable[[int, int, int, Sight], int]
    reversed: Callable[[int, int], int]


# By the number that tables store, so rows are only appended. Walked backwards, what lay at position
# p along the 2 nx + 1 arcs lies at 2 nx + 1 - p; `abs`: with flip 0, the position itself is meant.
KINDS = (
    MoveKind(  # AT: the strand at a position
        lambda target, _, flip, sight: sight.bead(abs(flip - _arcs(target))),
        lambda target, nx: 100 * (2 * nx + 1) - target,
    ),
    MoveKind(  # ALONG: the strand so many beads from the one that is led
        lambda target, bead, flip, sight: (
            (bead + (-target if flip else target)) % int(sight.cuts[-1])
        ),
        lambda target, _: -target,
    ),
)

# An outcome: before, number of the move, after, how often it led there, how often it was made
MoveRow = tuple[Diagram, int, Diagram, int, int]


class PassTemplate(NamedTuple):
    """A pass in terms of a diagram.

    Attributes:
        kind: row of KINDS.
        bead: position of the bead in hundredths of an arc, of which each is a whole number.
        target: the strand to pass, as its kind says.
        side: +1 over the strand, -1 under it.
    """

    kind: int
    bead: int
    target: int
    side: int

    def on(self, sight: Sight, image: int) -> Pass:
        """Return the pass of a rope whose diagram is the image of the template's diagram."""
        flip = 2 * sight.diagram.nx + 1 if image & Symmetry.REVERSE else 0
        bead = sight.bead(abs(flip - _arcs(self.bead)))
        target = KINDS[self.kind].bead(self.target, bead, flip, sight)
        return Pass(bead, target, -self.side if image & Symmetry.SWITCH else self.side)

    def image(self, number: int, nx: int) -> PassTemplate:
        """The template of the image of a diagram of nx crossings."""
        kind, bead, target, side = self
        if number & Symmetry.REVERSE:
            bead, target = 100 * (2 * nx + 1) - bead, KINDS[kind].reversed(target, nx)
        return PassTemplate(kind, bead, target, -side if number & Symmetry.SWITCH else side)


class Moves:
    """The table.

    Attributes:
        templates: the moves, by number.
        nodes: in blocks of eight images; a node that is its own image appears several times.
        index: the first index of each node.
        rows: int64 (outcomes, 5), as in `OUTCOMES`; the outcomes of a move lie together.
        seen, tried: float64 by outcome.
        start: int64 by move, the first of its outcomes.
        number: int64 by move, its number.
        before, after: eight int64 arrays by outcome, one for each image.
    """

    def __init__(
        self, rows: Iterable[MoveRow] = (), templates: Iterable[Iterable[int]] = ()
    ) -> None:
        self.templates = [PassTemplate(*template) for template in templates]
        self.nodes: list[Diagram] = []
        self.index: dict[Diagram, int] = {}
        self._first: list[int] = []  # of each node, the first index of an equal one
        new = [(self._add(before), move, self._add(after), *n) for before, move, after, *n in rows]
        self._arrange(np.array(new, np.int64).reshape(-1, 5))

    @staticmethod
    @lru_cache
    def grid(nx: int) -> dict[PassTemplate, int]:
        """Return the passes that are counted at diagrams of nx crossings, and their numbers.

        On the plain loop the bead is one in twenty, and the strand some beads away. Otherwise they
        lie at a few fractions of any two arcs; or the strand is some beads away, which makes a
        kink.
        """
        places: list[tuple[int, int, int]] = []  # kind, bead, target
        fractions: tuple[int, ...]
        if nx == 0:
            for bead in range(5, 100, 5):
                for beads in (8, 11, 14, 18, 24, 32, 40, 50):
                    reached = (bead + beads, bead - beads)
                    places += [(AT, bead, end) for end in reached if 0 < end < 100]
        else:
            # the more arcs there are, the fewer places on each: they grow with the square
            fractions = {1: (20, 50, 80), 2: (25, 50, 75)}.get(nx, (30, 70))
            along = [100 * arc + part for arc in range(2 * nx + 1) for part in fractions]
            places = [(AT, bead, end) for bead in along for end in along if bead != end]
            fractions = (30, 70) if nx > 1 else (20, 35, 50, 65, 80)
            along = [100 * arc + part for arc in range(2 * nx + 1) for part in fractions]
            ends = (10, 14, 18, -10, -14, -18)
            places += [(ALONG, bead, beads) for bead in along for beads in ends]
        first = sum(len(Moves.grid(fewer)) for fewer in range(nx))
        made = [PassTemplate(*place, side) for place in places for side in (1, -1)]
        return {template: first + k for k, template in enumerate(made)}

    @classmethod
    def counted(cls, counts: Mapping[tuple[Diagram, int, Diagram | None], int]) -> Moves:
        """Make the table of what passes of `grid` led to.

        What is counted for a move holds for its image under every symmetry that leaves its node as
        it is; such a symmetry may exchange two of its moves.

        Args:
            counts: diagram before, which is the first of its images; number of the move; diagram
                after, None for any not of interest.
        """
        most = max((before.nx for before, _, _ in counts), default=0)
        templates = [template for nx in range(most + 1) for template in cls.grid(nx)]
        tried, seen = Counter[Any](), Counter[Any]()
        for (before, number, after), count in counts.items():
            for k in (k for k in range(IMAGES) if before.image(k) == before):
                there = cls.grid(before.nx)[templates[number].image(k, before.nx)]
                tried[before, there] += count
                if after is not None:
                    seen[before, there, after.image(k)] += count
        return cls(((*key, count, tried[key[:2]]) for key, count in seen.items()), templates)

    def shown(self, goal: GaussCode, there: float, elsewhere: float) -> Array:
        """A value for the nodes that show a code, chirality aside, and another for the rest."""
        values = np.full(len(self.nodes), elsewhere)
        values[self._showing.get(goal.visits, [])] = there
        return values

    def values(self, shown: Array, weight: Sequence[Array] | Array, sweeps: int) -> Array:
        """Solve V(node) = max of `shown` and, over its moves, the sum of weight * V(after).

        Args:
            shown: float64 by node, V without any move.
            weight: by outcome, or eight of them, one for each image; those of images under
                symmetries of `shown` must agree.
            sweeps: how often the equation is applied, at most; fewer times if it holds before.
        """
        # Symmetries that leave `shown` as it is leave all values as they are. So one image of each
        # class is computed, and the others are read off. Every goal has such a symmetry,
        # because a reflection changes only chirality.
        symmetries = [k for k in range(IMAGES) if (shown == shown[self._image[k]]).all()]
        first = [k for k in range(IMAGES) if k == min(k ^ symmetry for symmetry in symmetries)]
        values = shown
        for _ in range(sweeps if len(self.start) else 0):
            new = shown.copy()
            # Image k of an outcome leads from before[k] to after[k] with the same chance. Only the
            # images in `first` are summed; the loop below reads the others off.
            for k in first:
                chance = weight if isinstance(weight, np.ndarray) else weight[k]
                sums = np.add.reduceat(chance * values[self.after[k]], self.start)
                np.maximum.at(new, self.before[k][self.start], sums)
            # each class of images has one value: the largest that any of its members was given
            new = np.max([new[self._image[symmetry]] for symmetry in symmetries], axis=0)
            # Values only rise from sweep to sweep and depend on nothing else, so equal ones stay
            # for good.
            if (new == values).all():
                break
            values = new
        return values

    def of(self, node: Diagram) -> tuple[slice, slice]:
        """The moves of a node that is the first of its images, and their outcomes."""
        # Moves are stored with the first image alone, so another image, like a node that isn't
        # known, has none here.
        begin, end = self._moves.get(self.index.get(node, -1), (0, 0))
        if begin == end:
            return slice(0, 0), slice(0, 0)
        last = int(self.start[end]) if end < len(self.start) else len(self.rows)
        return slice(begin, end), slice(int(self.start[begin]), last)

    def nearer(self, values: Array, image: int, outcomes: slice = slice(None)) -> NDArray[np.bool_]:
        """Which outcomes, under a symmetry, lead to a node of higher value: bool by outcome."""
        before, after = self.before[image][outcomes], self.after[image][outcomes]
        return np.asarray(values[after] > values[before])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table, with those of its moves that have outcomes."""
        codes = [node.code for node in self.nodes]
        # rows are padded with 0, which is no visit, to the longest code
        visits = np.zeros((len(codes), 2 * max([code.nx for code in codes], default=0)), np.int8)
        for row, code in enumerate(codes):
            visits[row, : 2 * code.nx] = code.visits
        positive = [[k for k, sign in enumerate(code.signs) if sign > 0] for code in codes]
        nodes: dict[str, NDArray[Any]] = {
            "visits": visits,
            "signs": np.array([_bits(numbers) for numbers in positive], np.uint16),
            "outer": np.array([_bits(node.outer) for node in self.nodes], np.uint32),
        }
        used, numbers = np.unique(self.rows[:, 1], return_inverse=True)
        made = np.array([self.templates[k] for k in used.tolist()]).reshape(-1, len(MOVES.columns))
        moves = {c.name: v.astype(c.dtype) for c, v in zip(MOVES.columns, made.T, strict=True)}
        outcomes = dict(zip(_NAMES, self.rows.T.astype(np.int32), strict=True))
        outcomes["move"] = numbers.astype(np.int32)
        tables = Table(NODES, nodes), Table(MOVES, moves), Table(OUTCOMES, outcomes)
        write_tables(path, tables, {}, format=FORMAT, version=VERSION, pack=True)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Moves:
        """Read the table.

        Raises:
            MissingFile: the file doesn't exist.
            InvalidFile: it is corrupted or of another format.
        """
        (nodes, moves, outcomes), _ = read_tables(
            path, NODES, MOVES, OUTCOMES, format=FORMAT, version=VERSION
        )
        if (kind := int(moves["kind"].max(initial=0))) >= len(KINDS):
            raise InvalidFile(f"{path} has moves of kind {kind}, and KINDS here has {len(KINDS)}")
        made = zip(*(moves[column.name].tolist() for column in MOVES.columns), strict=True)
        table = cls(templates=made)
        columns = (nodes[name].tolist() for name in ("visits", "signs", "outer"))
        counts = (nodes["visits"] != 0).sum(axis=1).tolist()
        for count, visits, signs, outer in zip(counts, *columns, strict=True):
            letters = GaussCode.letters_of(signs >> k & 1 for k in range(count // 2))
            darts = tuple(d for d in range(max(2, 2 * count)) if outer >> d & 1)
            table._append(Diagram(GaussCode.trusted(tuple(visits[:count]), letters), darts))
        table._arrange(np.stack([outcomes[name] for name in _NAMES], axis=1).astype(np.int64))
        return table

    def _arrange(self, table: NDArray[np.int64]) -> None:
        """Take the outcomes, as in `rows`, of nodes that are there."""
        # sorted by before, move, after: the outcomes of a move lie together, as `reduceat` needs,
        # and the file is the same however the rows came
        self.rows = table = table[np.lexsort((table[:, 2], table[:, 1], table[:, 0]))]
        self.seen, self.tried = table[:, 3].astype(float), table[:, 4].astype(float)
        # one move of one node, packed into one number of 64 bits; numbers are below 2^32
        _, self.start = np.unique(table[:, 0] << 32 | table[:, 1], return_index=True)
        self.number, origins = table[self.start, 1], table[self.start, 0]
        first = np.array(self._first, np.int64)
        # Blocks of eight: flipping the last three bits of an index by k is applying symmetry k. A
        # node that equals one of its images has several indices. The first one is used for all.
        self._image = [first[np.arange(len(first)) ^ k] for k in range(IMAGES)]
        self.before = [first[table[:, 0] ^ k] for k in range(IMAGES)]
        self.after = [first[table[:, 2] ^ k] for k in range(IMAGES)]
        edges = [*np.flatnonzero(np.diff(origins, prepend=-1)).tolist(), len(origins)]
        self._moves = {int(origins[a]): (a, b) for a, b in itertools.pairwise(edges)}
        self._showing = defaultdict[tuple[int, ...], list[int]](list)
        for index, node in enumerate(self.nodes):
            self._showing[node.code.visits].append(index)

    def _add(self, node: Diagram) -> int:
        if node not in self.index:
            for k in range(IMAGES):
                self._append(node.image(k))
        return self.index[node]

    def _append(self, node: Diagram) -> None:
        self._first.append(self.index.setdefault(node, len(self.nodes)))
        self.nodes.append(node)


def _arcs(hundredths: int) -> float:
    # an arc plus a fraction, added as `Sight.bead` takes them apart: rounded the same everywhere
    return hundredths // 100 + hundredths % 100 / 100


def _bits(numbers: Iterable[int]) -> int:
    return sum(1 << number for number in numbers)
