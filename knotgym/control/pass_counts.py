"""What passes do to diagrams: counts, and from them the fixed order of the demonstrator.

A *pass template* is a pass in terms of a diagram: where along its arcs the bead and the strand to
pass lie. Every diagram of so many crossings has the same templates (`templates`), so a diagram, a
template's number and a goal are a choice. Play in the chain engine counts which diagram follows;
`DiagramValues` turns the counts into a choice.

Counts don't know of goals. They are kept up to symmetry: the diagram before a pass is brought to
the first of its images, and the same symmetry is applied to the diagram after it.
"""

from __future__ import annotations

import itertools
import os
from collections import Counter
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write
from knotgym.common.errors import InvalidFile
from knotgym.common.hdf5_files import Column, opened_hdf5, read_attribute
from knotgym.control.seen_diagrams import SeenDiagram, canonical_image
from knotgym.control.transition_counts import ELEMENTS, ArcCoordinates, content_digest, read_columns
from knotgym.rope.macro_actions import Pass
from knotgym.states.split_names import CODE_SPLITS
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import images

_DATA = Path(str(files("knotgym.control") / "data"))
# the files that ship, by the split whose starts and goals were played; nobody who is tested on
# codes held out may know what `train` goals say about them
PASSES = {"train": _DATA / "passes.h5", "train-code": _DATA / "passes-by-code.h5"}
# counted towards every code of 2 to 4 crossings; the split by state holds out no code
EVERY_CODE = _DATA / "passes-every-code.h5"
FORMAT, FORMAT_VERSION = "knotgym-passes", 1
COUNTED_NX = 5  # most crossings of the diagrams that are counted
NOWHERE = -1  # in place of a diagram: the code didn't change, or has too many crossings

_DIGEST = "content_sha256"
_COLUMNS = (
    Column("diagrams", "uint8", (None,)),
    Column("before", "int32", ("outcomes",), least=0),
    Column("template", "int16", ("outcomes",), least=0),
    Column("after", "int32", ("outcomes",), least=NOWHERE),
    Column("seen", "int32", ("outcomes",), least=1),
)


class PassTemplate(NamedTuple):
    """A pass in terms of a diagram.

    Attributes:
        bead: position of the bead, the arc plus the fraction along it, see `transition_counts`.
        target: position of the strand to pass.
        apart: beads from the bead to the strand, instead of `target`; 0 for `target`.
        side: +1 over the strand, -1 under it.
    """

    bead: float
    target: float
    apart: int
    side: int

    def on(self, arcs: ArcCoordinates, element: int, nx: int, beads: int) -> Pass:
        """Return the pass of a rope whose diagram is image `element` of the template's diagram."""
        reverse, switch, _ = ELEMENTS[element]
        flip = 2 * nx + 1 if reverse else 0
        # Walked backwards, what lay at position p along the 2 nx + 1 arcs lies at 2 nx + 1 - p.
        bead = arcs.bead(abs(flip - self.bead))
        if self.apart:
            target = (bead + (-self.apart if reverse else self.apart)) % beads
        else:
            target = arcs.bead(abs(flip - self.target))
        return Pass(bead, target, -self.side if switch else self.side)


class PassChoice(NamedTuple):
    """A pass to choose at a diagram.

    Attributes:
        template: number of the template.
        element: number of the symmetry element that brings the diagram to its first image, to
            which templates apply.
        value: see `DiagramValues`.
    """

    template: int
    element: int
    value: float = 0.0


@lru_cache
def templates(nx: int) -> tuple[PassTemplate, ...]:
    """List the templates of the diagrams of nx crossings; their numbers are stored.

    On the plain loop the bead is one in twenty, and the strand some beads away. Otherwise they lie
    at a few fractions of any two arcs; or the strand is some beads away, which makes a kink.
    """
    places: list[tuple[float, float, int]] = []
    fractions: tuple[float, ...]
    if nx == 0:
        for bead in range(5, 100, 5):
            for apart in (8, 11, 14, 18, 24, 32, 40, 50):
                reached = [bead + apart, bead - apart]
                places += [(bead / 100, end / 100, 0) for end in reached if 0 < end < 100]
    else:
        # The more arcs there are, the fewer places on each: templates grow with the square.
        fractions = {1: (0.2, 0.5, 0.8), 2: (0.25, 0.5, 0.75)}.get(nx, (0.3, 0.7))
        along = [arc + part for arc in range(2 * nx + 1) for part in fractions]
        places = [(bead, end, 0) for bead in along for end in along if bead != end]
        fractions = (0.3, 0.7) if nx > 1 else (0.2, 0.35, 0.5, 0.65, 0.8)
        along = [arc + part for arc in range(2 * nx + 1) for part in fractions]
        places += [(bead, 0.0, apart) for bead in along for apart in (10, 14, 18, -10, -14, -18)]
    return tuple(PassTemplate(*place, side) for place in places for side in (1, -1))


