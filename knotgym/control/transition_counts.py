"""Count what macro-actions do to Gauss codes, and keep examples.

A macro-action starts at one code and may pass through several others; each of those counts as a
change. The dynamics are the same, exactly, for mirrored ropes and for ropes walked the other way,
and nearly the same for every base bead in `rope.base_shifts`. So each change is counted for all
these base beads, and up to symmetry: the code before it is brought to its canonical form, and the
same symmetry is applied to the code after it.

A *template* describes a macro-action in terms of the diagram instead of beads: a position along the
rope is given by the arc that it lies on and how far along the arc it is. Arcs are the stretches
between consecutive visits of crossings. Arc 0 runs from the base bead to the first visit, the last
arc from the last visit back to the base bead, so a code of nx crossings has 2 nx + 1 arcs.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write
from knotgym.common.errors import InvalidFile
from knotgym.common.hdf5_files import Column, opened_hdf5, read_attribute, read_column
from knotgym.rope.macro_action_config import KINDS
from knotgym.rope.macro_actions import MacroAction
from knotgym.topology.crossings import Crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import canonical_form, images, shifted_base

FORMAT = "knotgym-transitions"
FORMAT_VERSION = 1

_DIGEST = "content_sha256"  # attribute of a transitions file; groups in other files lack it
_COLUMNS = (
    Column("codes", "uint8", (None,)),
    Column("tried", "int32", ("codes",), least=0),
    Column("before", "int32", ("changes",), least=0),
    Column("after", "int32", ("changes",), least=0),
    Column("seen", "int32", ("changes",), least=0),
    Column("template_of", "int32", ("templates",), least=0),
    Column("template_kind", "int8", ("templates",), least=0),
    Column("template_side", "int8", ("templates",), least=-1),
    Column("template_places", "float16", ("templates", 2), finite=True),
)
Element = tuple[bool, bool, bool]  # symmetry element: reverse, switch, reflect
_BOTH = (False, True)
# Element k is the one that `symmetry.images` applies for its k-th image. Read as bits of k, the
# three flags make composition a bitwise xor, which `transition_graph` relies on.
ELEMENTS: tuple[Element, ...] = tuple(product(_BOTH, _BOTH, _BOTH))


class MacroTemplate(NamedTuple):
    """A macro-action in terms of a diagram.

    Attributes:
        kind: one of `macro_actions.KINDS`.
        side: +1 over the target or upwards, -1 under it or downwards, 0 for neither.
        bead: position of the bead: the arc plus the fraction along it; 2.25 is a quarter of the
            way along arc 2.
        target: position of the strand to pass; -1 if there is none.
    """

    kind: str
    side: int
    bead: float
    target: float

    def transformed(self, element: Element, arcs: int) -> MacroTemplate:
        """The template for the image of the rope under a symmetry element.

        Args:
            element: reverse the walk, switch over and under, reflect.
            arcs: number of arcs of the diagram.
        """
        reverse, switch, _ = element  # a reflection moves no position along the rope
        bead, target = self.bead, self.target
        if reverse:  # position 0 and position `arcs` are both the base bead
            bead = arcs - bead
            target = arcs - target if target >= 0 else target
        return MacroTemplate(self.kind, -self.side if switch else self.side, bead, target)


@dataclass
class TransitionCounts:
    """Counts of changes from classes of codes to codes.

    A class is the set of images of a code under ELEMENTS, and is named by its canonical form. The
    code after a change is moved by the element that brings the code before it to that form.

    Attributes:
        tried: class -> macro-actions that started there.
        seen: (class before, code after) -> macro-actions that made this change.
        templates: (class before, code after) -> the first few examples.
    """

    tried: Counter[GaussCode] = field(default_factory=Counter)
    seen: Counter[tuple[GaussCode, GaussCode]] = field(default_factory=Counter)
    templates: dict[tuple[GaussCode, GaussCode], list[MacroTemplate]] = field(default_factory=dict)

    def set_out(self, before: GaussCode) -> None:
        """Count a macro-action that starts at a code."""
        self.tried[canonical_form(before)] += 1

    def change(
        self, before: GaussCode, after: GaussCode, template: MacroTemplate, most_templates: int
    ) -> None:
        """Count a change of code, and keep its template if it has fewer than `most_templates`."""
        # A code with symmetries reaches its canonical form by several elements. They give different
        # images of `after` for the same change, and the least of these is counted.
        element = min(
            _elements(before),
            key=lambda element: (_order(transformed(after, element)), element),
        )
        key = canonical_form(before), transformed(after, element)
        self.seen[key] += 1
        kept = self.templates.setdefault(key, [])
        if len(kept) < most_templates:
            kept.append(template.transformed(element, 2 * before.nx + 1))

    def add(self, other: TransitionCounts, most_templates: int) -> None:
        """Add the counts of another table; keep at most `most_templates` per change."""
        self.tried.update(other.tried)
        self.seen.update(other.seen)
        for key, templates in other.templates.items():
            kept = self.templates.setdefault(key, [])
            kept += templates[: max(0, most_templates - len(kept))]

    def pruned(self, *, max_nx: int, least: int) -> TransitionCounts:
        """Drop codes of more than max_nx crossings, and changes seen fewer than `least` times."""
        keys = [
            key
            for key, count in self.seen.items()
            if count >= least and max(code.nx for code in key) <= max_nx
        ]
        tried = Counter({code: count for code, count in self.tried.items() if code.nx <= max_nx})
        return TransitionCounts(
            tried,
            Counter({key: self.seen[key] for key in keys}),
            {key: self.templates[key] for key in keys},
        )

    def write(self, group: h5py.Group) -> None:
        """Write the counts into an HDF5 group; docs/formats/search.md describes the datasets."""
        # Rows of codes: those tried first, then the rest, each once in the order of first use.
        # `before` and `after` are rows of codes, `template_of` is a row of `before` and `after`.
        known = dict.fromkeys([*self.tried, *(code for key in self.seen for code in key)])
        codes = {code: row for row, code in enumerate(known)}
        # flat: the templates of all changes one after another, each with the row of its change
        templates = [
            (row, template) for row, key in enumerate(self.seen) for template in self.templates[key]
        ]
        squeezed = {"compression": "gzip", "compression_opts": 9, "shuffle": True}
        text = "\n".join(code.chiral for code in codes).encode()
        kinds = [KINDS.index(template.kind) for _, template in templates]
        sides = [template.side for _, template in templates]
        places = np.array([(template.bead, template.target) for _, template in templates])
        columns: dict[str, NDArray[Any]] = {
            "codes": np.frombuffer(text, dtype=np.uint8),
            "tried": np.array([self.tried.get(code, 0) for code in codes], dtype=np.int32),
            "before": np.array([codes[before] for before, _ in self.seen], dtype=np.int32),
            "after": np.array([codes[after] for _, after in self.seen], dtype=np.int32),
            "seen": np.array(list(self.seen.values()), dtype=np.int32),
            "template_of": np.array([row for row, _ in templates], dtype=np.int32),
            "template_kind": np.array(kinds, dtype=np.int8),
            "template_side": np.array(sides, dtype=np.int8),
            "template_places": places.astype(np.float16).reshape(-1, 2),
        }
        for name, values in columns.items():
            # HDF5 can't compress an empty dataset
            group.create_dataset(name, data=values, **(squeezed if values.size else {}))

    @classmethod
    def read(cls, group: h5py.Group) -> TransitionCounts:
        """Read what `write` wrote.

        Raises:
            InvalidFile: the group has a digest, and its values don't match it.
        """
        columns = read_columns(group, _COLUMNS)
        if _DIGEST in group.attrs:
            if read_attribute(group, Column(_DIGEST, "text", ())) != content_digest(columns):
                raise InvalidFile(
                    f"{group.file.filename} is corrupted: the SHA-256 of its counts differs from"
                    " the one stored with them"
                )
        read = {name: values.tolist() for name, values in columns.items()}
        # one code per line; the plain loop's is an empty line, so no codes and one look the same
        text = bytes(read["codes"]).decode()
        codes = [GaussCode.parse(line) for line in text.split("\n")] if read["tried"] else []
        counts = zip(codes, read["tried"], strict=True)
        tried = Counter({code: count for code, count in counts if count})
        ends = zip(read["before"], read["after"], strict=True)
        keys = [(codes[before], codes[after]) for before, after in ends]
        templates: dict[tuple[GaussCode, GaussCode], list[MacroTemplate]] = {
            key: [] for key in keys
        }
        by_row = [templates[key] for key in keys]  # the same lists, filled below
        fields = (read[f"template_{name}"] for name in ("of", "kind", "side", "places"))
        for row, kind, side, (bead, target) in zip(*fields, strict=True):
            by_row[row].append(MacroTemplate(KINDS[kind], side, bead, target))
        seen = Counter(dict(zip(keys, read["seen"], strict=True)))
        return cls(tried, seen, templates)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a transitions file."""
        with atomic_write(path) as temporary, h5py.File(temporary, "w") as file:
            file.attrs["format"], file.attrs["format_version"] = FORMAT, FORMAT_VERSION
            self.write(file)
            file.attrs[_DIGEST] = content_digest(read_columns(file, _COLUMNS))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> TransitionCounts:
        """Read a transitions file.

        Raises:
            MissingFile: the file doesn't exist.
            InvalidFile: the file is truncated, corrupted or in another format.
        """
        with opened_hdf5(
            path,
            what="transitions file",
            format=FORMAT,
            versions=(FORMAT_VERSION,),
            error=InvalidFile,
        ) as file:
            return cls.read(file)


