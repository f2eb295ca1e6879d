"""What macro-actions do to Gauss codes: how often one leads from a code to another, and examples.

A macro-action begins at one code and may show several others on its way; each counts. What one rope
does, it shows at every start of its walk that is nearly a symmetry (`rope.base_shifts`) and,
exactly, in its mirrors and walked the other way: so codes are counted by classes, `before` brought
to its canonical form and `after` along with it.

A *template* names a macro-action by what it does in the diagram and not where: places along the
rope are told by the arc between two visits that they lie in. Arc 0 runs from the base bead to the
first visit, the last one back to the base bead.
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write
from knotgym.common.errors import KnotgymError
from knotgym.common.hdf5_files import Column, opened_hdf5, read_attribute, read_column
from knotgym.control.macro_actions import KINDS, MacroAction
from knotgym.topology.crossings import Crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import canonical_form, images, shifted_base

FORMAT = "knotgym-transitions"
FORMAT_VERSION = 1

_DIGEST = "content_sha256"  # an attribute of a file of transitions alone
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
_Element = tuple[bool, bool, bool]  # symmetry element: reverse, switch, reflect
_BOTH = (False, True)
ELEMENTS: tuple[_Element, ...] = tuple(product(_BOTH, _BOTH, _BOTH))  # as `symmetry.images`


class InvalidTransitions(KnotgymError, ValueError):
    """A file that holds no transitions this version can read."""


class MacroTemplate(NamedTuple):
    """A macro-action in terms of a diagram.

    Attributes:
        kind: one of `macro_actions.KINDS`.
        side: +1 over the target, -1 under it, 0 without target.
        bead: arc and how far along it, as one number: 2.25 is a quarter down arc 2.
        target: the same of the strand passed; -1 without.
    """

    kind: str
    side: int
    bead: float
    target: float

    def transformed(self, element: _Element, arcs: int) -> MacroTemplate:
        """The same on a rope walked the other way, switched over and under, or reflected."""
        reverse, switch, _ = element
        bead, target = self.bead, self.target
        if reverse:
            bead = arcs - bead
            target = arcs - target if target >= 0 else target
        return MacroTemplate(self.kind, -self.side if switch else self.side, bead, target)


@dataclass
class TransitionCounts:
    """Counts of changes between classes of codes.

    Attributes:
        tried: class -> macro-actions that began at it.
        seen: (class before, code after, moved along) -> macro-actions that showed it.
        templates: the same -> examples, the first few met.
    """

    tried: Counter[GaussCode] = field(default_factory=Counter)
    seen: Counter[tuple[GaussCode, GaussCode]] = field(default_factory=Counter)
    templates: dict[tuple[GaussCode, GaussCode], list[MacroTemplate]] = field(default_factory=dict)

    def set_out(self, before: GaussCode) -> None:
        """Count a macro-action that begins at a code."""
        self.tried[canonical_form(before)] += 1

    def change(
        self, before: GaussCode, after: GaussCode, template: MacroTemplate, most_templates: int
    ) -> None:
        """Count a code that a macro-action showed for the first time.

        Its template is kept if the change has fewer than `most_templates`.
        """
        element = min(
            _elements(before, canonical_form(before)),
            key=lambda element: (_order(transformed(after, element)), element),
        )
        key = canonical_form(before), transformed(after, element)
        self.seen[key] += 1
        kept = self.templates.setdefault(key, [])
        if len(kept) < most_templates:
            kept.append(template.transformed(element, 2 * before.nx + 1))

    def add(self, other: TransitionCounts, most_templates: int) -> None:
        """Count another table's macro-actions too, keeping so many templates of a change."""
        self.tried.update(other.tried)
        self.seen.update(other.seen)
        for key, templates in other.templates.items():
            kept = self.templates.setdefault(key, [])
            kept += templates[: max(0, most_templates - len(kept))]

    def pruned(self, *, max_nx: int, least: int) -> TransitionCounts:
        """Without codes of more than max_nx crossings and changes seen fewer than `least` times."""
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
        """Write into an HDF5 group."""
        known = dict.fromkeys([*self.tried, *(code for key in self.seen for code in key)])
        codes = {code: row for row, code in enumerate(known)}
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
            group.create_dataset(name, data=values, **(squeezed if values.size else {}))

    @classmethod
    def read(cls, group: h5py.Group) -> TransitionCounts:
        """Read what `write` wrote.

        Raises:
            InvalidTransitions: it says which values were written, and these aren't.
        """
        columns = _read_columns(group)
        if _DIGEST in group.attrs:
            if read_attribute(group, Column(_DIGEST, "text", ())) != _digest(columns):
                raise InvalidTransitions(
                    f"{group.file.filename}: its counts are not those written into it (SHA-256"
                    " differs)"
                )
        read = {name: values.tolist() for name, values in columns.items()}
        text = bytes(read["codes"]).decode()
        codes = [GaussCode.parse(line) for line in text.split("\n")] if read["tried"] else []
        counts = zip(codes, read["tried"], strict=True)
        tried = Counter({code: count for code, count in counts if count})
        ends = zip(read["before"], read["after"], strict=True)
        keys = [(codes[before], codes[after]) for before, after in ends]
        templates: dict[tuple[GaussCode, GaussCode], list[MacroTemplate]] = {
            key: [] for key in keys
        }
        by_row = [templates[key] for key in keys]
        told = (read[f"template_{name}"] for name in ("of", "kind", "side", "places"))
        for row, kind, side, (bead, target) in zip(*told, strict=True):
            by_row[row].append(MacroTemplate(KINDS[kind], side, bead, target))
        seen = Counter(dict(zip(keys, read["seen"], strict=True)))
        return cls(tried, seen, templates)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file of transitions alone."""
        with atomic_write(path) as temporary, h5py.File(temporary, "w") as file:
            file.attrs["format"], file.attrs["format_version"] = FORMAT, FORMAT_VERSION
            self.write(file)
            file.attrs[_DIGEST] = _digest(_read_columns(file))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> TransitionCounts:
        """Read such a file.

        Raises:
            MissingFile: there is none.
            InvalidTransitions: foreign, truncated, or of an unknown format.
        """
        with opened_hdf5(
            path,
            what="file of transitions",
            format=FORMAT,
            versions=(FORMAT_VERSION,),
            error=InvalidTransitions,
        ) as file:
            return cls.read(file)


class Places:
    """Places along one rope told by the arcs of its diagram, walked from vertex `base_shift`."""

    def __init__(self, crossings: Crossings, beads: int, base_shift: int = 0) -> None:
        visits = np.concatenate([crossings.over_place, crossings.under_place]) - base_shift
        self._cuts: NDArray[np.float64] = np.concatenate(
            [[0.0], np.sort(visits % beads), [float(beads)]]
        )
        self._beads, self._base_shift = beads, base_shift

    def arc(self, bead: int) -> float:
        """Arc and fraction of a bead's middle."""
        place = (bead + 0.5 - self._base_shift) % self._beads
        arc = min(int(np.searchsorted(self._cuts, place, side="right")) - 1, len(self._cuts) - 2)
        start, end = self._cuts[arc], self._cuts[arc + 1]
        return arc + min(0.999, float((place - start) / max(1e-9, end - start)))

    def bead(self, place: float) -> int:
        """The bead at an arc and fraction; the inverse of `arc`."""
        arc = min(max(int(place), 0), len(self._cuts) - 2)
        start, end = self._cuts[arc], self._cuts[arc + 1]
        along = start + min(max(place - arc, 0.0), 1.0) * (end - start)
        return int(along + self._base_shift) % self._beads


