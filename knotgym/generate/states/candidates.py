"""Candidates: one concrete rope state that shows one Gauss code, made from an elite by a symmetry.

A fresh plain loop, noised, turned, renumbered, is led through the elite's action sequence, made
legible by a random walk and a hill climb, left to come to rest, and judged. A state without
crossings begins as a loop of another shape, which is stirred. What comes out is a
state with everything that makes it again bit for bit, or the reason why it was rejected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import check_numbers
from knotgym.common.streams import generator_of
from knotgym.control.action_sequence import NO_ACTIONS, ActionSequence, resting, step_ropes
from knotgym.generate.states.archive import Elite
from knotgym.generate.states.curves import LoopConfig, plain_loop
from knotgym.generate.states.hill_climb import HillClimbConfig, hill_climb
from knotgym.generate.states.search import readings
from knotgym.quality.measures import Limits, Quality, measure, noise_survival
from knotgym.rope.model import Array, Rope, RopeConfig, base_shifts
from knotgym.rope.reset_noise import noised
from knotgym.rope.simulation import Simulation
from knotgym.rope.simulation_pool import simulation_of
from knotgym.topology.crossings import find_crossings, label, label_many
from knotgym.topology.gauss import GaussCode
from knotgym.topology.reference_labeller import pyknotid_code
from knotgym.topology.symmetry import Symmetry, mirrorings, shifted_base

ONE = np.array([0])  # the rope that is led; the others try what may make it legible


@dataclass(frozen=True, kw_only=True)
class CandidateConfig:
    """How candidates are made and judged.

    Attributes:
        limits: of accepted states.
        hill_climb: how hard to make them legible.
        start_noise: of the plain loop each begins as, as `reset_noise.noised`; a tenth of a degree
            makes three sequences in ten miss their code.
        best_share: of candidates made from the best-looking elite of their code; the others are
            made from any.
        jitter: of sequences that hold nearly, at most (see `ActionSequence.jittered`).
        walk_steps: random steps after the sequence at most, so that two candidates of one elite
            lie differently; one that changes the code is taken back.
        loop: the shape that a plain loop begins as, which no sequence leads to.
        loop_walk_steps: `walk_steps` of plain loops.
        walk_force: of a random step, from and to, in units of the largest.
        walk_hold: steps that one bead is pulled one way, at most; what is pulled for longer folds
            the rope, what is pulled for one step dents it.
        walk_slope: largest sine of such a pull's slope.
        loop_enough: `hill_climb.enough` of plain loops, which have no crossing to be read: opened
            further, they are circles again.
        rounds: of hill climb and rest, at most.
        rest: steps of no force at the end; the rope is slower than 1 mm/s after two.
        gain: objective by which a candidate must be better than the archive to go back into it.
        longest: sequence that goes back into the archive.
        reset_noise: that accepted states must survive.
        rope: its physics.
    """

    limits: Limits = Limits()
    hill_climb: HillClimbConfig = HillClimbConfig()
    start_noise: float = 0.0
    best_share: float = 0.5
    jitter: float = 0.04
    walk_steps: int = 6
    loop: LoopConfig = LoopConfig()
    loop_walk_steps: int = 6
    walk_force: tuple[float, float] = (0.3, 1.0)
    walk_hold: int = 20
    walk_slope: float = 0.5
    loop_enough: float = 1.0
    rounds: int = 2
    rest: int = 3
    gain: float = 0.05
    longest: int = 120
    reset_noise: float = 0.015
    rope: RopeConfig = RopeConfig()

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("rounds", "rest", "walk_hold"),
            whole=("walk_steps", "loop_walk_steps", "longest"),
            non_negative=("start_noise", "jitter", "gain", "reset_noise", "loop_enough"),
            shares=("best_share", "walk_slope"),
            ranges=("walk_force",),
        )


class CandidateTask(NamedTuple):
    """One candidate to make.

    Attributes:
        config: how.
        code: that it shall show, with chirality.
        elites: that lead there; it is made from one of them.
        start: configuration (beads, 3) that it begins as.
        seed: key of the stream that it draws from.
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
        points: float64 (T + 1, beads, 3), metres, the configurations before and after each.
        qpos: float64 (nq,), after the last action.
        quality: of the last state.
        steps: actions taken to make it, all that was tried included.
        elites: readings of this state for the archive, if it is better than what the task had,
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
    """Make a candidate; the same task gives the same bytes."""
    simulation = simulation_of(task.config.hill_climb.tries, task.config.rope)
    before = simulation.steps_taken
    candidate = _made(task, simulation)
    return replace(candidate, steps=simulation.steps_taken - before)


