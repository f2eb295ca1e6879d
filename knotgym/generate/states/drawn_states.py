"""Draw states from their Gauss codes: the work on one code.

A curve with the code is drawn (`drawing.drawn_curve`), placed in the simulator, stirred a little,
left to rest and judged. Drawings are random, so this is repeated until one is accepted.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import Failed
from knotgym.common.streams import Stream, generator_of, key
from knotgym.control.action_sequence import step_ropes
from knotgym.drawing.drawn_curve import drawn_curve
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.generate.states.random_walk import RESET_NOISE
from knotgym.quality.measures import Limits, Quality, measure, noise_survival
from knotgym.rope.engines import simulation_of
from knotgym.rope.model import Array
from knotgym.rope.simulation import Simulation
from knotgym.states.schema import DRAWING
from knotgym.topology.crossings import find_crossings, label
from knotgym.topology.diagrams import chiralities
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT, type_of
from knotgym.topology.knots import shows
from knotgym.topology.reference_labeller import pyknotid_code

ONE = np.array([0])


class DrawnUnit(NamedTuple):
    """A few drawings of one code."""

    config: GenerateConfig
    knot: str  # name of the rope's knot in the knot table
    code: GaussCode  # with chirality, or without for any chirality
    which: int  # index of the code among those of its nx
    first: int  # number of the first drawing
    drawings: int  # maximum number of drawings
    wanted: int  # stop after this many states


@dataclass(frozen=True, eq=False)
class MadeState:
    """An accepted state and how to reproduce it."""

    policy: str  # "drawing", or "play" for the end of an action sequence
    code: GaussCode  # with chirality
    index: int  # index of the code among those of its nx
    seed: tuple[int, ...]  # key of its random stream
    start_qpos: Array  # float64 (nq,), the configuration before the actions, at rest
    actions: NDArray[np.float32]  # float32 (T, 6), applied from there
    qpos: Array  # float64 (nq,), after the last action
    points: Array  # float64 (beads, 3), metres, bead positions of qpos
    quality: Quality  # all quality measures


@dataclass(eq=False)
class DrawnOnes:
    """Result of a unit: states, number of drawings, and reason -> number of rejected drawings."""

    states: list[MadeState] = field(default_factory=list)
    drawings: int = 0
    rejected: Counter[str] = field(default_factory=Counter)


def draw_states(unit: DrawnUnit) -> DrawnOnes:
    """Draw a unit's code until enough states are accepted; the same unit gives the same bytes."""
    simulation = simulation_of(1, unit.config.rope, unit.config.engine)
    own, made = unit.code.chirality, DrawnOnes()
    letters = _letters(unit.code, unit.knot) if own is None else (own,)
    for number in range(unit.first, unit.first + unit.drawings):
        made.drawings += 1
        # Cycle through the chiralities; `which` keeps codes from all starting with the same one.
        code = GaussCode(unit.code.visits, letters[(unit.which + number) % len(letters)])
        state = _drawn(unit, code, number, simulation, made.rejected)
        if state is not None:
            made.states.append(state)
            if len(made.states) == unit.wanted:
                break
    return made


@lru_cache(maxsize=4096)
def _letters(code: GaussCode, knot: str) -> tuple[str, ...]:
    """Return the chiralities with which a code shows the knot."""
    patterns = chiralities(code)
    if type_of(knot) == UNKNOT:
        return patterns
    return tuple(letters for letters in patterns if shows(GaussCode(code.visits, letters), knot))


def _drawn(
    unit: DrawnUnit,
    code: GaussCode,
    number: int,
    simulation: Simulation,
    rejected: Counter[str],
) -> MadeState | None:
    """Make one state; return None if it is rejected, and count the reasons in `rejected`."""
    config, rope = unit.config, simulation.rope
    seed = key(Stream.DRAWING, config.seed, code.nx, unit.which, number)
    rng = generator_of(seed)
    try:
        curve = drawn_curve(code, rng, rope, config.drawing)
    except Failed:
        rejected["too tight"] += 1
        return None
    # most rejections are seen on the curve, before anything is simulated
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
    points, qpos = simulation.points[0].copy(), simulation.qpos(ONE)[0]
    quality, faults = judged(points, code, config.limits, rng)
    rejected.update(faults)
    if faults:
        return None
    return MadeState(DRAWING, code, unit.which, seed, start, actions, qpos, points, quality)


def judged(
    points: Array, code: GaussCode, limits: Limits, rng: np.random.Generator
) -> tuple[Quality, list[str]]:
    """Measure a state at rest and list why it can't be accepted as one that shows `code`.

    The cheap measures come first: noise survival, which is half of the time and NaN where it isn't
    measured, and the second labeller are only for states that pass them.
    """
    crossings = find_crossings(points)
    quality = measure(points, crossings)
    faults = limits.faults(quality, crossings.nx)
    if crossings.code != code:
        faults.append("code lost at rest")
    if faults:
        return quality, faults
    quality = replace(quality, noise_survival=noise_survival(points, RESET_NOISE, rng))
    faults = limits.faults(quality, crossings.nx)
    if not faults and pyknotid_code(points) != code:
        faults.append("labellers disagree")
    return quality, faults


def _stirred(
    simulation: Simulation, config: GenerateConfig, code: GaussCode, rng: np.random.Generator
) -> NDArray[np.float32] | None:
    """Stir rope 0 with random pulls and let it rest; return the actions.

    None if the simulation fails or the rope shows another code afterwards.
    """
    few = code.nx < 2
    most = config.loop_stir if few else config.stir
    force = (config.force[0], 1.0) if few else config.force
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
