"""States drawn from codes: what is wanted, and the work on one code.

A code is drawn (`drawing.drawn_curve`), the curve laid in the simulator, stirred a little, left to
rest, and judged like any curated state; and again, each time otherwise, until it is accepted.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import check_numbers
from knotgym.common.streams import Stream, generator_of, key
from knotgym.control.action_sequence import step_ropes
from knotgym.drawing.drawn_curve import DrawingConfig, UndrawnCode, drawn_curve
from knotgym.envs.tasks import MAX_NX
from knotgym.generate.states.generate_config import InvalidGenerateConfig
from knotgym.generate.states.random_walk import RESET_NOISE
from knotgym.quality.measures import Limits, Quality, measure, noise_survival
from knotgym.rope.model import Array, RopeConfig
from knotgym.rope.simulation import Simulation
from knotgym.rope.simulation_pool import simulation_of
from knotgym.topology.crossings import find_crossings, label
from knotgym.topology.diagrams import NotPlanar, chiralities, is_planar
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT, diagram_of, type_of
from knotgym.topology.knots import knot_type, shows
from knotgym.topology.reference_labeller import pyknotid_code

ONE = np.array([0])


@dataclass(frozen=True, kw_only=True)
class DrawnStatesConfig:
    """What drawn states are wanted.

    Attributes:
        nx: crossing numbers.
        codes: instead of all there are, as text, with chirality or without; all of `knot`, and
            `nx` is what they have.
        count: states for each of them, as many distinct codes among them as there are.
        every_code: instead of count, so many states of every code; 0 for count.
        split_by: "state", or "code" for splits that share no code.
        train_share: of the states (or codes) that are for training.
        knot: the rope's, as of `topology.knot_table.diagram_of`.
        seed: of everything.
        attempts: drawings, for each state wanted of a code, before the code is passed over.
        cycles: waves after which what there is is enough; 0 to go on until all wanted is there.
        wave: codes worked on between two saves.
        batch: drawings of a code in a wave.
        drawing: how codes are drawn.
        stir: steps, at most, with which a drawing is stirred.
        loop_stir: the same for plain loops, all of which are drawn alike.
        force: of such a step, from and to, in units of the largest.
        rest: steps of no force at the end.
        limits: of accepted states.
    """

    nx: tuple[int, ...] = (3,)
    codes: tuple[str, ...] = ()
    count: int = 40
    every_code: int = 0
    split_by: str = "state"
    train_share: float = 0.5
    knot: str = "0_1"
    seed: int = 0
    attempts: int = 100
    cycles: int = 0
    wave: int = 64
    batch: int = 10
    drawing: DrawingConfig = DrawingConfig()
    stir: int = 2
    loop_stir: int = 12
    force: tuple[float, float] = (0.05, 0.3)
    rest: int = 3
    limits: Limits = Limits()

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("count", "attempts", "wave", "batch", "rest"),
            whole=("every_code", "seed", "cycles", "stir", "loop_stir"),
            shares=("train_share",),
            ranges=("force",),
            error=InvalidGenerateConfig,
        )
        if (
            not self.nx
            or any(not 0 <= nx <= MAX_NX for nx in self.nx)
            or len(set(self.nx)) != len(self.nx)
        ):
            raise InvalidGenerateConfig(
                f"nx takes different numbers of crossings from 0 to {MAX_NX}, got"
                f" {', '.join(map(str, self.nx)) or 'none'}"
            )
        least = diagram_of(self.knot).nx
        for nx in self.nx:
            if nx < least:
                raise InvalidGenerateConfig(
                    f"no diagram of {self.knot} has {nx} crossings; it takes {least}"
                )
        for code in self.parsed:
            if not is_planar(code):
                raise NotPlanar(code)
            if code.nx not in self.nx:
                raise InvalidGenerateConfig(
                    f"nx must name the crossings of all codes, got {self.nx} and {str(code)!r}"
                )
            if not shows(code, self.knot):
                seen = knot_type(code)
                other_hand = " of this hand" if seen == type_of(self.knot) else ""
                raise InvalidGenerateConfig(
                    f"the code {str(code)!r} shows the knot {seen}, not {self.knot}{other_hand}"
                )
        if self.split_by not in ("state", "code"):
            raise InvalidGenerateConfig(
                f'split_by must be "state" or "code", got {self.split_by!r}'
            )

    @property
    def parsed(self) -> list[GaussCode]:
        """The codes asked for by name."""
        return [GaussCode.parse(text) for text in self.codes]


class DrawnUnit(NamedTuple):
    """Some drawings of one code.

    Attributes:
        config: how.
        code: with chirality, or without for any.
        which: of the code among those of its nx.
        first: number of the first drawing.
        drawings: to be made at most.
        wanted: states after which to stop.
    """

    config: DrawnStatesConfig
    code: GaussCode
    which: int
    first: int
    drawings: int
    wanted: int


@dataclass(frozen=True, eq=False)
class DrawnState:
    """A state drawn, with what makes it again.

    Attributes:
        code: with chirality.
        index: of the code among those of its nx.
        number: of the drawing.
        start_qpos: float64 (nq,), as drawn.
        actions: float32 (T, 6), from there.
        qpos: float64 (nq,), after the last.
        points: float64 (beads, 3), metres, of qpos.
        quality: all measures.
    """

    code: GaussCode
    index: int
    number: int
    start_qpos: Array
    actions: NDArray[np.float32]
    qpos: Array
    points: Array
    quality: Quality


@dataclass(eq=False)
class DrawnOnes:
    """What came of a unit: states, drawings made, and reason -> drawings rejected."""

    states: list[DrawnState] = field(default_factory=list)
    drawings: int = 0
    rejected: Counter[str] = field(default_factory=Counter)


def key_of(config: DrawnStatesConfig, nx: int, index: int, number: int) -> tuple[int, ...]:
    """The key of the stream that a drawing draws from."""
    return key(Stream.DRAWING, config.seed, nx, index, number)


def draw_states(unit: DrawnUnit) -> DrawnOnes:
    """Draw a unit's code until it is wanted no more; the same unit gives the same bytes."""
    simulation = simulation_of(1, RopeConfig())
    own, made = unit.code.chirality, DrawnOnes()
    letters = _letters(unit.code, unit.config.knot) if own is None else (own,)
    for number in range(unit.first, unit.first + unit.drawings):
        made.drawings += 1
        # every chirality in turn, not all codes beginning with the same
        code = GaussCode(unit.code.visits, letters[(unit.which + number) % len(letters)])
        state = _drawn(unit, code, number, simulation, made.rejected)
        if state is not None:
            made.states.append(state)
            if len(made.states) == unit.wanted:
                break
    return made


