"""Seed states: the start states of walks for pictures, grouped into families.

They are the elites of an archive or the states of a state file. States that are near-duplicates,
up to mirror images, reversal and renumbering, form a family. A family and all pictures made from it
belong to one split. The exception is the plain loop, from which every state comes: each walk from a
state without crossings is a family of its own.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import sha256
from knotgym.common.errors import InvalidInput
from knotgym.rope.engines import MUJOCO, simulation_of
from knotgym.rope.model import Array, RopeConfig
from knotgym.rope.simulation import Simulation
from knotgym.states.near_duplicates import families
from knotgym.states.state_file import read_states, shipped
from knotgym.topology.crossings import label
from knotgym.topology.knots import knot_type
from knotgym.topology.symmetry import canonical_form


@dataclass(frozen=True, eq=False)
class SeedStates:
    """Start states for walks."""

    states: Array  # float64 (n, nstate), integration states
    points: Array  # float64 (n, beads, 3), metres
    nx: NDArray[np.int64]  # int64 (n,), numbers of crossings
    kind: NDArray[np.int64]  # int64 (n,), index of the class of codes under the rope's symmetries
    family: NDArray[np.int64]  # int64 (n,), index of the family
    knots: tuple[str, ...]  # knot types of the states
    source: dict[str, str]  # kind, name and SHA-256 of the file that they were read from

    def __len__(self) -> int:
        return len(self.states)


def seed_states(
    nx: tuple[int, ...],
    archive: Path | None = None,
    states: Path | None = None,
    engine: str = MUJOCO,
) -> SeedStates:
    """Read the states that have at most max(nx) crossings from an archive of play or a state file.

    Without either, the included states are used. An archive must be of the same engine.

    Raises:
        InvalidInput: both files were given, or there is no suitable state.
    """
    if archive and states:
        raise InvalidInput(
            "walks start from an archive or from states, not both: give --archive or --states"
        )
    simulation = simulation_of(1, RopeConfig(), engine)
    path = archive or states or shipped()
    kind, read = ("archive", _archived) if archive else ("states", _curated)
    found = read(path, max(nx), simulation)
    if not found:
        raise InvalidInput(f"{path} contains no state with at most {max(nx)} crossings")
    points = []
    for state in found:
        simulation.restore(state[None])
        points.append(simulation.points[0].copy())
    codes = [label(configuration) for configuration in points]
    classes = sorted(
        {canonical_form(code) for code in codes}, key=lambda code: (code.nx, code.chiral)
    )
    return SeedStates(
        states=np.stack(found),
        points=np.stack(points),
        nx=np.array([code.nx for code in codes], dtype=np.int64),
        kind=np.array([classes.index(canonical_form(code)) for code in codes], dtype=np.int64),
        family=families(np.stack(points)),
        knots=tuple(sorted({knot_type(code) for code in codes})),
        source={"kind": kind, "name": path.name, "sha256": sha256(path)},
    )


def _archived(path: Path, max_nx: int, simulation: Simulation) -> list[Array]:
    raise InvalidInput(f"archives of play are no longer made; give states instead of {path}")


def _curated(path: Path, max_nx: int, simulation: Simulation) -> list[Array]:
    """Return the integration states of a state file's states, at rest."""
    table, rope = read_states(path, images=False), simulation.rope.config.fingerprint
    if table.attributes.get("rope") != rope:
        raise InvalidInput(
            f"{path} was made with another rope, {table.attributes.get('rope')}; this one is {rope}"
        )
    found = []
    for qpos in table.qpos[table.nx <= max_nx]:
        simulation.lay(qpos[None])
        found.append(simulation.states()[0])
    return found
