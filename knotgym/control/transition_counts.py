"""What macro-actions do to Gauss codes: how often one leads from a code to another, and examples of
how.

A macro-action sets out from one code and may show several others on its way; each counts. What one
rope does, it shows at every start of its walk that is nearly a symmetry (`symmetry.base_shifts`)
and, exactly, in its mirrors and walked the other way: so codes are counted by classes, `before`
brought to the member that stands for its class and `after` along with it.

A *template* names a macro-action by what it does in the diagram and not where: places along the
rope are told by the arc between two visits that they lie in. Arc 0 runs from the base bead to the
first visit, the last one back to the base bead.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from knotgym.atomic_files import atomic_write
from knotgym.control.macro_actions import KINDS, MacroAction
from knotgym.errors import KnotgymError
from knotgym.hdf5_files import opened_hdf5
from knotgym.topology.crossings import Crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import canonical_form, shifted_base, variants

FORMAT = "knotgym-transitions"
FORMAT_VERSION = 2  # version 1, which is read too, calls templates grips
KEPT = 6  # templates kept for a change of code

_Element = tuple[bool, bool, bool]  # reverse, switch, reflect


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
        """The same on a rope that was walked the other way, switched over and under, or
        reflected.
        """
        reverse, switch, _ = element
        bead, target = (
            (arcs - self.bead if reverse else self.bead),
            (arcs - self.target if reverse and self.target >= 0 else self.target),
        )
        return MacroTemplate(self.kind, -self.side if switch else self.side, bead, target)


@dataclass
class TransitionCounts:
    """Counts of changes between classes of codes.

    Attributes:
        tried: class -> macro-actions that set out from it.
        seen: (class before, code after, moved along) -> macro-actions that showed it.
        templates: the same -> examples, KEPT at most.
    """

    tried: Counter[GaussCode] = field(default_factory=Counter)
    seen: Counter[tuple[GaussCode, GaussCode]] = field(default_factory=Counter)
    templates: dict[tuple[GaussCode, GaussCode], list[MacroTemplate]] = field(default_factory=dict)

    def set_out(self, before: GaussCode) -> None:
        """Count a macro-action that sets out from a code."""
        self.tried[canonical_form(before)] += 1

    def change(self, before: GaussCode, after: GaussCode, template: MacroTemplate) -> None:
        """Count a code that a macro-action showed for the first time."""
        element = min(
            _elements(before, canonical_form(before)),
            key=lambda one: (_order(transformed(after, one)), one),
        )
        key = canonical_form(before), transformed(after, element)
        self.seen[key] += 1
        kept = self.templates.setdefault(key, [])
        if len(kept) < KEPT:
            kept.append(template.transformed(element, 2 * before.nx + 1))

    def add(self, other: TransitionCounts) -> None:
        """Count another table's macro-actions too."""
        self.tried.update(other.tried)
        self.seen.update(other.seen)
        for key, templates in other.templates.items():
            kept = self.templates.setdefault(key, [])
            kept += templates[: KEPT - len(kept)]

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
        codes = {
            code: row
            for row, code in enumerate(
                dict.fromkeys([*self.tried, *(code for key in self.seen for code in key)])
            )
        }
        templates = [
            (row, template) for row, key in enumerate(self.seen) for template in self.templates[key]
        ]
        squeezed = {"compression": "gzip", "compression_opts": 9, "shuffle": True}
        text = "\n".join(code.chiral for code in codes).encode()
        columns: dict[str, NDArray[Any]] = {
            "codes": np.frombuffer(text, dtype=np.uint8),
            "tried": np.array([self.tried.get(code, 0) for code in codes], dtype=np.int32),
            "before": np.array([codes[before] for before, _ in self.seen], dtype=np.int32),
            "after": np.array([codes[after] for _, after in self.seen], dtype=np.int32),
            "seen": np.array(list(self.seen.values()), dtype=np.int32),
            "template_of": np.array([row for row, _ in templates], dtype=np.int32),
            "template_kind": np.array(
                [KINDS.index(template.kind) for _, template in templates], dtype=np.int8
            ),
            "template_side": np.array([template.side for _, template in templates], dtype=np.int8),
            "template_places": (
                np.array(
                    [(template.bead, template.target) for _, template in templates],
                    dtype=np.float16,
                ).reshape(-1, 2)
            ),
        }
        for name, values in columns.items():
            group.create_dataset(name, data=values, **(squeezed if values.size else {}))

    @classmethod
    def read(cls, group: h5py.Group) -> TransitionCounts:
        """Read what `write` wrote."""
        text = bytes(group["codes"][()]).decode()
        codes = [GaussCode.parse(line) for line in text.split("\n")] if len(group["tried"]) else []
        tried = Counter(
            {
                code: count
                for code, count in zip(codes, group["tried"][()].tolist(), strict=True)
                if count
            }
        )
        keys = [
            (codes[a], codes[b])
            for a, b in zip(group["before"][()].tolist(), group["after"][()].tolist(), strict=True)
        ]
        templates: dict[tuple[GaussCode, GaussCode], list[MacroTemplate]] = {
            key: [] for key in keys
        }
        stem = "template" if "template_of" in group else "grip"  # version 1
        columns = (
            group[f"{stem}_{name}"][()].tolist() for name in ("of", "kind", "side", "places")
        )
        for row, kind, side, (bead, target) in zip(*columns, strict=True):
            templates[keys[row]].append(MacroTemplate(KINDS[kind], side, bead, target))
        return cls(
            tried, Counter(dict(zip(keys, group["seen"][()].tolist(), strict=True))), templates
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file of transitions alone."""
        with atomic_write(path) as temporary, h5py.File(temporary, "w") as file:
            file.attrs["format"], file.attrs["format_version"] = FORMAT, FORMAT_VERSION
            self.write(file)

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
            versions=(1, FORMAT_VERSION),
            error=InvalidTransitions,
        ) as file:
            return cls.read(file)


class Places:
    """Places along one rope told by the arcs of its diagram, whose walk starts at vertex
    `base_shift`.
    """

    def __init__(self, crossings: Crossings, beads: int, base_shift: int = 0) -> None:
        visits = (
            np.concatenate([crossings.over_place, crossings.under_place]) - base_shift
        ) % beads
        self._cuts: NDArray[np.float64] = np.concatenate([[0.0], np.sort(visits), [float(beads)]])
        self._beads, self._base_shift = beads, base_shift

    def arc(self, bead: int) -> float:
        """Arc and fraction of a bead's middle."""
        place = (bead + 0.5 - self._base_shift) % self._beads
        arc = min(int(np.searchsorted(self._cuts, place, side="right")) - 1, len(self._cuts) - 2)
        return arc + min(
            0.999,
            float((place - self._cuts[arc]) / max(1e-9, self._cuts[arc + 1] - self._cuts[arc])),
        )

    def bead(self, place: float) -> int:
        """The bead at an arc and fraction; the inverse of `arc`."""
        arc = min(max(int(place), 0), len(self._cuts) - 2)
        along = self._cuts[arc] + min(max(place - arc, 0.0), 1.0) * (
            self._cuts[arc + 1] - self._cuts[arc]
        )
        return int(along + self._base_shift) % self._beads


class TransitionRecorder:
    """Follows one rope through one macro-action after the other and counts what it shows, walked
    from each of `base_shifts`.
    """

    def __init__(self, base_shifts: list[int], beads: int) -> None:
        self.transitions = TransitionCounts()
        self._base_shifts, self._beads = base_shifts, beads
        self._before: list[GaussCode] = []
        self._grips: list[MacroTemplate] = []
        self._met: list[set[GaussCode]] = []

    def set_out(self, crossings: Crossings, macro_action: MacroAction) -> None:
        """A macro-action begins on a rope that shows `crossings`."""
        self._before = [shifted_base(crossings, base_shift) for base_shift in self._base_shifts]
        self._grips = [
            template_of(macro_action, Places(crossings, self._beads, base_shift))
            for base_shift in self._base_shifts
        ]
        self._met = [{code} for code in self._before]
        for before in self._before:
            self.transitions.set_out(before)

    def show(self, crossings: Crossings) -> None:
        """What the rope shows after a pull of the macro_action."""
        for k, base_shift in enumerate(self._base_shifts):
            after = shifted_base(crossings, base_shift)
            if after not in self._met[k]:
                self._met[k].add(after)
                self.transitions.change(self._before[k], after, self._grips[k])


def template_of(macro_action: MacroAction, places: Places) -> MacroTemplate:
    """How a macro-action holds a rope, in terms of the diagram it shows."""
    target = places.arc(macro_action.target) if macro_action.target >= 0 else -1.0
    return MacroTemplate(
        macro_action.kind, macro_action.side, places.arc(macro_action.bead), target
    )


def transformed(code: GaussCode, element: _Element) -> GaussCode:
    """A code with chirality as shown by the rope walked the other way, switched over and under,
    reflected; any element undoes itself.
    """
    reverse, switch, reflect = element
    code = code.reversed() if reverse else code
    code = code.mirrored() if switch else code
    return code.reflected() if reflect else code


def elements(code: GaussCode) -> Iterator[_Element]:
    """Every way to bring a code to the member that stands for its class."""
    return iter(_elements(code, canonical_form(code)))


@lru_cache(maxsize=200_000)
def _elements(code: GaussCode, wanted: GaussCode) -> tuple[_Element, ...]:
    return tuple(
        (how.reverse, how.switch, how.reflect) for shown, how in variants(code) if shown == wanted
    )


def _order(code: GaussCode) -> tuple[tuple[int, ...], str]:
    return code.visits, code.chirality or ""