def _made(task: CandidateTask, simulation: Simulation) -> Candidate:
    config, rng, rope = task.config, generator_of(task.seed), simulation.rope
    elite = task.elites[int(rng.integers(len(task.elites)))]
    if rng.random() < config.best_share:
        elite = min(task.elites, key=lambda elite: elite.objective)
    symmetry = _symmetry(simulation, elite, task.code, rng)
    start = task.start if task.code.nx else plain_loop(rope, config.loop, config.limits, rng)
    start_qpos = rope.qpos(symmetry.configuration(noised(start, config.start_noise, rng)))
    simulation.lay(start_qpos[None], ONE)
    sequence = ActionSequence(
        symmetry.beads(elite.sequence.beads, config.rope.beads).astype(np.int16),
        symmetry.vectors(elite.sequence.forces.astype(np.float64)).astype(np.float32),
    )
    if symmetry.reverse or symmetry.base_shift:
        sequence = sequence.jittered(rng.uniform(0, config.jitter), rng)
    if _follow(simulation, sequence) is None:
        return _rejected("simulation failed", task, rope)
    if label(simulation.points[0]) != task.code:
        return _rejected("sequence missed the code", task, rope)
    at_rest = not sequence.forces[-config.rest :].any()
    sequence += _make_legible(simulation, task, rng, at_rest)
    simulation.lay(start_qpos[None], ONE)
    followed = _follow(simulation, sequence)
    if followed is None:
        return _rejected("simulation failed", task, rope)
    actions, points = followed
    qpos, last = simulation.qpos(ONE)[0], points[-1]
    crossings = find_crossings(last)
    quality = measure(last, crossings)
    elites: tuple[Elite, ...] = ()
    if task.code.nx and crossings.code == task.code and _is_better(quality, sequence, task):
        elites = _from_start(simulation, task, symmetry, sequence)
    quality = replace(quality, noise_survival=noise_survival(last, config.reset_noise, rng))
    return Candidate(
        crossings.code,
        tuple(_faults(quality, points, task)),
        task.seed,
        start_qpos,
        actions,
        points,
        qpos,
        quality,
        elites=elites,
    )


def _is_better(quality: Quality, sequence: ActionSequence, task: CandidateTask) -> bool:
    """Whether the archive would rather have this state than the elites of the task."""
    config = task.config
    if len(sequence) > config.longest:
        return False
    best = min((elite.objective for elite in task.elites if elite.exact), default=np.inf)
    comparable = replace(quality, excess_crossing_number=np.nan)  # as an archive's elites have it
    return config.limits.objective(comparable, task.code.nx) < best - config.gain


def _faults(quality: Quality, points: Array, task: CandidateTask) -> list[str]:
    """Why a candidate with configurations (T + 1, beads, 3) is rejected, if it is."""
    code = label(points[-1])
    faults = task.config.limits.faults(quality, code.nx)
    if code != task.code:
        faults.append("code lost at rest")
    elif pyknotid_code(points[-1]) != code:
        faults.append("labellers disagree")
    elif not _shown_longest_last(points, code):
        # an episode that ends when the code has been held so long would end there
        faults.append("code shown longer before")
    return faults


def _shown_longest_last(points: Array, code: GaussCode) -> bool:
    """Whether a code, chirality aside, is shown for longer at the end than ever before.

    The first of the configurations (T + 1, beads, 3) doesn't count.
    """
    matching = (shown.matches(code) for shown in label_many(points[1:]))
    runs = [len(list(run)) for matches, run in groupby(matching) if matches]
    return not runs or max(runs[:-1], default=0) < runs[-1]


def _follow(
    simulation: Simulation, sequence: ActionSequence
) -> tuple[NDArray[np.float32], Array] | None:
    """Lead rope 0 through a sequence.

    Returns:
        Actions (T, 6) and configurations (T + 1, beads, 3); None if the simulation failed.
    """
    actions, points = np.empty((len(sequence), 6), dtype=np.float32), [simulation.points[0].copy()]
    for step, (bead, force) in enumerate(zip(sequence.beads, sequence.forces, strict=True)):
        actions[step], held = step_ropes(simulation, np.array([bead]), force[None], ONE)
        if not held.all():
            return None
        points.append(simulation.points[0].copy())
    return actions, np.stack(points)


