"""Walks: move seed states through configurations with many codes in the simulator.

Most walks move single beads aside, which usually keeps the code; the others use macro-actions that
pass strands over each other, as in play. WalkFrames are kept, unrelaxed and with several degrees of
relaxation, if their Gauss code is unambiguous and visible in the picture.
"""

from collections import Counter
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import Share, configuration
from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream, generator
from knotgym.control.action_sequence import step_ropes
from knotgym.quality.difficulty import ease
from knotgym.quality.label_limits import LabelLimits, pressed_together, visits_too_close
from knotgym.quality.measures import Limits, measure
from knotgym.rope.engines import simulation_of
from knotgym.rope.macro_action_config import MacroActionConfig
from knotgym.rope.macro_actions import MacroAction, WaypointController, move_aside, propose
from knotgym.rope.model import Array, Rope, RopeConfig
from knotgym.rope.relaxation import RelaxationConfig, relaxed
from knotgym.topology.crossings import count_crossings, find_crossings
from knotgym.topology.reference_labeller import pyknotid_code

WALKS = 32  # per unit


@configuration
class WalkConfig:
    """How walks are made and which frames are kept.

    Attributes:
        gentle: share of walks that move beads aside; the others use all macro-actions.
        spread: share of a gentle walk's macro-actions that pull outwards; the others pull anywhere.
        relaxations: minimum and maximum rounds of each relaxed copy of a frame, made besides the
            frame itself.
        limits: limits of kept frames.
        relaxation: settings of a round of relaxation.
        macro_actions: how macro-actions are drawn and executed.
    """

    gentle: Share = 0.7
    spread: Share = 0.6
    relaxations: tuple[tuple[int, int], ...] = ((2, 7), (12, 30), (30, 80))
    limits: LabelLimits = LabelLimits()
    relaxation: RelaxationConfig = RelaxationConfig()
    macro_actions: MacroActionConfig = MacroActionConfig()

    def __post_init__(self) -> None:
        if not all(1 <= least <= most for least, most in self.relaxations):
            raise InvalidInput(
                "relaxations must be pairs of at least 1 round, the smaller number first; got"
                f" {self.relaxations}"
            )


class Walk(NamedTuple):
    """A walk from row `base` of the seed states; it draws from stream IMAGE_WALK, `number`."""

    number: int
    base: int


@dataclass(frozen=True, eq=False)
class Unit:
    """Up to WALKS walks."""

    walks: tuple[Walk, ...]  # the walks
    states: Array  # float64 (walks, nstate), their start states
    seed: int  # random seed of the run
    steps: int  # steps per walk
    stride: int  # steps between examined frames
    max_nx: int  # frames with more crossings are dropped
    engine: str  # moves the ropes
    config: WalkConfig  # how walks are made


@dataclass(frozen=True, eq=False)
class WalkFrames:
    """The m kept frames of a unit of w walks, by walk, and how to reproduce them."""

    points: Array  # float64 (m, beads, 3), metres
    walk: NDArray[np.int64]  # int64 (m,), number of the walk
    steps: NDArray[np.int64]  # int64 (m,), steps before the frame
    # int64 (m,), rounds of `relaxation.relaxed`; 0 for an unrelaxed frame.
    rounds: NDArray[np.int64]
    ease: Array  # float64 (m,), see `difficulty.ease`, without the base bead.
    number: NDArray[np.int64]  # int64 (w,), fields of the unit's walks
    start: NDArray[np.int64]
    beads: NDArray[np.int16]  # int16 (w, steps), bead pulled at each step
    forces: NDArray[np.float32]  # float32 (w, steps, 3), relative to the largest force
    dropped: dict[str, int]  # reason -> number of dropped frames


class _Met(NamedTuple):
    """A kept frame of walk `row` of the unit, after some steps and rounds of relaxation."""

    row: int
    steps: int
    rounds: int
    ease: float
    points: Array


