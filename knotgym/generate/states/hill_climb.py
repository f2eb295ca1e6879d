"""Hill climb: move a rope until its picture can be read, its Gauss code unchanged.

It climbs in the simulator itself: from where the rope lies, a handful of steps are tried side by
side on copies of it, and the one that leaves the code as it was and the picture most legible is
kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import check_numbers
from knotgym.control.action_sequence import NO_ACTIONS, ActionSequence, step_ropes
from knotgym.quality.measures import Limits, measure, spots_of, tightest_spot
from knotgym.rope.model import Array
from knotgym.rope.simulation import Simulation
from knotgym.topology.crossings import find_crossings, label
from knotgym.topology.gauss import GaussCode


@dataclass(frozen=True, kw_only=True)
class HillClimbConfig:
    """How hard to try, and what.

    Attributes:
        steps: kept at most.
        tries: copies of the rope that try a step each time.
        patience: times without a gain before giving up.
        enough: objective (see `Limits.objective`) at which a state is legible enough.
        gain: by which the score must fall for a step to be kept.
        targeted: share of the tries on beads near the tightest spot, away from it.
        near: beads that count as near it.
        outwards: share of the other tries that lead away from the rope's middle; the rest lead
            anywhere.
        angle: standard deviation of a heading that isn't anywhere, radians.
        force: of a step, from and to, in units of the largest.
        lifted: share of the tries that have a vertical part.
        lift: largest sine of their slope.
    """

    steps: int = 24
    tries: int = 12
    patience: int = 4
    enough: float = 0.3
    gain: float = 0.01
    targeted: float = 0.5
    near: int = 30
    outwards: float = 0.5
    angle: float = 0.5
    force: tuple[float, float] = (0.3, 1.0)
    lifted: float = 0.3
    lift: float = 0.5

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("tries", "patience", "near"),
            whole=("steps",),
            non_negative=("enough", "gain", "angle"),
            shares=("targeted", "outwards", "lifted", "lift"),
            ranges=("force",),
        )


def hill_climb(
    simulation: Simulation,
    state: Array,
    limits: Limits,
    config: HillClimbConfig,
    rng: np.random.Generator,
) -> tuple[Array, ActionSequence]:
    """Move a rope into a more legible configuration with the same code.

    Args:
        simulation: at least `config.tries` ropes, whose states are overwritten.
        state: integration state to begin with.
        limits: what is legible.
        config: how hard to try.
        rng: decides the steps tried.

    Returns:
        The integration state reached and the actions that led there, none if nothing was better.
    """
    ids = np.arange(config.tries)
    simulation.restore(np.repeat(state[None], config.tries, axis=0), ids)
    code, sequence, idle = label(simulation.points[0]), NO_ACTIONS, 0
    objective, best = _score(simulation.points[0], code, limits)
    for _ in range(config.steps):
        if objective <= config.enough or idle >= config.patience:
            break
        beads, forces = _proposals(simulation.points[0], config, rng)
        _, held = step_ropes(simulation, beads, forces, ids)
        scores = [
            _score(simulation.points[row], code, limits) if held[row] else (np.inf, np.inf)
            for row in ids
        ]
        choice = int(np.argmin([score for _, score in scores]))
        if scores[choice][1] < best - config.gain:
            (objective, best), idle = scores[choice], 0
            state = simulation.states([choice])[0]
            sequence += ActionSequence(beads[[choice]].astype(np.int16), forces[[choice]])
        else:
            idle += 1
        simulation.restore(np.repeat(state[None], config.tries, axis=0), ids)
    return state, sequence


def _score(points: Array, code: GaussCode, limits: Limits) -> tuple[float, float]:
    """The objective, and the same with all that is cramped besides; infinite for another code."""
    crossings = find_crossings(points)
    if crossings.code != code:
        return np.inf, np.inf
    spots = spots_of(points, crossings)
    objective = limits.objective(measure(points, crossings, spots=spots, quick=True), code.nx)
    return objective, objective + spots.crampedness(limits)


def _proposals(
    points: Array, config: HillClimbConfig, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Steps that may make the rope more legible: beads (tries,) and forces (tries, 3)."""
    tries = config.tries
    spot, middle = tightest_spot(points), points[:, :2].mean(axis=0)
    near = np.argsort(np.linalg.norm(points[:, :2] - spot, axis=1))[: config.near]
    targeted = np.arange(tries) < int(config.targeted * tries)
    nearby = near[rng.integers(len(near), size=tries)]
    beads = np.where(targeted, nearby, rng.integers(len(points), size=tries))
    away = points[beads, :2] - np.where(targeted[:, None], spot, middle)
    is_aimed = targeted | (rng.random(tries) < config.outwards)
    slight, any_angle = rng.normal(0, config.angle, tries), rng.uniform(-np.pi, np.pi, tries)
    heading = np.arctan2(away[:, 1], away[:, 0]) + np.where(is_aimed, slight, any_angle)
    strength = rng.uniform(*config.force, tries)
    is_lifted = rng.random(tries) < config.lifted
    slope = np.where(is_lifted, rng.uniform(-config.lift, config.lift, tries), 0.0)
    level = strength * np.sqrt(1 - slope**2)
    forces = np.stack([level * np.cos(heading), level * np.sin(heading), strength * slope], axis=1)
    return beads, forces.astype(np.float32)
