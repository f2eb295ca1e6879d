"""Random walks: states reached by uniform random actions, as in the published benchmark.

A rope starts as a coil, as in the published model, and takes uniform actions until its distribution
no longer depends on the start: walks from the coil and from the plain loop converge. From then on,
every few actions a configuration is examined. States are not made
more legible. Only positions are kept, at rest: an episode starts without the velocity of the walk.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from knotgym.common.configuration import (
    Count,
    Distinct,
    Positive,
    Seed,
    Share,
    Whole,
    choice,
    configuration,
)
from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream, generator, key
from knotgym.quality.measures import Quality, measure, noise_survival
from knotgym.rope.actions import drawn_actions
from knotgym.rope.engines import MUJOCO, EngineName, simulation_of
from knotgym.rope.model import Array, Rope, RopeConfig
from knotgym.states.split_names import STATE_SPLITS
from knotgym.topology.crossings import find_crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import LISTED_NX, is_unknot
from knotgym.topology.reference_labeller import pyknotid_code

RESET_NOISE = 0.015  # default of the environments


@configuration
class TwistLimits:
    """Limits of accepted states of a random walk; legibility is not required.

    Attributes:
        excess_crossing_number: maximum, see `quality.measures.Quality`; it counts turns of the rope
            about itself that the picture doesn't show.
        total_curvature: maximum, in turns.
        noise_survival: minimum; a reset draws noise up to twenty times at full scale, so at 0.25
            all draws lose the code in only 3 of 1,000 resets.
    """

    excess_crossing_number: Positive = 4.0
    total_curvature: Positive = 5.0
    noise_survival: Share = 0.25

    def faults(self, quality: Quality) -> list[str]:
        """Names of the measures that miss their limit; an unmeasured noise_survival passes."""
        missed = {
            "excess_crossing_number": quality.excess_crossing_number > self.excess_crossing_number,
            "total_curvature": quality.total_curvature > self.total_curvature,
            "noise_survival": quality.noise_survival < self.noise_survival,
        }
        return [name for name, short in missed.items() if short]


@configuration
class RandomWalkConfig:
    """Which states of random walks to make.

    Attributes:
        nx: crossing numbers.
        count: states per crossing number, at most one per rope and crossing number.
        loops: the same for plain loops, which are rare; 0 to use `count`.
        train_share: share of the ropes, and so of the states, in the train split; splits share no
            rope.
        seed: random seed; rope i takes the actions of stream RANDOM_WALK, seed, i.
        engine: the engine that moves the ropes, see `knotgym.rope.engines`.
        start: start configuration of the ropes, "coil" or "circle".
        burn_in: actions before the first configuration is examined.
        every: actions between examined configurations.
        longest: actions of a walk.
        attempts: walks per requested state of a crossing number before the run gives up.
        batch: ropes simulated together, one unit of work.
        wave: units between checkpoints; the run can end after each.
        limits: limits of accepted states.
    """

    nx: Annotated[tuple[Annotated[Whole, Field(le=LISTED_NX)], ...], Distinct] = (3,)
    count: Count = 40
    loops: Whole = 0
    train_share: Share = 0.5
    seed: Seed = 0
    engine: EngineName = MUJOCO
    start: Annotated[str, choice("coil", "circle")] = "coil"
    burn_in: Whole = 300
    every: Count = 25
    longest: Count = 900
    attempts: Count = 100
    batch: Count = 16
    wave: Count = 2
    limits: TwistLimits = TwistLimits()

    def __post_init__(self) -> None:
        if self.longest < self.burn_in + 1:
            raise InvalidInput(f"longest must be above burn_in, {self.burn_in}, got {self.longest}")

    def wanted(self, nx: int, split: str) -> int:
        """Return the number of states requested with nx crossings in a split."""
        count = self.loops or self.count if nx == 0 else self.count
        train = int(np.floor(count * self.train_share + 0.5))
        return train if split == STATE_SPLITS[0] else count - train

    def split(self, rope: int) -> str:
        """Return the split of a rope's states; ropes alternate to match `train_share`."""
        before, after = (int(np.floor(k * self.train_share + 0.5)) for k in (rope, rope + 1))
        return STATE_SPLITS[0] if after > before else STATE_SPLITS[1]


