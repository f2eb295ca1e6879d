"""The archive of the search: for every class of Gauss codes the shortest ways there and the
best-looking states.

Quality-diversity search in the line of MAP-Elites (niches) and Go-Explore (return, then explore). A
niche is a class of codes, chirality kept, under the symmetries that carry rope motions over exactly
(`symmetry.mirror_images`): what is found for one code is found for all of its class. A state fills
a niche for each sub-chain that the walk may start at, and for each way round; those other than its
own hold nearly, until the search has led a rope there.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field

import h5py
import numpy as np

from knotgym.atomic_files import atomic_write, new_hdf5
from knotgym.control.macro_actions import ActionSequence
from knotgym.control.transition_counts import TransitionCounts
from knotgym.errors import KnotgymError
from knotgym.hdf5_files import opened_hdf5
from knotgym.rope import Array
from knotgym.topology.diagrams import chiralities
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import mirror_images

FORMAT = "knotgym-archive"
FORMAT_VERSION = 3
_OLD = {"base_shift": "roll", "objective": "badness"}  # what version 2, read too, calls them
FAIR = 50  # actions that 1 of objective is worth
KEPT = 2  # elites kept for their short way, and as many for their looks


class InvalidArchive(KnotgymError, ValueError):
    """A file that isn't an archive this version can read."""


@dataclass(frozen=True, eq=False)
class Elite:
    """A state the search has been in.

    Attributes:
        code: what it shows, with chirality, walked from vertex `base_shift`, the other way if
        `reverse`.
        base_shift: a vertex where a sub-chain starts.
        reverse: the walk runs towards falling index.
        way: from the plain loop at rest, beads numbered as there.
        state: MuJoCo integration state at the end of the way, float64.
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
        niches: class -> elites, the shortest way first.
        visits: class -> how often the search set out from it.
        growth: one row a round: actions taken so far, classes known by then.
        settings: of the search, JSON-able; a resumed search must agree with them.
        transitions: what the macro-actions of the search did to codes.
    """

    niches: dict[GaussCode, list[Elite]] = field(default_factory=dict)
    visits: dict[GaussCode, int] = field(default_factory=dict)
    growth: list[dict[str, int]] = field(default_factory=list)
    settings: dict[str, object] = field(default_factory=dict)
    transitions: TransitionCounts = field(default_factory=TransitionCounts)

    def offer(self, elite: Elite) -> bool:
        """Keep an elite if it is among the KEPT shortest or the KEPT best-looking of its class; say
        whether the class is new.

        Looks are paid for with actions: FAIR of them for 1 of objective.
        """
        niche = mirror_images(elite.code)[0]
        new = niche not in self.niches
        pool = [*self.niches.get(niche, []), elite]
        if any(
            one.exact for one in pool
        ):  # a way that holds for this very base bead beats those that hold nearly
            pool = [one for one in pool if one.exact]
        short = sorted(pool, key=lambda one: (len(one.sequence), one.objective))[:KEPT]
        pretty = sorted(
            pool, key=lambda one: (one.objective + len(one.sequence) / FAIR, len(one.sequence))
        )[:KEPT]
        self.niches[niche] = short + [
            one for one in pretty if not any(one is other for other in short)
        ]
        return new

    def codes(self, nx: int) -> list[GaussCode]:
        """Every code with nx crossings, without chirality, of the classes known; in order."""
        found = {
            member.plain
            for niche in self.niches
            if niche.nx == nx
            for member in mirror_images(niche)
        }
        return sorted(found, key=lambda code: code.visits)

    def handed(self, code: GaussCode) -> list[GaussCode]:
        """The codes with chirality that show the visits of `code` and are known."""
        return [
            one
            for letters in chiralities(code)
            if mirror_images(one := GaussCode(code.visits, letters))[0] in self.niches
        ]

    def sure(self, code: GaussCode, longest: float = float("inf")) -> bool:
        """Whether an elite with a way of at most `longest` shows a mirror image of `code`, which
        has its chirality, as the rope is numbered.
        """
        return any(one.exact and len(one.sequence) <= longest for one in self.leading_to(code))

    def leading_to(self, code: GaussCode) -> list[Elite]:
        """Elites whose mirror images show `code`, which has its chirality."""
        return list(self.niches.get(mirror_images(code)[0], []))

    def save(self, path: str | os.PathLike[str]) -> None:
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
            squeezed = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
            file.create_dataset(
                "code",
                data=[elite.code.chiral for elite in elites],
                dtype=h5py.string_dtype("utf-8"),
            )
            file.create_dataset("base_shift", data=[elite.base_shift for elite in elites])
            file.create_dataset("reverse", data=[elite.reverse for elite in elites])
            file.create_dataset("objective", data=[elite.objective for elite in elites])
            file.create_dataset("length", data=[len(elite.sequence) for elite in elites])
            file.create_dataset(
                "beads", data=np.concatenate([elite.sequence.beads for elite in elites]), **squeezed
            )
            file.create_dataset(
                "forces",
                data=np.concatenate([elite.sequence.forces for elite in elites]),
                **squeezed,
            )
            file.create_dataset(
                "state", data=np.stack([elite.state for elite in elites]), **squeezed
            )
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
            versions=(2, FORMAT_VERSION),
            error=InvalidArchive,
        ) as file:
            old = file.attrs["format_version"] == 2
            names = _OLD if old else {name: name for name in _OLD}
            archive = cls(
                visits={
                    GaussCode.parse(code): int(count)
                    for code, count in json.loads(file["visits"][()]).items()
                },
                growth=json.loads(file["growth"][()]),
                settings=json.loads(file["settings"][()]),
                transitions=(
                    TransitionCounts.read(file["transitions"])
                    if "transitions" in file
                    else TransitionCounts()
                ),
            )
            ends = np.cumsum(file["length"][()])
            beads, forces, states = file["beads"][()], file["forces"][()], file["state"][()]
            if {len(beads), len(forces)} != {int(ends[-1])}:
                raise InvalidArchive(f"{path} isn't a whole archive: its sequences are cut short")
            rows = zip(
                file["code"].asstr()[()],
                file[names["base_shift"]][()],
                file["reverse"][()],
                file[names["objective"]][()],
                states,
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
