"""Moving states about: walks in the simulator that pass through many configurations, of the code
they began with and of others.

Most walks move single beads aside, which as a rule keeps the code; the others are led through
macro-actions that pass strands over each other, as the search's are. Of the frames met, those are
kept whose label is beyond doubt and whose picture shows it: as they are, opened up a little, and
opened up much.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.control.macro_actions import WaypointController, move_aside, propose, step_ropes
from knotgym.datasets.label_limits import pressed_together, visits_too_close
from knotgym.difficulty import ease
from knotgym.quality import Limits, measure
from knotgym.relaxation import relaxed
from knotgym.rope import Array, RopeConfig
from knotgym.simulation_pool import simulation_of
from knotgym.streams import Stream, generator
from knotgym.topology.crossings import count_crossings, find_crossings
from knotgym.topology.reference_labeller import pyknotid_code

WALKS = 32  # in a unit
GENTLE = 0.7  # share of walks that move beads aside
ROUNDS = ((2, 8), (12, 31), (30, 81))  # of opening up: a little, much, very much


class Walk(NamedTuple):
    """One to be made: from base `base`, drawing from stream IMAGE_WALK."""

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
    steps: int
    stride: int
    max_nx: int


@dataclass(frozen=True, eq=False)
class Frames:
    """What a unit met, walk by walk, and how.

    Attributes:
        points: float64 (m, beads, 3), metres.
        walk: int64 (m,), number of the walk.
        pulls: int64 (m,), after how many pulls.
        rounds: int64 (m,), of `relax.relaxed` then; 0 for the frame as it was.
        ease: float64 (m,), see `difficulty.ease`, the base bead left out.
        numbers, bases: int64 (w,), of all walks of the unit.
        beads: int16 (w, pulls), pulled.
        forces: float32 (w, pulls, 3), in units of the largest force.
        dropped: reason -> frames.
    """

    points: Array
    walk: NDArray[np.int64]
    steps: NDArray[np.int64]
    rounds: NDArray[np.int64]
    ease: Array
    numbers: NDArray[np.int64]
    bases: NDArray[np.int64]
    beads: NDArray[np.int16]
    forces: NDArray[np.float32]
    dropped: dict[str, int]


def stir(unit: Unit) -> Frames:
    """Make the walks of a unit; what one does depends on its number, its base and the seed
    alone.
    """
    count = len(unit.walks)
    simulation, ids = simulation_of(WALKS, RopeConfig()), np.arange(count)
    simulation.restore(unit.states, ids)
    rngs = [generator(Stream.IMAGE_WALK, unit.seed, walk.number) for walk in unit.walks]
    gentle = [bool(rng.random() < GENTLE) for rng in rngs]
    controller, alive = WaypointController(count), np.ones(count, dtype=bool)
    beads, forces = (
        np.zeros((count, unit.steps), dtype=np.int16),
        np.zeros((count, unit.steps, 3), dtype=np.float32),
    )
    met: list[tuple[int, int, int, float, Array]] = []
    dropped: Counter[str] = Counter()
    for step in range(unit.steps):
        now = simulation.points[:count]
        controller.advance(now)
        for row in np.flatnonzero(controller.idle):
            rng = rngs[row]
            if gentle[row]:
                kind = "spread" if rng.random() < 0.6 else "shift"
                macro_action = move_aside(
                    now[row], kind, int(rng.integers(now.shape[1])), int(rng.choice((-1, 1))), rng
                )
            else:
                macro_action = propose(now[row], rng)
            controller.begin(int(row), macro_action)
        controller.advance(now)
        beads[:, step], forces[:, step] = controller.beads, controller.forces(now)
        _, held = step_ropes(simulation, beads[:, step], forces[:, step], ids)
        alive &= held
        if (step + 1) % unit.stride:
            continue
        for row in np.flatnonzero(alive):
            frame = simulation.points[row].copy()
            if count_crossings(frame) > unit.max_nx:
                dropped["crossings"] += 1
                continue
            for rounds in (0, *(int(rngs[row].integers(*some)) for some in ROUNDS)):
                points: Array | None = relaxed(frame, rounds, simulation.rope) if rounds else frame
                fault, easy = ("can't be opened up", 0.0) if points is None else judged(points)
                if points is None or fault:
                    dropped[fault] += 1
                else:
                    met.append((int(row), step + 1, rounds, easy, points))
    met.sort(key=lambda one: one[:3])
    return Frames(
        points=np.array([one[4] for one in met]).reshape(-1, *simulation.points.shape[1:]),
        walk=np.array([unit.walks[one[0]].number for one in met], dtype=np.int64),
        steps=np.array([one[1] for one in met], dtype=np.int64),
        rounds=np.array([one[2] for one in met], dtype=np.int64),
        ease=np.array([one[3] for one in met]),
        numbers=np.array([walk.number for walk in unit.walks], dtype=np.int64),
        bases=np.array([walk.base for walk in unit.walks], dtype=np.int64),
        beads=beads,
        forces=forces,
        dropped=dict(sorted(dropped.items())),
    )


def judged(points: Array) -> tuple[str, float]:
    """Why a configuration (beads, 3) can't be shown with its label, "" if it can, and its ease; the
    base bead, chosen later, left out.
    """
    found = find_crossings(points)
    if visits_too_close(found, len(points)):
        return "visits too close", 0.0
    quality = replace(measure(points, found, quick=True), base_spacing=float("inf"))
    if pressed_together(quality.clearance):
        return "strands pressed together", 0.0
    if quality.margin < 0:
        return "out of the picture", 0.0
    return "" if pyknotid_code(points) == found.code else "labellers disagree", ease(
        quality, Limits()
    )