class TransitionRecorder:
    """Follows one rope through its macro-actions and counts what it shows.

    Attributes:
        transitions: counted so far.
    """

    def __init__(self, base_shifts: list[int], beads: int, most_templates: int) -> None:
        """Count each code as walked from each of `base_shifts`, with so many templates a change."""
        self.transitions = TransitionCounts()
        self._base_shifts, self._beads = base_shifts, beads
        self._most_templates = most_templates
        self._before: list[GaussCode] = []
        self._templates: list[MacroTemplate] = []
        self._met: list[set[GaussCode]] = []

    def set_out(self, crossings: Crossings, macro_action: MacroAction) -> None:
        """A macro-action begins on a rope that shows `crossings`."""
        self._before = [shifted_base(crossings, base_shift) for base_shift in self._base_shifts]
        self._templates = [
            template_of(macro_action, Places(crossings, self._beads, base_shift))
            for base_shift in self._base_shifts
        ]
        self._met = [{code} for code in self._before]
        for before in self._before:
            self.transitions.set_out(before)

    def show(self, crossings: Crossings) -> None:
        """The rope shows `crossings` after a step of the macro-action."""
        for walk, base_shift in enumerate(self._base_shifts):
            after = shifted_base(crossings, base_shift)
            if after not in self._met[walk]:
                self._met[walk].add(after)
                self.transitions.change(
                    self._before[walk], after, self._templates[walk], self._most_templates
                )


def template_of(macro_action: MacroAction, places: Places) -> MacroTemplate:
    """A macro-action in terms of the diagram that its rope shows."""
    target = places.arc(macro_action.target) if macro_action.target >= 0 else -1.0
    bead = places.arc(macro_action.bead)
    return MacroTemplate(macro_action.kind, macro_action.side, bead, target)


def transformed(code: GaussCode, element: _Element) -> GaussCode:
    """A code with chirality as the rope shows it after a symmetry element; each undoes itself."""
    reverse, switch, reflect = element
    code = code.reversed() if reverse else code
    code = code.mirrored() if switch else code
    return code.reflected() if reflect else code


def elements(code: GaussCode) -> Iterator[_Element]:
    """Every symmetry element that brings a code to its canonical form."""
    return iter(_elements(code, canonical_form(code)))


@lru_cache(maxsize=200_000)
def _elements(code: GaussCode, wanted: GaussCode) -> tuple[_Element, ...]:
    return tuple(
        element for shown, element in zip(images(code), ELEMENTS, strict=True) if shown == wanted
    )


def _read_columns(group: h5py.Group) -> dict[str, NDArray[Any]]:
    """Read the columns that `TransitionCounts.write` wrote."""
    sizes: dict[str, int] = {}
    return {column.name: read_column(group, column, sizes) for column in _COLUMNS}


def _digest(columns: dict[str, NDArray[Any]]) -> str:
    """SHA-256 of all columns with their names and shapes, hexadecimal."""
    whole = hashlib.sha256()
    for name, values in columns.items():
        little = values.astype(values.dtype.newbyteorder("<"), copy=False)
        whole.update(f"{name} {little.dtype.str} {values.shape}".encode())
        whole.update(np.ascontiguousarray(little).tobytes())
    return whole.hexdigest()


def _order(code: GaussCode) -> tuple[tuple[int, ...], str]:
    return code.visits, code.chirality or ""