@lru_cache(maxsize=4096)
def _letters(code: GaussCode, knot: str) -> tuple[str, ...]:
    """The chiralities with which a code shows the knot."""
    patterns = chiralities(code)
    if knot == UNKNOT:
        return patterns
    return tuple(letters for letters in patterns if shows(GaussCode(code.visits, letters), knot))


def _drawn(
    unit: DrawnUnit,
    code: GaussCode,
    number: int,
    simulation: Simulation,
    rejected: Counter[str],
) -> DrawnState | None:
    """One drawing, or None if it is rejected; the reasons are counted."""
    config, rope = unit.config, simulation.rope
    rng = generator_of(key_of(config, code.nx, unit.which, number))
    try:
        curve = drawn_curve(code, rng, rope, config.drawing)
    except UndrawnCode:
        rejected["too tight"] += 1
        return None
    faults = config.limits.faults(measure(curve, quick=True), code.nx)
    if faults:
        rejected.update(faults)
        return None
    start = rope.qpos(curve)
    simulation.lay(start[None], ONE)
    actions = _stirred(simulation, config, code, rng)
    if actions is None:
        rejected["code lost at rest"] += 1
        return None
    points, crossings = simulation.points[0].copy(), find_crossings(simulation.points[0])
    quality = measure(points, crossings)
    quality = replace(quality, noise_survival=noise_survival(points, RESET_NOISE, rng))
    faults = config.limits.faults(quality, code.nx)
    if pyknotid_code(points) != code:
        faults.append("labellers disagree")
    if faults:
        rejected.update(faults)
        return None
    qpos = simulation.qpos(ONE)[0]
    return DrawnState(code, unit.which, number, start, actions, qpos, points, quality)


def _stirred(
    simulation: Simulation, config: DrawnStatesConfig, code: GaussCode, rng: np.random.Generator
) -> NDArray[np.float32] | None:
    """Stir rope 0 and let it rest: the actions; None if it fails, or shows another code then."""
    most = config.stir if code.nx else config.loop_stir
    force = config.force if code.nx else (config.force[0], 1.0)
    actions = []
    for step in range((steps := int(rng.integers(most + 1))) + config.rest):
        strength = rng.uniform(*force) if step < steps else 0.0
        heading, bead = rng.uniform(-np.pi, np.pi), rng.integers(len(simulation.points[0]), size=1)
        pull = strength * np.array([[np.cos(heading), np.sin(heading), 0.0]])
        action, held = step_ropes(simulation, bead, pull.astype(np.float32), ONE)
        if not held.all():
            return None
        actions.append(action[0])
    return np.array(actions) if label(simulation.points[0]) == code else None
