"""The table of moves, its file, and the one computation of values.

A move leads from a node to other nodes, each with a chance. A node is a diagram as seen from above,
or a code alone. What is counted for a move holds for its images under the eight symmetries, so the
table holds every move once and stands for eight: nodes are stored in blocks of their images, and
image k of the node at index i is at i ^ k.

Values follow one equation, V(node) = max over its moves of (reward + sum of weight * V(after)):

- chance to arrive by passes: reward 0, weight = discount * chance, and V = 1 at the goal;
- distance: a change of code that is tried until it succeeds is a certain move that costs
  1 / chance macro-actions, so reward = -1 / chance, weight = 1, and V = 0 at the goal. This is the
  shortest path.

After a change run `pytest tests/control/planning/test_moves.py`: chances must be those of brute
force, and certain moves make shortest paths.
"""

from __future__ import annotations

import copy
import itertools
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Column, Schema, Table, read_tables, write_tables
from knotgym.control.planning.sights import IMAGES, Diagram
from knotgym.rope import Array
from knotgym.topology import NEGATIVE, POSITIVE, GaussCode, trusted_code

FORMAT = "knotgym-moves"
NODES = Schema(
    "nodes",
    (
        Column("visits", "int8", ("visits",), doc="Gauss code: +label over, -label under, then 0"),
        Column("signs", "uint16", doc="bit k - 1 is set if crossing k is positive"),
        Column("outer", "uint32", doc="bit d is set if dart d has the outer face; 0 for any face"),
    ),
    row="a diagram; rows 8 i to 8 i + 7 are the images of one diagram",
)  # fmt: skip
OUTCOMES = Schema(
    "outcomes",
    (
        Column("before", "int32", doc="row of `nodes` in which the move was made, divisible by 8"),
        Column("label", "int32", doc="the move: number of a pass template, or of a change of code"),
        Column("after", "int32", doc="row of `nodes` to which it led"),
        Column("seen", "int32", doc="how often it did"),
        Column("tried", "int32", doc="how often the move was made"),
    ),
    row="a node to which a move led; sorted by `before`, `label`, `after`",
)  # fmt: skip

_NAMES = [column.name for column in OUTCOMES.columns]


class MoveRow(NamedTuple):
    """An outcome: move `label` was made `tried` times at `before`, and led `seen` times there."""

    before: Diagram
    label: int
    after: Diagram
    seen: int
    tried: int