@lru_cache
def template_images(nx: int, element: int) -> dict[int, int]:
    """Map the numbers of templates to those of their images under a symmetry element."""
    reverse, switch, _ = ELEMENTS[element]
    flip = 2 * nx + 1 if reverse else 0
    # positions are compared in hundredths of an arc, of which each is a whole number
    numbers = {
        (round(100 * one.bead), round(100 * one.target), one.apart, one.side): number
        for number, one in enumerate(templates(nx))
    }
    return {
        number: numbers[
            abs(100 * flip - bead),
            target if apart else abs(100 * flip - target),
            -apart if reverse else apart,
            -side if switch else side,
        ]
        for (bead, target, apart, side), number in numbers.items()
    }


@lru_cache(maxsize=10_000)
def own_symmetries(diagram: SeenDiagram) -> list[int]:
    """Return the numbers of the elements that leave a diagram as it is."""
    return [element for element in range(len(ELEMENTS)) if diagram.image(element) == diagram]


@dataclass
class PassCounts:
    """How often a pass led from a diagram to another.

    Attributes:
        seen: (diagram before, number of the template, diagram after or None) -> passes. The diagram
            before is the first of its images.
    """

    seen: Counter[tuple[SeenDiagram, int, SeenDiagram | None]] = field(default_factory=Counter)

    def record(self, before: SeenDiagram, choice: PassChoice, after: SeenDiagram | None) -> None:
        """Count a pass, which ended at a diagram; None if the code is the same."""
        if after is not None:
            # The same symmetry for both diagrams, so that counts of all eight images add up.
            after = after.image(choice.element) if after.nx <= COUNTED_NX else None
        self.seen[before.image(choice.element), choice.template, after] += 1

    def pruned(self, goals: list[GaussCode], most: int, least: int) -> PassCounts:
        """Keep, at every diagram, the passes that are among the best `most` for one of the goals.

        Diagrams at which fewer than `least` passes began are left out.
        """
        values = DiagramValues(self)
        kept: set[tuple[SeenDiagram, int]] = set()
        tried = Counter[SeenDiagram]()
        for (before, _, _), count in self.seen.items():
            tried[before] += count
        for before in [diagram for diagram, count in tried.items() if count >= least]:
            for goal in goals:
                for image in range(len(ELEMENTS)):
                    order = values.order(goal, before.image(image))[:most]
                    for choice in order:
                        # the element brings the image back to `before`, by another way perhaps
                        own = image ^ choice.element
                        number = template_images(before.nx, own)[choice.template]
                        kept |= {(before, choice.template), (before, number)}
        left = {key: count for key, count in self.seen.items() if key[:2] in kept}
        return PassCounts(Counter(left))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the counts to a file."""
        known: dict[SeenDiagram, int] = {}
        for before, _, after in self.seen:
            for diagram in (before, after):
                if diagram is not None:
                    known.setdefault(diagram, len(known))
        lines = [f"{one.code.chiral}|{','.join(map(str, one.outer))}" for one in known]
        rows = [
            (known[before], template, NOWHERE if after is None else known[after], count)
            for (before, template, after), count in self.seen.items()
        ]
        values = np.array(sorted(rows), dtype=np.int32).reshape(-1, 4)  # sorted, they pack better
        squeezed = {"compression": "gzip", "compression_opts": 9, "shuffle": True}
        with atomic_write(path) as temporary, h5py.File(temporary, "w") as file:
            file.attrs["format"], file.attrs["format_version"] = FORMAT, FORMAT_VERSION
            text = np.frombuffer("\n".join(lines).encode(), dtype=np.uint8)
            file.create_dataset("diagrams", data=text, **(squeezed if text.size else {}))
            for number, column in enumerate(_COLUMNS[1:]):
                data = values[:, number].astype(column.kind)
                file.create_dataset(column.name, data=data, **(squeezed if rows else {}))
            file.attrs[_DIGEST] = content_digest(read_columns(file, _COLUMNS))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> PassCounts:
        """Read the counts from a file.

        Raises:
            MissingFile: the file doesn't exist.
            InvalidFile: it is truncated, corrupted or in another format.
        """
        with opened_hdf5(
            path,
            what="file of passes",
            format=FORMAT,
            versions=(FORMAT_VERSION,),
            error=InvalidFile,
        ) as file:
            columns = read_columns(file, _COLUMNS)
            if read_attribute(file, Column(_DIGEST, "text", ())) != content_digest(columns):
                raise InvalidFile(
                    f"{path} is corrupted: the SHA-256 of its counts differs from the one stored"
                    " with them"
                )
            text = bytes(columns["diagrams"]).decode()
            diagrams: list[SeenDiagram | None] = []
            for line in text.split("\n") if text else []:
                code, _, outer = line.partition("|")
                darts = tuple(int(dart) for dart in outer.split(","))
                diagrams.append(SeenDiagram(GaussCode.parse(code), darts))
            diagrams.append(None)  # at NOWHERE
            seen = Counter[tuple[SeenDiagram, int, SeenDiagram | None]]()
            names = ("before", "template", "after", "seen")
            for row in zip(*(columns[name].tolist() for name in names), strict=True):
                before = diagrams[row[0]]
                assert before is not None
                seen[before, row[1], diagrams[row[2]]] = row[3]
            return cls(seen)


@dataclass(frozen=True, eq=False)
class _GoalValues:
    """Values for one goal.

    Attributes:
        reach: float64 by diagram: the chance that passes, the best at each diagram, reach the goal.
        first: the same if only passes count that lead to a diagram of higher `reach`.
    """

    reach: NDArray[np.float64]
    first: NDArray[np.float64]


class DiagramValues:
    """Values of diagrams and passes for any goal, from counts.

    A pass is worth the chance that it leads to a diagram of more worth, times what that is worth:
    then the best pass is the one by which, from here on, first choices are most likely right.
    Diagrams are stored in blocks of their eight images, as codes are in `transition_graph`.
    """

    _DOUBT = 3.0  # failures added to those counted, so that two of two doesn't pass for sure
    _DISCOUNT = 0.97  # of a pass: fewer are better
    _SWEEPS = 16

    def __init__(self, counts: PassCounts) -> None:
        self._diagrams: list[SeenDiagram] = []
        self._index: dict[SeenDiagram, int] = {}  # the first index of each diagram
        # How often each pass was made, and where it led.
        tried = Counter[tuple[int, int]]()
        outcomes = Counter[tuple[int, int, int]]()
        for (before, template, after), count in counts.seen.items():
            index = self._add(before)
            # what is counted for a pass holds for its image under the diagram's own symmetries
            for element in own_symmetries(before):
                image = template_images(before.nx, element)[template]
                tried[index, image] += count
                if after is not None:
                    outcomes[index, image, self._add(after.image(element))] += count
        # Rows (before, template, after, count), sorted: the outcomes of a pass lie together, the
        # passes of a diagram too. All values are computed on these arrays at once.
        led = [(*key, outcomes[key]) for key in sorted(outcomes)]
        table = np.array(led, dtype=np.int64).reshape(-1, 4)
        passes = np.array([tried[before, template] for before, template, _, _ in led], dtype=float)
        # Estimated chance of each outcome, p = discount * count / (tried + doubt).
        self._chance = self._DISCOUNT * table[:, 3] / (passes + self._DOUBT)
        # outcomes of one pass lie together; `start` is where each pass begins
        _, self._start = np.unique(table[:, 0] << 16 | table[:, 1], return_index=True)
        self._pass_of = np.zeros(len(table), dtype=np.int64)
        self._pass_of[self._start[1:]] = 1
        self._pass_of = self._pass_of.cumsum()
        self._template = table[self._start, 1]
        # Image k of the diagram at index i stands at i xor k, because blocks of eight begin at
        # multiples of eight; of equal diagrams the first index counts.
        first = np.array([self._index[one] for one in self._diagrams], dtype=np.int64)
        self._before = [first[table[:, 0] ^ element] for element in range(len(ELEMENTS))]
        self._after = [first[table[:, 2] ^ element] for element in range(len(ELEMENTS))]
        # index of a diagram's first image -> its passes, [begin, end)
        origins = table[self._start, 0]
        edges = [*np.flatnonzero(np.diff(origins, prepend=-1)).tolist(), len(origins)]
        self._passes = {
            int(origins[begin]): (begin, end) for begin, end in itertools.pairwise(edges)
        }
        self._values: dict[GaussCode, _GoalValues] = {}
        self._orders: dict[tuple[GaussCode, SeenDiagram], list[tuple[float, int]]] = {}

    def reach(self, goal: GaussCode, diagram: SeenDiagram) -> float:
        """The chance to reach a goal code from a diagram; 0 if the counts don't know a way."""
        towards, element = first_goal(goal)
        index = self._index.get(diagram.image(element))
        return 0.0 if index is None else float(self._of(towards).reach[index])

    def order(self, goal: GaussCode, diagram: SeenDiagram) -> list[PassChoice]:
        """List the passes of a diagram that lead nearer to a goal code, the best first.

        The order is the same for every image of (diagram, goal) under the symmetries.
        """
        towards, seen_as = first_goal(goal)
        moved = diagram.image(seen_as)
        _, element = canonical_image(moved)
        return [
            PassChoice(template, seen_as ^ element, value)
            for value, template in self._ordered(towards, moved, element)
        ]

    def _ordered(
        self, goal: GaussCode, diagram: SeenDiagram, element: int
    ) -> list[tuple[float, int]]:
        key = goal, diagram
        if key not in self._orders:
            first = diagram.image(element)
            begin, end = self._passes.get(self._index.get(first, -1), (0, 0))
            order: list[tuple[float, int]] = []
            if end > begin:
                values = self._of(goal)
                rows = slice(
                    int(self._start[begin]),
                    int(self._start[end]) if end < len(self._start) else len(self._chance),
                )
                worth = self._worth(values.first, values.reach, element, rows)
                sums = np.zeros(end - begin)
                np.add.at(sums, self._pass_of[rows] - begin, worth)
                # rounded, so that the order doesn't depend on how a machine adds
                rounded = np.round(sums, 6)
                order = [
                    (float(rounded[k]), int(self._template[begin + k]))
                    for k in np.argsort(-rounded, kind="stable")
                    if rounded[k] > 0
                ]
            self._orders[key] = order
        return self._orders[key]

    def _worth(
        self,
        first: NDArray[np.float64],
        reach: NDArray[np.float64],
        element: int,
        rows: slice = slice(None),
    ) -> NDArray[np.float64]:
        """What each outcome adds to its pass, for image `element` of the diagrams."""
        before, after = self._before[element][rows], self._after[element][rows]
        worth: NDArray[np.float64] = self._chance[rows] * first[after]
        return np.where(reach[after] > reach[before], worth, 0.0)

    def _of(self, goal: GaussCode) -> _GoalValues:
        if goal not in self._values:
            shown = np.array([float(one.code.matches(goal)) for one in self._diagrams])
            # Value iteration: V(d) = max over passes of the sum of p V(after), V = 1 where the
            # goal is shown. After k sweeps, ways of up to k passes count.
            reach = shown
            for _ in range(self._SWEEPS if len(self._start) else 0):
                reach = self._swept(shown, [self._chance * reach[after] for after in self._after])
            # The same once more, with only those outcomes that `reach` calls nearer.
            first = shown
            for _ in range(self._SWEEPS if len(self._start) else 0):
                outcomes = [self._worth(first, reach, k) for k in range(len(ELEMENTS))]
                first = self._swept(shown, outcomes)
            self._values[goal] = _GoalValues(reach, first)
        return self._values[goal]

    def _swept(
        self, shown: NDArray[np.float64], outcomes: list[NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Take the best pass of every diagram; `outcomes` are their parts, by image."""
        values = shown.copy()
        for element, worth in enumerate(outcomes):
            # sums over the outcomes of each pass, then the best pass of each diagram
            sums = np.add.reduceat(worth, self._start)
            np.maximum.at(values, self._before[element][self._start], sums)
        return values

    def _add(self, diagram: SeenDiagram) -> int:
        if diagram not in self._index:
            for element in range(len(ELEMENTS)):
                image = diagram.image(element)
                self._index.setdefault(image, len(self._diagrams))
                self._diagrams.append(image)
        return self._index[diagram]


@lru_cache(maxsize=10_000)
def first_goal(goal: GaussCode) -> tuple[GaussCode, int]:
    """Return the first of a goal's images, without chirality, and the element that gives it."""
    members = images(goal.plain)
    element = min(range(len(members)), key=lambda k: (members[k].visits, k))
    return members[element], element


def shipped_values(split: str = "train", *, every_code: bool = False) -> DiagramValues:
    """Values for a task's split, from the counts that ship; none if their file is missing.

    Splits by code have their own, from play that met no start and no goal that is held out.

    Args:
        split: of the task.
        every_code: whether they are counted towards every code, or towards train goals alone;
            makes no difference to splits by code.
    """
    if split in CODE_SPLITS:
        return _values_from(PASSES["train-code"])
    return _values_from(EVERY_CODE if every_code else PASSES["train"])


@lru_cache(maxsize=3)
def _values_from(path: Path) -> DiagramValues:
    return DiagramValues(PassCounts.load(path) if path.is_file() else PassCounts())
