"""The archive of play: the states with the shortest sequences and best legibility, by Gauss code.

This is quality-diversity search like MAP-Elites (niches) and Go-Explore (return, then explore). A
niche is a class of codes with chirality under the symmetries that transform rope motions exactly
(`symmetry.mirror_images`), so a sequence to one code gives sequences to its whole class. A state
fills one niche for each base vertex and direction of reading. Those readings other than the normal
one are only approximate, until a replay with renumbered beads has confirmed them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import h5py
import numpy as np

from knotgym.common.atomic_files import atomic_write, new_hdf5
from knotgym.common.configuration import Count, Positive, configuration
from knotgym.common.errors import InvalidFile
from knotgym.common.hdf5_files import Column, member, opened_hdf5, read_column
from knotgym.control.action_sequence import ActionSequence
from knotgym.control.transition_counts import TransitionCounts
from knotgym.rope.model import Array
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import mirror_images

FORMAT = "knotgym-archive"
FORMAT_VERSION = 1
_COMPRESSED = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
_COLUMNS = (
    Column("code", "text", ("elites",)),
    Column("base_shift", "int64", ("elites",), least=0),
    Column("reverse", "bool", ("elites",)),
    Column("objective", "float64", ("elites",), finite=True),
    Column("length", "int64", ("elites",), least=0),
    Column("beads", "int16", ("steps",), least=0),
    Column("forces", "float32", ("steps", 3), finite=True),
    Column("state", "float64", ("elites", None), finite=True),
)


@configuration
class ArchiveConfig:
    """Which elites are kept.

    Attributes:
        kept: number of elites per class with the shortest sequences, and as many with the best
            legibility.
        fair: when legibility is compared, this many actions count as much as 1 of objective.
    """

    kept: Count = 2
    fair: Positive = 50.0


@dataclass(frozen=True, eq=False)
class Elite:
    """A state reached by play, with one reading of its code."""

    # its code with chirality, read from vertex `base_shift`, backwards if `reverse`
    code: GaussCode
    base_shift: int  # the base vertex, the start of a sub-chain
    reverse: bool  # whether the code is read towards falling bead indices
    sequence: ActionSequence  # actions from the start at rest, in the rope's own numbering of beads
    state: Array  # MuJoCo integration state at the end of the sequence, float64
    objective: float  # distance from the limits of legibility, see `Limits.objective`.

    @property
    def exact(self) -> bool:
        """Whether the code is read normally, from bead 0 forwards."""
        return self.base_shift == 0 and not self.reverse


@dataclass
class Archive:
    """Elites by class, and the history of the search."""

    # class -> elites, the shortest sequence first
    niches: dict[GaussCode, list[Elite]] = field(default_factory=dict)
    # class -> how often a rope started from it
    visits: dict[GaussCode, int] = field(default_factory=dict)
    # one row per round: total actions and known classes
    growth: list[dict[str, int]] = field(default_factory=list)
    # settings of the search that created it, as JSON
    settings: dict[str, object] = field(default_factory=dict)
    # changes of code caused by macro-actions
    transitions: TransitionCounts = field(default_factory=TransitionCounts)

    def offer(self, elite: Elite, config: ArchiveConfig) -> bool:
        """Keep an elite if it is among the shortest or most legible of its class; return whether
        the class is new.

        Legibility is compared together with length, see `ArchiveConfig.fair`.
        """

        def by_length(elite: Elite) -> tuple[float, float]:
            return len(elite.sequence), elite.objective

        def by_looks(elite: Elite) -> tuple[float, float]:
            return elite.objective + len(elite.sequence) / config.fair, len(elite.sequence)

        niche = mirror_images(elite.code)[0]
        is_new = niche not in self.niches
        rivals = [*self.niches.get(niche, []), elite]
        # exact readings replace approximate ones
        rivals = [rival for rival in rivals if rival.exact] or rivals
        short = sorted(rivals, key=by_length)[: config.kept]
        good_looking = sorted(rivals, key=by_looks)[: config.kept]
        # `in` compares identity, since Elite has eq=False
        self.niches[niche] = short + [elite for elite in good_looking if elite not in short]
        return is_new

    @property
    def origin(self) -> str:
        """The start, the rope and the engine of the sequences as JSON.

        JSON makes the settings of a file, with lists, comparable to those of a search, with tuples.
        """
        known = [self.settings.get(name) for name in ("start", "rope", "engine")]
        return json.dumps(known, sort_keys=True)

    def sure(self, code: GaussCode) -> bool:
        """Whether `code`, which has chirality, or a mirror image of it has an exact elite."""
        return any(elite.exact for elite in self.leading_to(code))

    def leading_to(self, code: GaussCode) -> list[Elite]:
        """Return the elites of the class of `code`, which has chirality."""
        return list(self.niches.get(mirror_images(code)[0], []))

    def save(self, path: str | os.PathLike[str], compress: bool = True) -> None:
        """Write the archive atomically."""
        elites = list(self._elites())
        with atomic_write(path) as temporary, new_hdf5(temporary) as file:
            file.attrs["format"], file.attrs["format_version"] = FORMAT, FORMAT_VERSION
            # stored as datasets, because an HDF5 attribute is limited to 64 kB
            file["settings"] = json.dumps(self.settings)
            file["growth"] = json.dumps(self.growth)
            file["visits"] = json.dumps(
                {niche.chiral: count for niche, count in self.visits.items()}
            )
            codes = [elite.code.chiral for elite in elites]
            file.create_dataset("code", data=codes, dtype=h5py.string_dtype("utf-8"))
            file["base_shift"] = [elite.base_shift for elite in elites]
            file["reverse"] = [elite.reverse for elite in elites]
            file["objective"] = [elite.objective for elite in elites]
            file["length"] = [len(elite.sequence) for elite in elites]
            for name, column in {
                "beads": np.concatenate([elite.sequence.beads for elite in elites]),
                "forces": np.concatenate([elite.sequence.forces for elite in elites]),
                "state": np.stack([elite.state for elite in elites]),
            }.items():
                file.create_dataset(name, data=column, **(_COMPRESSED if compress else {}))
            self.transitions.write(file.create_group("transitions"))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Archive:
        """Read an archive; raise InvalidFile if the file is another, truncated, or of an unknown
        version.
        """
        versions = (FORMAT_VERSION,)
        with opened_hdf5(
            path, what="archive", format=FORMAT, versions=versions, error=InvalidFile
        ) as file:
            visits = _json(file, "visits", dict).items()
            archive = cls(
                visits={GaussCode.parse(code): int(count) for code, count in visits},
                growth=_json(file, "growth", list),
                settings=_json(file, "settings", dict),
                transitions=TransitionCounts.read(member(file, "transitions")),
            )
            sizes: dict[str, int] = {}
            read = {column.name: read_column(file, column, sizes) for column in _COLUMNS}
            ends = np.cumsum(read["length"])
            beads, forces = read["beads"], read["forces"]
            if not len(ends) or len(beads) != int(ends[-1]):
                raise InvalidFile(f"{path} isn't a whole archive: its sequences are truncated")
            names = ("code", "base_shift", "reverse", "objective", "state")
            parts = (np.split(one, ends[:-1]) for one in (beads, forces))
            for text, shift, reverse, objective, state, *sequence in zip(
                *(read[name] for name in names), *parts, strict=True
            ):
                code, taken = GaussCode.parse(text), ActionSequence(*sequence)
                elite = Elite(code, int(shift), bool(reverse), taken, state, float(objective))
                archive.niches.setdefault(mirror_images(code)[0], []).append(elite)
            return archive

    def _elites(self) -> Iterator[Elite]:
        for elites in self.niches.values():
            yield from elites


def _json(file: h5py.File, name: str, kind: type) -> Any:
    """Read a text dataset as JSON of the given type."""
    read = json.loads(str(read_column(file, Column(name, "text", ()), {})))
    if not isinstance(read, kind):
        raise InvalidFile(f"{file.filename}: {name} should be {kind.__name__}")
    return read
