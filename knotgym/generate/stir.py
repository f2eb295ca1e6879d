"""Moving states about: walks in the simulator that pass through many configurations, of the code they began with and of others.

Half of the walks are led through manoeuvres that pass strands over each other, as the search's are; the other half moves single
beads aside, which mostly keeps the code. Of the frames met, those are kept whose label is beyond doubt and whose picture shows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.crossings import find_crossings, visit_spacing
from knotgym.generate.manoeuvres import Hand, move_aside, propose, pull
from knotgym.generate.quality import measure
from knotgym.oracle import pyknotid_code
from knotgym.rope import Array, Rope
from knotgym.simulation import Simulation

WALKS = 32  # in a unit

# What a frame must keep to, lest its label be in doubt or its picture untrue.
VISITS = 0.25  # beads along the rope between two visits, 3 mm; rounding moves them by 1e-12 of that
BASE = 0.25  # beads from the base bead's start to the nearest visit: 3 mm
CLEARANCE = 7.0  # millimetres between the axes at a crossing, from which the order of painting is true (see picture)


class Walk(NamedTuple):
    """One to be made: from base `base`, drawing from SeedSequence([seed, 6, number])."""

    number: int
    base: int


@dataclass(frozen=True, eq=False)
class Unit:
    """Up to WALKS walks.

    Attributes:
        walks: which.
        states: float64 (walks, nstate), where they begin.
        seed: of the job.
        pulls: that a walk makes.
        stride: pulls from one frame looked at to the next.
        max_nx: crossings above which a frame is dropped.
    """

    walks: tuple[Walk, ...]
    states: Array
    seed: int
    pulls: int
    stride: int
    max_nx: int


@dataclass(frozen=True, eq=False)
class Frames:
    """What a unit met, walk by walk, and how.

    Attributes:
        points: float64 (m, beads, 3), metres.
        walk: int64 (m,), number of the walk.
        pulls: int64 (m,), after how many pulls.
        numbers: int64 (w,), of all walks of the unit.
        beads: int16 (w, pulls), pulled.
        forces: float32 (w, pulls, 3), in units of the largest force.
        dropped: reason -> frames.
    """

    points: Array
    walk: NDArray[np.int64]
    pulls: NDArray[np.int64]
    numbers: NDArray[np.int64]
    beads: NDArray[np.int16]
    forces: NDArray[np.float32]
    dropped: dict[str, int]


def stir(unit: Unit) -> Frames:
    """Make the walks of a unit; what one does depends on its number, its base and the seed alone."""
    count = len(unit.walks)
    simulation, ids = _simulation(), np.arange(count)
    simulation.restore(unit.states, ids)
    rngs = [np.random.default_rng([unit.seed, 6, walk.number]) for walk in unit.walks]
    gentle = [bool(rng.random() < 0.5) for rng in rngs]
    hand, alive = Hand(count), np.ones(count, dtype=bool)
    beads, forces = np.zeros((count, unit.pulls), dtype=np.int16), np.zeros((count, unit.pulls, 3), dtype=np.float32)
    met: list[tuple[int, int, Array]] = []
    dropped: dict[str, int] = {}
    for step in range(unit.pulls):
        points = simulation.points[:count]
        for row in np.flatnonzero(hand.idle(points)):
            rng = rngs[row]
            if gentle[row]:
                kind = "spread" if rng.random() < 0.6 else "shift"
                manoeuvre = move_aside(points[row], kind, int(rng.integers(points.shape[1])), int(rng.choice((-1, 1))), rng)
            else:
                manoeuvre = propose(points[row], rng)
            hand.take(int(row), manoeuvre)
        hand.idle(points)
        beads[:, step], forces[:, step] = hand.beads, hand.forces(points)
        _, held = pull(simulation, beads[:, step], forces[:, step], ids)
        alive &= held
        if (step + 1) % unit.stride:
            continue
        for row in np.flatnonzero(alive):
            fault = doubt(simulation.points[row], unit.max_nx)
            if fault:
                dropped[fault] = dropped.get(fault, 0) + 1
            else:
                met.append((int(row), step + 1, simulation.points[row].copy()))
    met.sort(key=lambda one: one[:2])
    return Frames(
        points=np.array([points for _, _, points in met]).reshape(-1, *simulation.points.shape[1:]),
        walk=np.array([unit.walks[row].number for row, _, _ in met], dtype=np.int64),
        pulls=np.array([pulls for _, pulls, _ in met], dtype=np.int64),
        numbers=np.array([walk.number for walk in unit.walks], dtype=np.int64),
        beads=beads,
        forces=forces,
        dropped=dict(sorted(dropped.items())),
    )


def doubt(points: Array, max_nx: int) -> str:
    """Why a configuration (beads, 3) can't be shown with its label; "" if it can. The base bead doesn't count: it is chosen later."""
    found = find_crossings(points)
    if found.nx > max_nx:
        return "crossings"
    if visit_spacing(found, len(points)).visits < VISITS:
        return "visits too close"
    quality = measure(points, found, quick=True)
    if quality.clearance < CLEARANCE:
        return "strands pressed together"
    if quality.margin < 0:
        return "out of the picture"
    return "" if pyknotid_code(points) == found.code else "labellers disagree"


def retrace(states: Array, beads: NDArray[np.int16], forces: NDArray[np.float32]) -> Array:
    """Make walks again: float64 (walks, pulls + 1, beads, 3), metres, where they were after each pull.

    Args:
        states: float64 (walks, nstate), at most WALKS; where they begin.
        beads, forces: as in Frames.
    """
    simulation, ids = _simulation(), np.arange(len(states))
    simulation.restore(states, ids)
    out = [simulation.points[ids].copy()]
    for step in range(beads.shape[1]):
        pull(simulation, beads[:, step], forces[:, step], ids)
        out.append(simulation.points[ids].copy())
    return np.stack(out, axis=1)


@lru_cache(maxsize=1)
def _simulation() -> Simulation:
    return Simulation(WALKS, Rope())