class WalkUnit(NamedTuple):
    """Ropes `first` to `first + config.batch - 1`."""

    config: RandomWalkConfig
    first: int


@dataclass(frozen=True, eq=False)
class WalkState:
    """A state reached by a random walk."""

    rope: int  # number of the rope
    step: int  # number of actions before it
    code: GaussCode  # with chirality
    qpos: Array  # float64 (nq,)
    points: Array  # float64 (beads, 3), metres
    quality: Quality  # all measures


@dataclass(frozen=True, eq=False)
class Walked:
    """Result of a unit: each rope's first accepted state per crossing number, by rope and step; and
    nx -> reason -> number of rejected configurations.
    """

    states: list[WalkState]
    rejected: dict[int, Counter[str]] = field(default_factory=dict)


def coil(rope: Rope) -> Array:
    """Return a coil of two turns, one crossing, radius of gyration 0.11 m: float64 (beads, 3)."""
    at = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    radius = 1 + 0.25 * np.cos(at)
    curve = [radius * np.cos(2 * at), radius * np.sin(2 * at), 0.25 * np.sin(at)]
    return rope.from_curve(np.stack(curve, axis=1))


STARTS = {"coil": coil, "circle": Rope.loop}


def key_of(config: RandomWalkConfig, rope: int) -> tuple[int, ...]:
    """Return the key of the random stream of a rope's actions."""
    return key(Stream.RANDOM_WALK, config.seed, rope)


def walk(unit: WalkUnit) -> Walked:
    """Walk a unit's ropes; the same unit gives the same bytes."""
    config, ropes = unit.config, range(unit.first, unit.first + unit.config.batch)
    simulation = simulation_of(config.batch, RopeConfig(), config.engine)
    start = simulation.rope.qpos(STARTS[config.start](simulation.rope))
    simulation.lay(np.repeat(start[None], config.batch, axis=0))
    # all actions of a rope come from one stream, so its row needs no column of actions
    actions = np.stack([drawn_actions(key_of(config, rope), config.longest) for rope in ropes])
    whole = np.ones(config.batch, dtype=bool)  # no blow-up so far
    found: dict[tuple[int, int], WalkState] = {}
    rejected: dict[int, Counter[str]] = {nx: Counter() for nx in config.nx}
    for step in range(1, config.longest + 1):
        whole &= simulation.act(actions[:, step - 1])
        if step < config.burn_in or (step - config.burn_in) % config.every:
            continue
        for row in np.flatnonzero(whole):
            points, rope = simulation.points[row], ropes[row]
            crossings = find_crossings(points)
            nx = crossings.nx
            if nx not in config.nx or (rope, nx) in found:
                continue
            quality = measure(points, crossings)
            faults = config.limits.faults(quality)
            if not faults:
                rng = generator(Stream.RANDOM_WALK_NOISE, config.seed, rope, step)
                survival = noise_survival(points, RESET_NOISE, rng)
                quality = replace(quality, noise_survival=survival)
                faults = [*config.limits.faults(quality), *_doubts(points, crossings.code)]
            rejected[nx].update(faults)
            if not faults:
                qpos = simulation.qpos()[row]
                found[rope, nx] = WalkState(
                    rope, step, crossings.code, qpos, points.copy(), quality
                )
    return Walked(sorted(found.values(), key=lambda state: (state.rope, state.step)), rejected)


def _doubts(points: NDArray[np.float64], code: GaussCode) -> list[str]:
    """List doubts that a configuration has this code or that its rope is an unknot."""
    if pyknotid_code(points) != code:
        return ["labellers disagree"]
    return [] if is_unknot(code) else ["not certified an unknot"]
