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
from knotgym.generate.manoeuvres import Way, pull
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
        start_noise: of the plain loop each begins as, as `rope.noised`.
        reset_noise: that accepted states must survive.
        rope: its physics.
    """

    limits: Limits = Limits()
    opening: OpeningConfig = OpeningConfig()
    start_noise: float = 0.015
    reset_noise: float = 0.015
    rope: RopeConfig = RopeConfig()


class Order(NamedTuple):
    """One instance to make: of `code` (plain, or with chirality), from one of `elites`, drawing from SeedSequence(seed)."""

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
    elite = order.elites[rng.integers(len(order.elites))]
    simulation = _simulations(config.rope, config.opening.tries)
    one = np.array([0])
    symmetry = _symmetry(elite, order.code, rope, rng)
    if symmetry is None:
        return _rejected("no room for the base bead", order, rope)
    start_qpos = rope.qpos(symmetry.configuration(noised(order.start, config.start_noise, rng)))
    simulation.lay(start_qpos[None], one)
    way = Way(symmetry.beads(elite.way.beads, config.rope.beads).astype(np.int16), symmetry.vectors(elite.way.forces).astype(np.float32))
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
    if not label(simulation.points[0]).matches(order.code, chirality=order.code.chirality is not None and order.code.nx > 0):
        return _rejected("way missed the code", order, rope)
    before = simulation.states(one)[0]
    _, opening = open_up(simulation, before, config.limits, config.opening, rng)
    simulation.restore(before[None], one)
    still = Way(np.zeros(REST, dtype=np.int16), np.zeros((REST, 3), dtype=np.float32))
    if not follow(opening + still):
        return _rejected("simulation failed", order, rope)
    last = simulation.points[0].copy()
    crossings = find_crossings(last)
    quality = replace(measure(last, crossings), noise_survival=noise_survival(last, config.reset_noise, rng))
    faults = config.limits.faults(quality, crossings.nx)
    if not crossings.code.matches(order.code, chirality=order.code.chirality is not None and order.code.nx > 0):
        faults.append("code lost at rest")
    elif pyknotid_code(last) != crossings.code:
        faults.append("labellers disagree")
    return Instance(crossings.code, tuple(faults), order.seed, start_qpos, np.stack(actions), np.stack(points), simulation.qpos(one)[0], quality)


def _symmetry(elite: Elite, code: GaussCode, rope: Rope, rng: np.random.Generator) -> Symmetry | None:
    """A random symmetry that takes the elite's code to `code` and leaves the base bead room, None if there is none."""
    with_chirality = code.chirality is not None and code.nx > 0
    fitting = [(symmetry, visits) for shown, symmetry, visits in variants(elite.code) if shown.matches(code, chirality=with_chirality)]
    turn, where = float(rng.uniform(-np.pi, np.pi)), float(rng.uniform(0.3, 0.7))
    beads = rope.config.beads
    for pick in rng.permutation(len(fitting)):
        symmetry, visits = fitting[pick]
        if code.nx == 0:
            return replace(symmetry, turn=turn, roll=int(where * 1e6) % beads)
        crossings = find_crossings(rope.points(elite.state[1 : 1 + rope.nq]))
        places = np.concatenate([crossings.over_place, crossings.under_place])
        places = np.sort((-places) % beads if symmetry.reverse else places)
        low, high = (places[visits - 1] if visits else places[-1] - beads), places[visits]
        roll = int(np.ceil(low + where * (high - low - 1)))
        if low < roll and roll + 1 < high:  # the white bead lies between the vertices roll and roll + 1
            return replace(symmetry, turn=turn, roll=roll % beads)
    return None


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