class ArcCoordinates:
    """Converts between beads of a rope and positions on the arcs of its diagram."""

    def __init__(self, crossings: Crossings, beads: int, base_shift: int = 0) -> None:
        """Take a rope's crossings, its number of beads, and the vertex where the walk starts."""
        # ends of the arcs, in beads from the base; visits are sorted along the walk
        visits = np.concatenate([crossings.over_place, crossings.under_place]) - base_shift
        self._cuts: NDArray[np.float64] = np.concatenate(
            [[0.0], np.sort(visits % beads), [float(beads)]]
        )
        self._beads, self._base_shift = beads, base_shift

    def arc(self, bead: int) -> float:
        """Return the arc plus the fraction along it of a bead's middle."""
        middle = (bead + 0.5 - self._base_shift) % self._beads
        arc = min(int(np.searchsorted(self._cuts, middle, side="right")) - 1, len(self._cuts) - 2)
        start, end = self._cuts[arc], self._cuts[arc + 1]
        # below 1, or the sum would name the next arc; two visits may coincide, so no division by 0
        return arc + min(0.999, float((middle - start) / max(1e-9, end - start)))

    def bead(self, position: float) -> int:
        """Return the bead at a position; the inverse of `arc`, clipped to the arcs there are."""
        arc = min(max(int(position), 0), len(self._cuts) - 2)
        start, end = self._cuts[arc], self._cuts[arc + 1]
        along = start + min(max(position - arc, 0.0), 1.0) * (end - start)
        return int(along + self._base_shift) % self._beads


