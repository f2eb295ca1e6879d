"""Demonstrations: action sequences of the archive, replayed from the start to a code.

The start is rotated about z by a random angle, and mirrored if only the mirror image of the code is
known. Symmetries transform a sequence exactly (`topology.symmetry`) except for rounding errors,
which make some sequences fail. A demonstration ends when the rope first shows the code. If the
sequence ends in a legible state, it is replayed to its end and left to rest; if that state keeps
all limits, it becomes a state of the set.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.streams import generator_of
from knotgym.control.action_sequence import ActionSequence, resting, step_ropes
from knotgym.datasets.trajectory import Episode
from knotgym.envs.reward import consecutive, success_at_last
from knotgym.generate.states.archive import Elite
from knotgym.generate.states.drawn_states import ONE, MadeState, judged
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.quality.measures import measure
from knotgym.rope.actions import steps_taken
from knotgym.rope.engines import simulation_of
from knotgym.rope.model import Array, RopeConfig
from knotgym.rope.simulation import Simulation
from knotgym.states.schema import PLAY
from knotgym.topology.crossings import label, label_many
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT
from knotgym.topology.knots import shows
from knotgym.topology.symmetry import Symmetry, mirrorings

POLICY = "demonstrations"
TRIES = 6  # replays per demonstration, at most
TURNED = 4  # the first replays have a rotated start; the others start like the archive's


class DemonstrationTask(NamedTuple):
    """A demonstration to make."""

    config: GenerateConfig
    knot: str  # name of the rope's knot in the knot table
    code: GaussCode  # goal, without chirality
    which: int  # index of the code among those of its nx
    start: Array  # start configuration (beads, 3) of the sequences
    elites: tuple[Elite, ...]  # their sequences lead to the code or its mirror image
    seed: tuple[int, ...]  # key of the random stream


@dataclass(frozen=True, eq=False)
class Demonstration:
    """T actions from the start to a state with a given code."""

    start_qpos: Array  # float64 (nq,), the start, at rest
    actions: NDArray[np.float32]  # float32 (T, 6)
    points: Array  # float64 (T + 1, beads, 3), metres, before and after each action
    # float64 (T + 1,), the fraction of its force that each action applied; the first value is 1
    shares: Array

    def __len__(self) -> int:
        return len(self.actions)

    def until(self, steps: int) -> Demonstration:
        """Return the demonstration cut after `steps` actions."""
        return Demonstration(
            self.start_qpos,
            self.actions[:steps],
            self.points[: steps + 1],
            self.shares[: steps + 1],
        )

    def episode(self, goal_points: Array, goal: GaussCode) -> Episode:
        """Return the episode with goal code `goal`, shown by `goal_points` (beads, 3)."""
        codes = label_many(self.points)
        shown = np.array([code.matches(goal) for code in codes])
        beads, forces = steps_taken(self.actions, self.points, RopeConfig())
        outcome = success_at_last(len(self))
        return Episode(
            start_qpos=self.start_qpos,
            points=self.points,
            goal_points=goal_points,
            actions=self.actions,
            rewards=outcome.rewards,
            terminations=outcome.terminated,
            truncations=outcome.truncated,
            gauss_code=np.array([str(code) for code in codes]),
            gauss_code_chiral=np.array([code.chiral for code in codes]),
            crossings=np.array([code.nx for code in codes], dtype=np.int64),
            bead=beads,
            force=self.shares[:, None] * forces,
            applied_share=self.shares,
            is_success=np.concatenate([[False], outcome.terminated]),
            simulation_failed=np.zeros(len(self) + 1, dtype=bool),
            goal_gauss_code=str(goal),
            policy=POLICY,
            hold=int(consecutive(shown[1:])[-1]),
        )


class Demonstrated(NamedTuple):
    """Result of a DemonstrationTask."""

    demonstration: Demonstration | None  # None if no replay reached the code
    state: MadeState | None  # its final state if that is accepted for the set, otherwise None
    spent: int  # number of simulated actions


def demonstrate(task: DemonstrationTask) -> Demonstrated:
    """Make a demonstration; the same task gives the same bytes."""
    rng = generator_of(task.seed)
    simulation = simulation_of(1, RopeConfig(), task.config.engine)
    before = simulation.steps_taken
    # elites whose end is legible may give a state as well as a way
    legible = [elite for elite in task.elites if _is_legible(elite, simulation, task)]
    for number in range(TRIES):
        turned = number < TURNED
        known = (legible if turned else ()) or task.elites
        elite = known[int(rng.integers(len(known)))]
        symmetry = _symmetry(elite, task, turned, rng)
        rests = task.config.rest if turned and legible else 0
        sequence = elite.sequence + resting(rests)
        made = followed(simulation, symmetry.configuration(task.start), sequence, symmetry)
        shown = [code.matches(task.code) for code in label_many(made.points)[1:]]
        if not any(shown):
            continue
        state = None
        if rests and shown[-1] and _is_longest_last(shown):
            state = _state(made, simulation, task, rng)
        if state is None:
            made = made.until(shown.index(True) + 1)
        return Demonstrated(made, state, simulation.steps_taken - before)
    return Demonstrated(None, None, simulation.steps_taken - before)


def followed(
    simulation: Simulation,
    start: Array,
    sequence: ActionSequence,
    symmetry: Symmetry,
) -> Demonstration:
    """Replay a sequence, transformed by a symmetry, on rope 0 until it ends or fails."""
    forces = symmetry.vectors(sequence.forces.astype(np.float64)).astype(np.float32)
    pulls = zip(sequence.beads, forces, strict=True)
    return _recorded(
        simulation,
        simulation.rope.qpos(start),
        (step_ropes(simulation, np.array([bead]), force[None], ONE) for bead, force in pulls),
    )


def acted_out(
    simulation: Simulation, start_qpos: Array, actions: NDArray[np.float32]
) -> Demonstration:
    """Replay actions (T, 6) on rope 0 until they end or the simulation fails."""
    steps = ((action[None], simulation.act(action[None], ONE)) for action in actions)
    return _recorded(simulation, start_qpos, steps)


def _recorded(
    simulation: Simulation,
    start_qpos: Array,
    steps: Iterable[tuple[NDArray[np.float32], NDArray[np.bool_]]],
) -> Demonstration:
    """Place rope 0 at the start and record its steps; iterating over `steps` advances the rope."""
    simulation.lay(start_qpos[None], ONE)
    actions, points, shares = [], [simulation.points[0].copy()], [1.0]
    for action, held in steps:
        if not held.all():
            break
        actions.append(action[0])
        points.append(simulation.points[0].copy())
        shares.append(float(simulation.applied_shares[0]))
    taken = np.array(actions, dtype=np.float32).reshape(-1, 6)
    return Demonstration(start_qpos, taken, np.stack(points), np.array(shares))


def carried_over(elite: Elite, code: GaussCode, knot: str) -> list[Symmetry]:
    """Return the reflections that make an elite show a code without chirality as a given knot."""
    return [
        symmetry
        for shown, symmetry in mirrorings(elite.code)
        if shown.plain == code and (knot == UNKNOT or shows(shown, knot))
    ]


def _symmetry(
    elite: Elite, task: DemonstrationTask, turned: bool, rng: np.random.Generator
) -> Symmetry:
    """Return a symmetry that makes the elite show the code.

    If `turned` is false and no reflection is needed, it is the identity, with which the sequence
    ends in the elite's state bit for bit.
    """
    fitting = carried_over(elite, task.code, task.knot)
    if not turned:
        return fitting[0]  # `mirrorings` starts with the identity
    chosen = fitting[int(rng.integers(len(fitting)))]
    return Symmetry(chosen.reflect, chosen.switch, turn=float(rng.uniform(-np.pi, np.pi)))


def _is_legible(elite: Elite, simulation: Simulation, task: DemonstrationTask) -> bool:
    """Whether an elite's state, still in motion, keeps the limits."""
    simulation.restore(elite.state[None], ONE)
    points = simulation.points[0].copy()
    return not task.config.limits.faults(measure(points, quick=True), task.code.nx)


def _is_longest_last(shown: list[bool]) -> bool:
    """Whether the final run of steps that show the code is longer than any before.

    Otherwise an episode whose `hold` is that length would already have ended earlier.
    """
    runs = consecutive(shown)
    return not (runs[: len(runs) - int(runs[-1])] >= runs[-1]).any()


def _state(
    made: Demonstration, simulation: Simulation, task: DemonstrationTask, rng: np.random.Generator
) -> MadeState | None:
    """Return the final state of a demonstration as a state of the set; None if it is rejected."""
    points, qpos = made.points[-1], simulation.qpos(ONE)[0]
    code = label(points)
    quality, faults = judged(points, code, task.config.limits, rng)
    if faults:
        return None
    return MadeState(
        PLAY, code, task.which, task.seed, made.start_qpos, made.actions, qpos, points, quality
    )
