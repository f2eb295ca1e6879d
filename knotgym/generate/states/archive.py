"""The archive of the search: for every class of Gauss codes its shortest and best-looking states.

Quality-diversity search in the line of MAP-Elites (niches) and Go-Explore (return, then explore). A
niche is a class of codes, chirality kept, under the symmetries that carry rope motions over exactly
(`symmetry.mirror_images`): what is found for one code is found for all of its class. A state fills
a niche for each sub-chain that the walk may start at, and for each direction of the walk; those
other than its own hold nearly, until the search has led a rope there.
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
from knotgym.common.configuration import check_numbers
from knotgym.common.errors import KnotgymError
from knotgym.common.hdf5_files import Column, member, opened_hdf5, read_column
from knotgym.control.action_sequence import ActionSequence
from knotgym.control.transition_counts import TransitionCounts
from knotgym.rope.model import Array
from knotgym.topology.diagrams import chiralities
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


class InvalidArchive(KnotgymError, ValueError):
    """A file that isn't an archive this version can read."""


@dataclass(frozen=True, kw_only=True)
class ArchiveConfig:
    """Which elites are kept.

    Attributes:
        kept: elites of a class kept for their short sequence, and as many for their looks.
        fair: actions that 1 of objective is worth when looks are compared.
    """

    kept: int = 2
    fair: float = 50.0

    def __post_init__(self) -> None:
        check_numbers(self, counts=("kept",), positive=("fair",))


@dataclass(frozen=True, eq=False)
class Elite:
    """A state the search has been in.

    Attributes:
        code: what it shows, with chirality, walked from vertex `base_shift`, the other way if
            `reverse`.
        base_shift: a vertex where a sub-chain starts.
        reverse: the walk runs towards falling index.
        sequence: of actions from the plain loop at rest, beads numbered as there.
        state: MuJoCo integration state at the end of the sequence, float64.
        objective: how far from legible, see `Limits.objective`.
    """

    code: GaussCode
    base_shift: int
    reverse: bool
    sequence: ActionSequence
    state: Array
    objective: float

    @property
    def exact(self) -> bool:
        """Whether the code is that of the rope as it is numbered."""
        return self.base_shift == 0 and not self.reverse


@dataclass
class Archive:
    """Elites by class, and how they came to be.

    Attributes:
        niches: class -> elites, the shortest sequence first.
        visits: class -> how often the search set out from it.
        growth: one row a round: actions taken so far, classes known by then.
        settings: of the search that began it, JSON-able.
        transitions: what the macro-actions of the search did to codes.
    """

    niches: dict[GaussCode, list[Elite]] = field(default_factory=dict)
    visits: dict[GaussCode, int] = field(default_factory=dict)
    growth: list[dict[str, int]] = field(default_factory=list)
    settings: dict[str, object] = field(default_factory=dict)
    transitions: TransitionCounts = field(default_factory=TransitionCounts)

    def offer(self, elite: Elite, config: ArchiveConfig) -> bool:
        """Keep an elite if it is among the shortest or best-looking of its class.

        Looks are paid for with actions, as the configuration says.

        Returns:
            Whether the class is new.
        """

        def by_length(elite: Elite) -> tuple[float, float]:
            return len(elite.sequence), elite.objective

        def by_looks(elite: Elite) -> tuple[float, float]:
            return elite.objective + len(elite.sequence) / config.fair, len(elite.sequence)

        niche = mirror_images(elite.code)[0]
        is_new = niche not in self.niches
        rivals = [*self.niches.get(niche, []), elite]
        # what holds for this very base bead beats what holds nearly
        rivals = [rival for rival in rivals if rival.exact] or rivals
        short = sorted(rivals, key=by_length)[: config.kept]
        good_looking = sorted(rivals, key=by_looks)[: config.kept]
        # elites are the same only if they are one object
        self.niches[niche] = short + [elite for elite in good_looking if elite not in short]
        return is_new

    def codes(self, nx: int) -> list[GaussCode]:
        """Every code with nx crossings, without chirality, of the classes known; in order."""
        niches = [niche for niche in self.niches if niche.nx == nx]
        known = {image.plain for niche in niches for image in mirror_images(niche)}
        return sorted(known, key=lambda code: code.visits)

    def known_chiralities(self, code: GaussCode) -> list[GaussCode]:
        """The codes with chirality that show the visits of `code` and are known."""
        chiral = [GaussCode(code.visits, letters) for letters in chiralities(code)]
        return [code for code in chiral if mirror_images(code)[0] in self.niches]

    def sure(self, code: GaussCode, longest: float = float("inf")) -> bool:
        """Whether an elite shows a mirror image of `code` as the rope is numbered.

        Args:
            code: with chirality.
            longest: sequence that the elite may have.
        """
        return any(
            elite.exact and len(elite.sequence) <= longest for elite in self.leading_to(code)
        )

    def leading_to(self, code: GaussCode) -> list[Elite]:
        """Elites whose mirror images show `code`, given with chirality."""
        return list(self.niches.get(mirror_images(code)[0], []))

    def save(self, path: str | os.PathLike[str], compress: bool = True) -> None:
        """Write the archive; it appears whole or not at all."""
        elites = list(self._elites())
        with atomic_write(path) as temporary, new_hdf5(temporary) as file:
            file.attrs["format"], file.attrs["format_version"] = FORMAT, FORMAT_VERSION
            # datasets: an attribute holds 64 kB at most
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
        """Read an archive.

        Raises:
            MissingFile: there is none.
            InvalidArchive: the file is foreign, truncated, or of an unknown format.
        """
        with opened_hdf5(
            path,
            what="archive",
            format=FORMAT,
            versions=(FORMAT_VERSION,),
            error=InvalidArchive,
        ) as file:
            archive = cls(
                visits={
                    GaussCode.parse(code): int(count)
                    for code, count in _json(file, "visits", dict).items()
                },
                growth=_json(file, "growth", list),
                settings=_json(file, "settings", dict),
                transitions=TransitionCounts.read(member(file, "transitions")),
            )
            sizes: dict[str, int] = {}
            read = {column.name: read_column(file, column, sizes) for column in _COLUMNS}
            ends = np.cumsum(read["length"])
            beads, forces = read["beads"], read["forces"]
            if not len(ends) or len(beads) != int(ends[-1]):
                raise InvalidArchive(f"{path} isn't a whole archive: its sequences are cut short")
            rows = zip(
                *(read[name] for name in ("code", "base_shift", "reverse", "objective", "state")),
                np.concatenate([[0], ends[:-1]]),
                ends,
                strict=True,
            )
            for text, base_shift, reverse, objective, state, start, end in rows:
                code = GaussCode.parse(text)
                sequence = ActionSequence(beads[start:end], forces[start:end])
                elite = Elite(
                    code, int(base_shift), bool(reverse), sequence, state, float(objective)
                )
                archive.niches.setdefault(mirror_images(code)[0], []).append(elite)
            return archive

    def _elites(self) -> Iterator[Elite]:
        for elites in self.niches.values():
            yield from elites


def _json(file: h5py.File, name: str, kind: type) -> Any:
    """A text of the file read as JSON."""
    read = json.loads(str(read_column(file, Column(name, "text", ()), {})))
    if not isinstance(read, kind):
        raise InvalidArchive(f"{file.filename}: {name} should be {kind.__name__}")
    return read