class TransitionRecorder:
    """Counts the changes of code that one rope goes through, macro-action by macro-action.

    Attributes:
        transitions: the counts so far.
    """

    def __init__(self, base_shifts: list[int], beads: int, most_templates: int) -> None:
        """Set up the counts.

        Args:
            base_shifts: vertices where the walk starts; changes are counted for each.
            beads: beads of the rope.
            most_templates: templates kept per change.
        """
        self.transitions = TransitionCounts()
        self._base_shifts, self._beads = base_shifts, beads
        self._most_templates = most_templates
        # of the macro-action under way, one entry per base shift
        self._before: list[GaussCode] = []
        self._templates: list[MacroTemplate] = []
        self._met: list[set[GaussCode]] = []  # codes already counted

    def set_out(self, crossings: Crossings, macro_action: MacroAction) -> None:
        """Start a macro-action on a rope with these crossings."""
        self._before = [shifted_base(crossings, base_shift) for base_shift in self._base_shifts]
        self._templates = [
            template_of(macro_action, ArcCoordinates(crossings, self._beads, base_shift))
            for base_shift in self._base_shifts
        ]
        self._met = [{code} for code in self._before]
        for before in self._before:
            self.transitions.set_out(before)

    def show(self, crossings: Crossings) -> None:
        """Count the code that the rope shows after a step, unless it was counted before."""
        # from each base bead the rope is a walk of its own, with its own codes
        for walk, base_shift in enumerate(self._base_shifts):
            after = shifted_base(crossings, base_shift)
            if after not in self._met[walk]:
                self._met[walk].add(after)
                self.transitions.change(
                    self._before[walk], after, self._templates[walk], self._most_templates
                )


def template_of(macro_action: MacroAction, arcs: ArcCoordinates) -> MacroTemplate:
    """Describe a macro-action in terms of the diagram of its rope."""
    target = arcs.arc(macro_action.target) if macro_action.target >= 0 else -1.0
    bead = arcs.arc(macro_action.bead)
    return MacroTemplate(macro_action.kind, macro_action.side, bead, target)


def transformed(code: GaussCode, element: Element) -> GaussCode:
    """Apply a symmetry element to a code with chirality; applying it twice gives the code back."""
    reverse, switch, reflect = element
    code = code.reversed() if reverse else code
    code = code.mirrored() if switch else code
    return code.reflected() if reflect else code


@lru_cache(maxsize=200_000)
def _elements(code: GaussCode) -> tuple[Element, ...]:
    """All symmetry elements that bring a code to its canonical form."""
    wanted = canonical_form(code)
    return tuple(
        element for image, element in zip(images(code), ELEMENTS, strict=True) if image == wanted
    )


def read_columns(group: h5py.Group, schema: tuple[Column, ...]) -> dict[str, NDArray[Any]]:
    """Read the columns of a group."""
    sizes: dict[str, int] = {}
    return {column.name: read_column(group, column, sizes) for column in schema}


def content_digest(columns: dict[str, NDArray[Any]]) -> str:
    """SHA-256 of all columns with their names, types and shapes, hexadecimal."""
    whole = hashlib.sha256()
    for name, values in columns.items():
        # little-endian and contiguous, so that every machine hashes the same bytes
        little = values.astype(values.dtype.newbyteorder("<"), copy=False)
        whole.update(f"{name} {little.dtype.str} {values.shape}".encode())
        whole.update(np.ascontiguousarray(little).tobytes())
    return whole.hexdigest()


def _order(code: GaussCode) -> tuple[tuple[int, ...], str]:
    return code.visits, code.chirality or ""
