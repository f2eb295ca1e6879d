"""Opening up: move a rope until it can be read, its Gauss code unchanged.

A hill climb in the simulator itself: from where the rope lies, a handful of pulls are tried side by
side on copies of it, and the one that leaves the code as it was and the picture most legible is
kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from knotgym.control.macro_actions import NO_ACTIONS, ActionSequence, step_ropes
from knotgym.quality import Limits, measure, spots_of, tightest_spot
from knotgym.rope import Array
from knotgym.simulation import Simulation
from knotgym.topology.crossings import find_crossings, label
from knotgym.topology.gauss import GaussCode


@dataclass(frozen=True, kw_only=True)
class HillClimbConfig:
    """How hard to try.

    Attributes:
        pulls: rounds at most, a pull each.
        tries: copies of the rope that try a pull in each round.
        patience: rounds without a gain before giving up.
        enough: objective (see `Limits.objective`) at which a state is open enough.
    """

    steps: int = 24
    tries: int = 12
    patience: int = 4
    enough: float = 0.3


def hill_climb(
    simulation: Simulation,
    state: Array,
    limits: Limits,
    config: HillClimbConfig,
    rng: np.random.Generator,
) -> tuple[Array, ActionSequence]:
    """Pull a rope into a more legible configuration with the same code.

    Args:
        simulation: at least `config.tries` ropes, whose states are overwritten.
        state: integration state to begin with.
        limits: what is legible.
        config: how hard to try.
        rng: decides the pulls tried.

    Returns:
        The integration state reached and the way there, empty if nothing was better.
    """
    ids = np.arange(config.tries)
    simulation.restore(np.repeat(state[None], config.tries, axis=0), ids)
    code, sequence, idle = label(simulation.points[0]), NO_ACTIONS, 0
    bad, best = _score(simulation.points[0], code, limits)
    for _ in range(config.steps):
        if bad <= config.enough or idle >= config.patience:
            break
        beads, forces = _proposals(simulation.points[0], config.tries, rng)
        _, held = step_ropes(simulation, beads, forces, ids)
        scores = [
            _score(simulation.points[i], code, limits) if held[i] else (np.inf, np.inf) for i in ids
        ]
        choice = int(np.argmin([score for _, score in scores]))
        if scores[choice][1] < best - 0.01:
            (bad, best), idle = scores[choice], 0
            state = simulation.states([choice])[0]
            sequence += ActionSequence(beads[[choice]].astype(np.int16), forces[[choice]])
        else:
            idle += 1
        simulation.restore(np.repeat(state[None], config.tries, axis=0), ids)
    return state, sequence


def _score(points: Array, code: GaussCode, limits: Limits) -> tuple[float, float]:
    """Badness, and objective with all that is cramped besides; infinite where the code is
    another.
    """
    crossings = find_crossings(points)
    if crossings.code != code:
        return np.inf, np.inf
    spots = spots_of(points, crossings)
    objective = limits.objective(measure(points, crossings, spots=spots, quick=True), code.nx)
    return objective, objective + spots.crampedness(limits)


def _proposals(
    points: Array, tries: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Pulls that may open the rope: half of them on beads near the tightest spot, away from it; the
    rest outwards or anywhere.
    """
    spot, middle = tightest_spot(points), points[:, :2].mean(axis=0)
    near = np.argsort(np.linalg.norm(points[:, :2] - spot, axis=1))[:30]
    targeted = np.arange(tries) < tries // 2
    beads = np.where(
        targeted, near[rng.integers(len(near), size=tries)], rng.integers(len(points), size=tries)
    )
    away = points[beads, :2] - np.where(targeted[:, None], spot, middle)
    aside = np.where(
        targeted | (rng.random(tries) < 0.5),
        rng.normal(0, 0.5, tries),
        rng.uniform(-np.pi, np.pi, tries),
    )
    heading = np.arctan2(away[:, 1], away[:, 0]) + aside
    strength = rng.uniform(0.3, 1.0, tries)
    lift = np.where(rng.random(tries) < 0.3, rng.uniform(-0.5, 0.5, tries), 0.0)
    level = np.sqrt(1 - lift**2)
    forces = np.stack(
        [strength * level * np.cos(heading), strength * level * np.sin(heading), strength * lift],
        axis=1,
    )
    return beads, forces.astype(np.float32)