def make_walks(unit: Unit) -> WalkFrames:
    """Make the walks of a unit; each depends on its number, its seed state and the seed alone."""
    count, config = len(unit.walks), unit.config
    simulation, ids = simulation_of(WALKS, RopeConfig(), unit.engine), np.arange(count)
    simulation.restore(unit.states, ids)
    rngs = [generator(Stream.IMAGE_WALK, unit.seed, walk.number) for walk in unit.walks]
    gentle = [bool(rng.random() < config.gentle) for rng in rngs]
    controller = WaypointController(count, config.macro_actions)
    alive = np.ones(count, dtype=bool)
    beads = np.zeros((count, unit.steps), dtype=np.int16)
    forces = np.zeros((count, unit.steps, 3), dtype=np.float32)
    met: list[_Met] = []
    dropped: Counter[str] = Counter()
    for step in range(unit.steps):
        points = simulation.points[:count]
        # A controller is idle when its macro-action has ended; advancing again turns a new one into
        # the bead and force of this step.
        controller.advance(points)
        for row in np.flatnonzero(controller.idle).tolist():
            draw = _gentle_action if gentle[row] else _any_action
            controller.begin(row, draw(points[row], rngs[row], config))
        controller.advance(points)
        beads[:, step], forces[:, step] = controller.beads, controller.forces(points)
        _, held = step_ropes(simulation, beads[:, step], forces[:, step], ids)
        alive &= held
        if (step + 1) % unit.stride:
            continue
        # A simulation that blew up is not examined again; its walk keeps its place in the batch.
        for row in np.flatnonzero(alive).tolist():
            frame = simulation.points[row].copy()
            if count_crossings(frame) > unit.max_nx:
                dropped["crossings"] += 1
                continue
            for rounds in _rounds(rngs[row], config):
                fault, legible, shown = _shown(frame, rounds, simulation.rope, config)
                if fault:
                    dropped[fault] += 1
                else:
                    met.append(_Met(row, step + 1, rounds, legible, shown))
    met.sort(key=lambda frame: (frame.row, frame.steps, frame.rounds))
    return WalkFrames(
        points=np.array([frame.points for frame in met]).reshape(-1, *simulation.points.shape[1:]),
        walk=np.array([unit.walks[frame.row].number for frame in met], dtype=np.int64),
        steps=np.array([frame.steps for frame in met], dtype=np.int64),
        rounds=np.array([frame.rounds for frame in met], dtype=np.int64),
        ease=np.array([frame.ease for frame in met]),
        number=np.array([walk.number for walk in unit.walks], dtype=np.int64),
        start=np.array([walk.base for walk in unit.walks], dtype=np.int64),
        beads=beads,
        forces=forces,
        dropped=dict(sorted(dropped.items())),
    )


def _gentle_action(points: Array, rng: np.random.Generator, config: WalkConfig) -> MacroAction:
    """Draw a macro-action that moves a bead aside, which usually keeps the code."""
    kind = "spread" if rng.random() < config.spread else "shift"
    bead, side = int(rng.integers(len(points))), int(rng.choice((-1, 1)))
    return move_aside(points, kind, bead, side, rng, config.macro_actions)


def _any_action(points: Array, rng: np.random.Generator, config: WalkConfig) -> MacroAction:
    return propose(points, rng, config.macro_actions)


def _rounds(rng: np.random.Generator, config: WalkConfig) -> list[int]:
    """Draw the rounds of relaxation for each copy of a frame; the first is unrelaxed."""
    return [0, *(int(rng.integers(least, most + 1)) for least, most in config.relaxations)]


def _shown(frame: Array, rounds: int, rope: Rope, config: WalkConfig) -> tuple[str, float, Array]:
    """Relax a frame; return its fault ("" for none), its ease, and the points."""
    points = relaxed(frame, rounds, rope, config.relaxation) if rounds else frame
    if points is None:
        return "can't be relaxed", 0.0, frame
    return *judged(points, config.limits), points


def judged(points: Array, limits: LabelLimits) -> tuple[str, float]:
    """Return why a configuration's picture may not show its code ("" if it does), and its ease.

    The base bead is chosen later, so its limits don't count here.
    """
    crossings = find_crossings(points)
    if visits_too_close(crossings, len(points), limits):
        return "visits too close", 0.0
    # infinite: the base bead is chosen later
    quality = replace(measure(points, crossings, quick=True), base_spacing=float("inf"))
    if pressed_together(quality.clearance, limits):
        return "strands pressed together", 0.0
    if quality.margin < 0:
        return "out of the picture", 0.0
    if pyknotid_code(points) != crossings.code:
        return "labellers disagree", 0.0
    return "", ease(quality, Limits())
