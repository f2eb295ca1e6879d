"""The states that perception pictures set out from: an archive's elites or curated states, grouped
into families.

States that are near-duplicates of each other, or of each other's mirror images, reversals or
renumberings, are one family; a family belongs to one split, with everything that is made from it.
The plain loop is the exception: every state comes from it, so each walk that sets out from a state
without crossings is a family of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from knotgym.atomic_files import sha256
from knotgym.datasets.near_duplicates import NEAR
from knotgym.datasets.states import read_states, shipped
from knotgym.errors import KnotgymError
from knotgym.generate.states.archive import Archive
from knotgym.rope import Array, Rope
from knotgym.simulation import Simulation
from knotgym.topology.crossings import label
from knotgym.topology.knots import knot_type
from knotgym.topology.symmetry import canonical_form


class NoSeedStates(KnotgymError, ValueError):
    """There is nothing to set out from."""


@dataclass(frozen=True, eq=False)
class SeedStates:
    """n states, at most as many families.

    Attributes:
        states: float64 (n, nstate), integration states.
        points: float64 (n, beads, 3), metres.
        nx: int64 (n,), crossings.
        kind: int64 (n,), number of the class of codes under the rope's symmetries.
        family: int64 (n,).
        knots: knot types among them.
        source: what they were read from: kind, name and SHA-256 of the file.
    """

    states: Array
    points: Array
    nx: NDArray[np.int64]
    kind: NDArray[np.int64]
    family: NDArray[np.int64]
    knots: tuple[str, ...]
    source: dict[str, str]

    def __len__(self) -> int:
        return len(self.states)


def seed_states(
    nx: tuple[int, ...], archive: Path | None = None, states: Path | None = None
) -> SeedStates:
    """Read the states with at most as many crossings as are wanted; the curated states that ship
    unless another file is given.

    Raises:
        NoSeedStates: both files were given, or nothing in them will do.
        FileNotFoundError, InvalidArchive, InvalidStates: of a file.
    """
    if archive and states:
        raise NoSeedStates(
            "set out from an archive or from states, not from both: give --archive or --states"
        )
    simulation = Simulation(1, Rope())
    if archive:
        elites = [
            elite
            for niche, elites in Archive.load(archive).niches.items()
            for elite in elites
            if niche.nx <= max(nx)
        ]
        rows = [
            elite.state for elite in {elite.state.tobytes(): elite for elite in elites}.values()
        ]
        if rows and len(rows[0]) != simulation.states().shape[1]:
            raise NoSeedStates(
                f"{archive} was made with another rope: its states have {len(rows[0])} numbers,"
                f" this rope's {simulation.states().shape[1]}"
            )
    else:
        table = read_states(states or shipped(), images=False)
        if table.attributes.get("rope") != simulation.rope.config.fingerprint:
            raise NoSeedStates(
                f"{states} was made with another rope, {table.attributes.get('rope')}; this one is"
                f" {simulation.rope.config.fingerprint}"
            )
        rows = []
        for qpos in table.qpos[table.nx <= max(nx)]:
            simulation.lay(qpos[None])
            rows.append(simulation.states()[0])
    if not rows:
        raise NoSeedStates(f"{archive or states} holds no state with at most {max(nx)} crossings")
    points = []
    for row in rows:
        simulation.restore(row[None])
        points.append(simulation.points[0].copy())
    codes = [label(one) for one in points]
    kinds = {
        code: number
        for number, code in enumerate(
            sorted(
                {canonical_form(code) for code in codes}, key=lambda code: (code.nx, code.chiral)
            )
        )
    }
    path = archive or states or shipped()
    return SeedStates(
        states=np.stack(rows),
        points=np.stack(points),
        nx=np.array([code.nx for code in codes], dtype=np.int64),
        kind=np.array([kinds[canonical_form(code)] for code in codes], dtype=np.int64),
        family=families(np.stack(points), NEAR),
        knots=tuple(sorted({knot_type(code) for code in codes})),
        source={
            "kind": "archive" if archive else "states",
            "name": path.name,
            "sha256": sha256(path),
        },
    )


def families(points: Array, within: float) -> NDArray[np.int64]:
    """Number configurations so that those nearer than `within` in any of their symmetric forms
    share a number.

    Args:
        points: float64 (n, beads, 3), metres.
        within: root mean square distance of the beads at the best turn, shift, reflection, switch,
            reversal and renumbering, metres.
    """
    centred = points - points.mean(axis=1, keepdims=True)
    flat, height = centred[..., 0] + 1j * centred[..., 1], centred[..., 2]
    square = (centred**2).sum(axis=(1, 2))
    # rms distance from the centre; differs by less than `within` between kin
    size = np.sqrt(square / points.shape[1])
    waves = np.fft.fft(flat), np.fft.fft(flat.conj()), np.fft.fft(height)
    leader = np.arange(len(points))
    for i in range(len(points)):
        others = i + 1 + np.flatnonzero(np.abs(size[i + 1 :] - size[i]) < within)
        if not len(others):
            continue
        best = np.full(len(others), -np.inf)
        for backwards in (False, True):
            own_flat, own_height = (
                np.fft.fft(one[i, ::-1] if backwards else one[i]) for one in (flat, height)
            )
            tall = np.fft.ifft(
                waves[2][others] * own_height.conj()
            ).real  # over all renumberings at once
            for wave in waves[:2]:
                agreement = np.abs(np.fft.ifft(wave[others] * own_flat.conj())) + np.abs(tall)
                best = np.maximum(best, agreement.max(axis=1))
        apart = np.sqrt(np.maximum(0.0, square[i] + square[others] - 2 * best) / points.shape[1])
        for j in others[apart < within]:
            leader[leader == leader[j]] = leader[i]
    return np.unique(leader, return_inverse=True)[1].astype(np.int64)