def _make_legible(
    simulation: Simulation, task: CandidateTask, rng: np.random.Generator, at_rest: bool
) -> ActionSequence:
    """Walk rope 0 about, climb to a legible state and rest, and again if that won't do yet.

    Returns:
        The actions from where the rope lies.
    """
    config, sequence, state = task.config, NO_ACTIONS, simulation.states(ONE)
    rest = resting(config.rest)
    if not at_rest:
        if _follow(simulation, rest) and label(simulation.points[0]) == task.code:
            sequence = rest
        else:  # what shows the code in motion alone may be made legible in motion
            simulation.restore(state, ONE)
    walk_steps = config.walk_steps if task.code.nx else config.loop_walk_steps
    state, walked = _random_walk(simulation, int(rng.integers(walk_steps + 1)), config, rng)
    climb = config.hill_climb
    if not task.code.nx:
        climb = replace(climb, enough=config.loop_enough)
    sequence += walked
    for _ in range(config.rounds):
        state, climbed = hill_climb(simulation, state, config.limits, climb, rng)
        sequence += climbed + rest
        simulation.restore(state[None], ONE)
        _follow(simulation, rest)
        state, crossings = simulation.states(ONE)[0], find_crossings(simulation.points[0])
        if crossings.code != task.code:
            break
        quality = measure(simulation.points[0], crossings, quick=True)
        if not config.limits.faults(quality, crossings.nx):
            break
    return sequence


def _random_walk(
    simulation: Simulation, steps: int, config: CandidateConfig, rng: np.random.Generator
) -> tuple[Array, ActionSequence]:
    """Move rope 0 about at random without changing what it shows.

    A bead is pulled one way until the pull is over or would change the code.

    Returns:
        The integration state reached, and the actions that led there.
    """
    code, sequence, state = label(simulation.points[0]), NO_ACTIONS, simulation.states(ONE)
    left = 0
    for _ in range(steps):
        if not left:
            left = int(rng.integers(1, config.walk_hold + 1))
            bead = rng.integers(simulation.rope.config.beads, size=1)
            heading, strength = rng.uniform(-np.pi, np.pi), rng.uniform(*config.walk_force)
            slope = rng.uniform(-config.walk_slope, config.walk_slope)
            level = np.sqrt(1 - slope**2)
            direction = np.array([[level * np.cos(heading), level * np.sin(heading), slope]])
            forces = (strength * direction).astype(np.float32)
        left -= 1
        _, held = step_ropes(simulation, bead, forces, ONE)
        if held.all() and label(simulation.points[0]) == code:
            state = simulation.states(ONE)
            sequence += ActionSequence(bead.astype(np.int16), forces)
        else:
            simulation.restore(state, ONE)
            left = 0
    return state[0], sequence


def _from_start(
    simulation: Simulation, task: CandidateTask, symmetry: Symmetry, sequence: ActionSequence
) -> tuple[Elite, ...]:
    """Follow a candidate's sequence once more from the archive's start; what the rope shows there.

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
    forces = back.vectors(sequence.forces.astype(np.float64)).astype(np.float32)
    from_start = ActionSequence(sequence.beads, forces)
    simulation.lay(rope.qpos(task.start)[None], ONE)
    if _follow(simulation, from_start) is None:
        return ()
    state = simulation.states(ONE)[0]
    shown = readings(simulation.points[0], task.config.limits, task.config.rope)
    return tuple(reading.elite(from_start, state) for reading in shown)


def _symmetry(
    simulation: Simulation, elite: Elite, code: GaussCode, rng: np.random.Generator
) -> Symmetry:
    """A random symmetry that makes the elite's rope show `code`.

    Among them are the walks that start at another sub-chain, or run the other way, where they show
    it: the crossings then lie elsewhere along the rope.
    """
    simulation.restore(elite.state[None], ONE)
    crossings = find_crossings(simulation.points[0])
    fitting = []
    for base_shift in base_shifts(simulation.rope.config):
        forwards = shifted_base(crossings, base_shift)
        for reverse in (False, True):
            walked = forwards.reversed() if reverse else forwards
            shift = -base_shift if reverse else base_shift
            fitting += [
                replace(symmetry, reverse=reverse, base_shift=shift)
                for shown, symmetry in mirrorings(walked)
                if shown == code
            ]
    turn = float(rng.uniform(-np.pi, np.pi))
    return replace(fitting[rng.integers(len(fitting))], turn=turn)


def _rejected(fault: str, task: CandidateTask, rope: Rope) -> Candidate:
    """A candidate that led nowhere."""
    return Candidate(
        task.code,
        (fault,),
        task.seed,
        start_qpos=np.zeros(rope.nq),
        actions=np.zeros((0, 6), dtype=np.float32),
        points=task.start[None],
        qpos=np.zeros(rope.nq),
        quality=measure(task.start),
    )
