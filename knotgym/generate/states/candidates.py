"""Candidates: one concrete rope state that shows one Gauss code, made from an archived way by a
symmetry.

A fresh plain loop, noised, turned, renumbered, is led down the way, opened up, left to come to
rest, and judged. What comes out is a state with everything that makes it again bit for bit, or the
reason why it was rejected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.control.macro_actions import NO_ACTIONS, ActionSequence, step_ropes
from knotgym.generate.states.archive import Elite
from knotgym.generate.states.hill_climb import HillClimbConfig, hill_climb
from knotgym.generate.states.search import JITTER, readings
from knotgym.quality import Limits, Quality, measure, noise_survival
from knotgym.reset_noise import noised
from knotgym.rope import Array, Rope, RopeConfig
from knotgym.simulation import Simulation
from knotgym.simulation_pool import simulation_of
from knotgym.streams import generator_of
from knotgym.topology.crossings import find_crossings, label, label_many
from knotgym.topology.gauss import GaussCode
from knotgym.topology.reference_labeller import pyknotid_code
from knotgym.topology.symmetry import Symmetry, mirrorings

GAIN = (
    0.05  # objective by which a candidate must be better than the archive to be handed back to it
)
ROUNDS = 2  # of opening up and coming to rest
REST = 3  # pulls of no force at the end: the rope is slower than 1 mm/s after two
STILL = ActionSequence(np.zeros(REST, dtype=np.int16), np.zeros((REST, 3), dtype=np.float32))
ONE = np.array([0])  # the rope that is led; the others try what may open it up


@dataclass(frozen=True, kw_only=True)
class CandidateConfig:
    """How candidates are made and judged.

    Attributes:
        limits: of accepted states.
        opening: how hard to open them up.
        start_noise: of the plain loop each begins as, as `reset_noise.noised`; a tenth of a degree
            loses three ways in ten.
        stir: random pulls after the way at most, so that two candidates of one way lie differently;
            one that changes the code is taken back.
        stir_loop: the same for plain loops, which have no way.
        longest: ways of more actions aren't handed back to the archive.
        reset_noise: that accepted states must survive.
        rope: its physics.
    """

    limits: Limits = Limits()
    opening: HillClimbConfig = HillClimbConfig()
    start_noise: float = 0.0
    stir: int = 3
    stir_loop: int = 12
    longest: int = 120
    reset_noise: float = 0.015
    rope: RopeConfig = RopeConfig()


class CandidateTask(NamedTuple):
    """One candidate to make: of `code`, which has its chirality, from one of `elites`, drawing from
    the stream of the key `seed`.
    """

    config: CandidateConfig
    code: GaussCode
    elites: Sequence[Elite]
    start: Array
    seed: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Candidate:
    """What came of a task.

    Attributes:
        code: with chirality; of the last state.
        faults: why it is rejected, empty if accepted.
        seed: of the task.
        start_qpos: float64 (nq,), laid at rest.
        actions: float32 (T, 6), from there.
        points: float64 (T + 1, beads, 3), metres, the configurations on the way.
        qpos: float64 (nq,), after the last action.
        quality: of the last state.
        pulls: actions taken to make it, all that was tried included.
        elites: readings of this state for the archive, if it is better than what the order had,
            reached from the archive's start.
    """

    code: GaussCode
    faults: tuple[str, ...]
    seed: tuple[int, ...]
    start_qpos: Array
    actions: NDArray[np.float32]
    points: Array
    qpos: Array
    quality: Quality
    steps: int = 0
    elites: tuple[Elite, ...] = field(default=(), repr=False)


def make_candidate(task: CandidateTask) -> Candidate:
    """Make a candidate; the same order gives the same bytes."""
    simulation = simulation_of(task.config.opening.tries, task.config.rope)
    before = simulation.steps_taken
    candidate = _made(task, simulation)
    return replace(candidate, steps=simulation.steps_taken - before)


def _made(task: CandidateTask, simulation: Simulation) -> Candidate:
    config, rng, rope = task.config, generator_of(task.seed), simulation.rope
    elite = task.elites[int(rng.integers(len(task.elites)))]
    if rng.random() < 0.5:
        elite = min(task.elites, key=lambda one: one.objective)
    symmetry = _symmetry(elite, task.code, rng)
    start_qpos = rope.qpos(symmetry.configuration(noised(task.start, config.start_noise, rng)))
    simulation.lay(start_qpos[None], ONE)
    sequence = ActionSequence(
        symmetry.beads(elite.sequence.beads, config.rope.beads).astype(np.int16),
        symmetry.vectors(elite.sequence.forces.astype(np.float64)).astype(np.float32),
    )
    if not elite.exact:
        sequence = sequence.jittered(rng.uniform(0, JITTER), rng)
    if _follow(simulation, sequence) is None:
        return _rejected("simulation failed", task, rope)
    if label(simulation.points[0]) != task.code:
        return _rejected("way missed the code", task, rope)
    sequence += _opening(simulation, task, rng, at_rest=not sequence.forces[-REST:].any())
    simulation.lay(start_qpos[None], ONE)
    followed = _follow(simulation, sequence)
    if followed is None:
        return _rejected("simulation failed", task, rope)
    actions, points = followed
    qpos, last = simulation.qpos(ONE)[0], points[-1]
    crossings = find_crossings(last)
    quality = measure(last, crossings)
    elites: tuple[Elite, ...] = ()
    if crossings.code == task.code and len(sequence) <= config.longest:
        best = min((one.objective for one in task.elites if one.exact), default=np.inf)
        if (
            config.limits.objective(replace(quality, excess_crossing_number=np.nan), crossings.nx)
            < best - GAIN
        ):
            elites = _home(simulation, task, symmetry, sequence)
    quality = replace(quality, noise_survival=noise_survival(last, config.reset_noise, rng))
    faults = config.limits.faults(quality, crossings.nx)
    if crossings.code != task.code:
        faults.append("code lost at rest")
    elif pyknotid_code(last) != crossings.code:
        faults.append("labellers disagree")
    elif not _shown_longest_last(points, crossings.code):
        # an episode that ends when the code has been held so long would end there
        faults.append("code shown longer before")
    return Candidate(
        crossings.code,
        tuple(faults),
        task.seed,
        start_qpos,
        actions,
        points,
        qpos,
        quality,
        elites=elites,
    )


def _shown_longest_last(points: Array, code: GaussCode) -> bool:
    """Whether the configurations (T + 1, beads, 3) show `code`, chirality aside, nowhere after the
    first for as long as at the end.
    """
    runs = [
        len(list(run))
        for shown, run in groupby(one.matches(code) for one in label_many(points[1:]))
        if shown
    ]
    return not runs or max(runs[:-1], default=0) < runs[-1]


def _follow(
    simulation: Simulation, sequence: ActionSequence
) -> tuple[NDArray[np.float32], Array] | None:
    """Lead rope 0 down a way; actions (T, 6) and configurations (T + 1, beads, 3), or None if the
    simulation failed.
    """
    actions, points = np.empty((len(sequence), 6), dtype=np.float32), [simulation.points[0].copy()]
    for step, (bead, force) in enumerate(zip(sequence.beads, sequence.forces, strict=True)):
        actions[step], held = step_ropes(simulation, np.array([bead]), force[None], ONE)
        if not held.all():
            return None
        points.append(simulation.points[0].copy())
    return actions, np.stack(points)


def _opening(
    simulation: Simulation, task: CandidateTask, rng: np.random.Generator, at_rest: bool
) -> ActionSequence:
    """Stir rope 0, open it up and let it come to rest, and once more if it doesn't do yet; the way
    from where it lies.
    """
    config, sequence, state = task.config, NO_ACTIONS, simulation.states(ONE)
    if not at_rest:
        if _follow(simulation, STILL) and label(simulation.points[0]) == task.code:
            sequence = STILL
        else:  # what shows the code in motion alone may be opened up in motion
            simulation.restore(state, ONE)
    state, stirring = _stir(
        simulation, int(rng.integers(config.stir + 1)) if task.code.nx else config.stir_loop, rng
    )
    sequence += stirring
    for _ in range(ROUNDS):
        state, opening = hill_climb(simulation, state, config.limits, config.opening, rng)
        sequence += opening + STILL
        simulation.restore(state[None], ONE)
        _follow(simulation, STILL)
        state, crossings = simulation.states(ONE)[0], find_crossings(simulation.points[0])
        if crossings.code != task.code or not config.limits.faults(
            measure(simulation.points[0], crossings, quick=True), crossings.nx
        ):
            break
    return sequence


def _home(
    simulation: Simulation, task: CandidateTask, symmetry: Symmetry, sequence: ActionSequence
) -> tuple[Elite, ...]:
    """Follow a candidate's way once more from where the archive's ways begin; what the rope shows
    there.

    The plain loop is had back exactly whatever was done to it; another start only if it wasn't
    renumbered.
    """
    rope = simulation.rope
    if np.array_equal(task.start, rope.loop()):
        back = symmetry.back_to_loop(rope.config.beads)
    elif symmetry.reverse or symmetry.base_shift:
        return ()
    else:
        back = symmetry.undone()
    home = ActionSequence(
        sequence.beads, back.vectors(sequence.forces.astype(np.float64)).astype(np.float32)
    )
    simulation.lay(rope.qpos(task.start)[None], ONE)
    if _follow(simulation, home) is None:
        return ()
    state = simulation.states(ONE)[0]
    return tuple(
        reading.elite(home, state)
        for reading in readings(simulation.points[0], task.config.limits, task.config.rope)
    )


def _stir(
    simulation: Simulation, steps: int, rng: np.random.Generator
) -> tuple[Array, ActionSequence]:
    """Pull rope 0 about at random without changing what it shows; the state reached and the way
    there.
    """
    code, sequence, state = label(simulation.points[0]), NO_ACTIONS, simulation.states(ONE)
    for _ in range(steps):
        bead, heading, strength = (
            rng.integers(simulation.rope.config.beads, size=1),
            rng.uniform(-np.pi, np.pi),
            rng.uniform(0.3, 1.0),
        )
        force = (strength * np.array([[np.cos(heading), np.sin(heading), 0.0]])).astype(np.float32)
        _, held = step_ropes(simulation, bead, force, ONE)
        if held.all() and label(simulation.points[0]) == code:
            state, sequence = (
                simulation.states(ONE),
                sequence + ActionSequence(bead.astype(np.int16), force),
            )
        else:
            simulation.restore(state, ONE)
    return state[0], sequence


def _symmetry(elite: Elite, code: GaussCode, rng: np.random.Generator) -> Symmetry:
    """A random symmetry that takes what the elite shows to `code`."""
    fitting = [symmetry for shown, symmetry in mirrorings(elite.code) if shown == code]
    symmetry = fitting[rng.integers(len(fitting))]
    turn, base_shift = (
        float(rng.uniform(-np.pi, np.pi)),
        -elite.base_shift if elite.reverse else elite.base_shift,
    )
    return replace(symmetry, turn=turn, reverse=elite.reverse, base_shift=base_shift)


def _rejected(fault: str, task: CandidateTask, rope: Rope) -> Candidate:
    nothing = np.zeros((0, 6), dtype=np.float32)
    return Candidate(
        task.code,
        (fault,),
        task.seed,
        np.zeros(rope.nq),
        nothing,
        task.start[None],
        np.zeros(rope.nq),
        measure(task.start),
    )