class Moves:
    """The table.

    Attributes:
        nodes: in blocks of eight images; a node that is its own image appears several times.
        index: the first index of each node.
        rows: int64 (outcomes, 5), as in `OUTCOMES`; the outcomes of a move lie together.
        seen, tried: float64 by outcome.
        start: int64 by move, the first of its outcomes.
        label: int64 by move.
        before, after: eight int64 arrays by outcome, one for each image.
    """

    def __init__(self, rows: Iterable[MoveRow] = ()) -> None:
        self.nodes: list[Diagram] = []
        self.index: dict[Diagram, int] = {}
        self.nx: list[int] = []
        self._first: list[int] = []  # of each node, the first index of an equal one
        self.rows = np.zeros((0, 5), np.int64)
        self._arrange(rows)

    def extended(self, rows: Iterable[MoveRow]) -> Moves:
        """Return a table with more rows; this one stays as it is."""
        more = copy.copy(self)
        more.nodes, more.index = self.nodes.copy(), self.index.copy()
        more.nx, more._first = self.nx.copy(), self._first.copy()
        more._arrange(rows)
        return more

    def shown(self, goal: GaussCode, there: float, elsewhere: float) -> Array:
        """A value for the nodes that show a code, chirality aside, and another for the rest."""
        values = np.full(len(self.nodes), elsewhere)
        values[self._showing.get(goal.visits, [])] = there
        return values

    def values(
        self,
        shown: Array,
        reward: float | Sequence[Array] | Array,
        weight: Sequence[Array] | Array,
        sweeps: int,
    ) -> Array:
        """Solve V(node) = max of `shown` and, over its moves, reward + sum of weight * V(after).

        Args:
            shown: float64 by node, V without any move.
            reward, weight: by move and by outcome, or eight of them, one for each image; those of
                images under symmetries of `shown` must agree.
            sweeps: how often the equation is applied, at most; fewer times if it holds before.
        """
        # Symmetries that leave `shown` as it is leave all values as they are. So one image of each
        # class is computed, and the others are read off. Every goal has such a symmetry,
        # because a reflection changes only chirality.
        own = [k for k in range(IMAGES) if (shown == shown[self._image[k]]).all()]
        first = [k for k in range(IMAGES) if k == min(k ^ one for one in own)]
        values = shown
        for _ in range(sweeps if len(self.start) else 0):
            new = shown.copy()
            # Image k of an outcome leads from before[k] to after[k] with the same chance. Only the
            # images in `first` are summed; the loop below reads the others off.
            for k in first:
                chance = weight if isinstance(weight, np.ndarray) else weight[k]
                paid = reward[k] if isinstance(reward, list) else reward
                sums = np.add.reduceat(chance * values[self.after[k]], self.start) + paid
                np.maximum.at(new, self.before[k][self.start], sums)
            # each class of images has one value: the largest that any of its members was given
            new = np.max([new[self._image[one]] for one in own], axis=0)
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

    def save(self, path: str | os.PathLike[str], *more: Table) -> None:
        """Write the table, and others that go with it."""
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
        outcomes = dict(zip(_NAMES, self.rows.T.astype(np.int32), strict=True))
        tables = Table(NODES, nodes), Table(OUTCOMES, outcomes)
        write_tables(path, [*tables, *more], {}, format=FORMAT, pack=True)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *more: Schema) -> tuple[Moves, list[Table]]:
        """Read the table, and others that go with it.

        Raises:
            MissingFile: the file doesn't exist.
            InvalidFile: it is corrupted or of another format.
        """
        (nodes, outcomes, *others), _ = read_tables(path, NODES, OUTCOMES, *more, format=FORMAT)
        table, columns = cls(), (nodes[name].tolist() for name in ("visits", "signs", "outer"))
        counts = (nodes["visits"] != 0).sum(axis=1).tolist()
        for count, visits, signs, outer in zip(counts, *columns, strict=True):
            letters = "".join(POSITIVE if signs >> k & 1 else NEGATIVE for k in range(count // 2))
            darts = tuple(d for d in range(max(2, 2 * count)) if outer >> d & 1)
            table._append(Diagram(trusted_code(tuple(visits[:count]), letters), darts))
        table.rows = np.stack([outcomes[name] for name in _NAMES], axis=1).astype(np.int64)
        table._arrange(())
        return table, others

    def _arrange(self, rows: Iterable[MoveRow]) -> None:
        new = [(self._add(row.before), row.label, self._add(row.after), *row[3:]) for row in rows]
        table = np.concatenate([self.rows, np.array(new, np.int64).reshape(-1, 5)])
        # sorted by before, label, after: the outcomes of a move lie together, as `reduceat` needs,
        # and the file is the same however the rows came
        self.rows = table = table[np.lexsort((table[:, 2], table[:, 1], table[:, 0]))]
        self.seen, self.tried = table[:, 3].astype(float), table[:, 4].astype(float)
        # a move is (before, label), packed into one number of 64 bits; labels are below 2^32
        _, self.start = np.unique(table[:, 0] << 32 | table[:, 1], return_index=True)
        self.label, origins = table[self.start, 1], table[self.start, 0]
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
        self.nx.append(node.nx)


def pooled(
    counts: Iterable[tuple[Diagram, int, Diagram | None, int]],
    image: Callable[[int, int, int], int],
) -> list[MoveRow]:
    """Make rows from counts, summed over each node's own symmetries.

    What is counted for a move holds for its image under every symmetry that leaves its node as it
    is.

    Args:
        counts: node, move, node after it (None for any that isn't of interest), how often.
        image: (nx, symmetry, move) -> the move's image.
    """
    tried = Counter[tuple[Diagram, int]]()
    outcomes = Counter[tuple[Diagram, int, Diagram]]()
    for before, label, after, seen in counts:
        for k in range(IMAGES):
            if before.image(k) == before:
                # a symmetry that leaves the node as it is may still exchange two of its moves
                there = image(before.nx, k, label)
                tried[before, there] += seen
                if after is not None:
                    outcomes[before, there, after.image(k)] += seen
    return [MoveRow(*key, seen, tried[key[:2]]) for key, seen in outcomes.items()]


def _bits(numbers: Iterable[int]) -> int:
    return sum(1 << number for number in numbers)
