"""Instances: one concrete rope state that shows one Gauss code, made from an archived way by a symmetry.

A fresh plain loop, noised, turned, renumbered, is led down the way, opened up, left to come to rest, and judged. What comes
out is a state with everything that makes it again bit for bit, or the reason why it was rejected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.crossings import find_crossings, label
from knotgym.gauss import GaussCode
from knotgym.generate.archive import Elite
from knotgym.generate.manoeuvres import NO_WAY, Way, pull
from knotgym.generate.opening import OpeningConfig, open_up
from knotgym.generate.quality import Limits, Quality, measure, noise_survival
from knotgym.generate.symmetry import Symmetry, variants
from knotgym.oracle import pyknotid_code
from knotgym.rope import Array, Rope, RopeConfig, noised
from knotgym.simulation import Simulation

REST = 3  # pulls of no force at the end: the rope is slower than 1 mm/s after two


@dataclass(frozen=True, kw_only=True)
class InstanceConfig:
    """How instances are made and judged.

    Attributes:
        limits: of accepted states.
        opening: how hard to open them up.
        start_noise: of the plain loop each begins as, as `rope.noised`; a tenth of a degree loses three ways in ten.
        stir: random pulls after the way at most, so that two instances of one way lie differently; one that changes the code is
            taken back.
        stir_loop: the same for plain loops, which have no way.
        reset_noise: that accepted states must survive.
        rope: its physics.
    """

    limits: Limits = Limits()
    opening: OpeningConfig = OpeningConfig()
    start_noise: float = 0.0
    stir: int = 3
    stir_loop: int = 12
    reset_noise: float = 0.015
    rope: RopeConfig = RopeConfig()


class Order(NamedTuple):
    """One instance to make: of `code`, which has its chirality, from one of `elites`, drawing from SeedSequence(seed)."""

    config: InstanceConfig
    code: GaussCode
    elites: Sequence[Elite]
    start: Array
    seed: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Instance:
    """What came of an order.

    Attributes:
        code: with chirality; of the last state.
        faults: why it is rejected, empty if accepted.
        seed: of the order.
        start_qpos: float64 (nq,), laid at rest.
        actions: float32 (T, 6), from there.
        points: float64 (T + 1, beads, 3), metres, the configurations on the way.
        qpos: float64 (nq,), after the last action.
        quality: of the last state.
    """

    code: GaussCode
    faults: tuple[str, ...]
    seed: tuple[int, ...]
    start_qpos: Array
    actions: NDArray[np.float32]
    points: Array
    qpos: Array
    quality: Quality


def make(order: Order) -> Instance:
    """Make an instance; the same order gives the same bytes."""
    config, rng = order.config, np.random.default_rng(order.seed)
    rope = _rope(config.rope)
    elite = order.elites[int(rng.integers(len(order.elites)))]
    simulation = _simulations(config.rope, config.opening.tries)
    one = np.array([0])
    symmetry = _symmetry(elite, order.code, rng)
    start_qpos = rope.qpos(symmetry.configuration(noised(order.start, config.start_noise, rng)))
    simulation.lay(start_qpos[None], one)
    way = Way(symmetry.beads(elite.way.beads, config.rope.beads).astype(np.int16), symmetry.vectors(elite.way.forces.astype(np.float64)).astype(np.float32))
    actions, points = [], [simulation.points[0].copy()]

    def follow(along: Way) -> bool:
        for bead, force in zip(along.beads, along.forces, strict=True):
            action, held = pull(simulation, np.array([bead]), force[None], one)
            if not held.all():
                return False
            actions.append(action[0])
            points.append(simulation.points[0].copy())
        return True

    if not follow(way):
        return _rejected("simulation failed", order, rope)
    if label(simulation.points[0]) != order.code:
        return _rejected("way missed the code", order, rope)
    before = simulation.states(one)[0]
    stirred, stirring = _stir(simulation, int(rng.integers(config.stir + 1)) if order.code.nx else config.stir_loop, rng)
    _, opening = open_up(simulation, stirred, config.limits, config.opening, rng)
    simulation.restore(before[None], one)
    still = Way(np.zeros(REST, dtype=np.int16), np.zeros((REST, 3), dtype=np.float32))
    if not follow(stirring + opening + still):
        return _rejected("simulation failed", order, rope)
    last = simulation.points[0].copy()
    crossings = find_crossings(last)
    quality = replace(measure(last, crossings), noise_survival=noise_survival(last, config.reset_noise, rng))
    faults = config.limits.faults(quality, crossings.nx)
    if crossings.code != order.code:
        faults.append("code lost at rest")
    elif pyknotid_code(last) != crossings.code:
        faults.append("labellers disagree")
    return Instance(crossings.code, tuple(faults), order.seed, start_qpos, np.stack(actions), np.stack(points), simulation.qpos(one)[0], quality)


def _stir(simulation: Simulation, pulls: int, rng: np.random.Generator) -> tuple[Array, Way]:
    """Pull rope 0 about at random without changing what it shows; the state reached and the way there."""
    one, code, way = [0], label(simulation.points[0]), NO_WAY
    state = simulation.states(one)[0]
    for _ in range(pulls):
        bead, heading, strength = rng.integers(simulation.rope.config.beads, size=1), rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 1.0)
        force = strength * np.array([[np.cos(heading), np.sin(heading), 0.0]])
        _, held = pull(simulation, bead, force, one)
        if held.all() and label(simulation.points[0]) == code:
            state, way = simulation.states(one)[0], way + Way(bead.astype(np.int16), force.astype(np.float32))
        else:
            simulation.restore(state[None], one)
    return state, way


def _symmetry(elite: Elite, code: GaussCode, rng: np.random.Generator) -> Symmetry:
    """A random symmetry that takes what the elite shows to `code`."""
    fitting = [symmetry for shown, symmetry in variants(elite.code) if shown == code]
    symmetry = fitting[rng.integers(len(fitting))]
    return replace(symmetry, turn=float(rng.uniform(-np.pi, np.pi)), roll=-elite.roll if symmetry.reverse else elite.roll)


def _rejected(fault: str, order: Order, rope: Rope) -> Instance:
    nothing = np.zeros((0, 6), dtype=np.float32)
    return Instance(order.code, (fault,), order.seed, np.zeros(rope.nq), nothing, order.start[None], np.zeros(rope.nq), measure(order.start))


_made: dict[tuple[RopeConfig, int], Simulation] = {}


def _simulations(config: RopeConfig, count: int) -> Simulation:
    """This process's simulation, made once; whoever asks lays or restores every rope before use."""
    if (config, count) not in _made:
        _made[config, count] = Simulation(count, Rope(config))
    return _made[config, count]


def _rope(config: RopeConfig) -> Rope:
    return _simulations(config, 1).rope
