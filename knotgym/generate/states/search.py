"""Play: a search of the space of Gauss codes by random macro-actions, in rounds.

A round starts a batch of ropes from states in the archive and applies random macro-actions for a
fixed number of steps. Every state with few enough crossings is offered to the archive, in the order
of the batch. A rope's motion depends only on the archive at the start of the round, the seed, the
round and the rope's index, so the result doesn't depend on the workers.
"""

from collections.abc import Container, Iterator
from dataclasses import asdict, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.configuration import Count, NonNegative, Seed, Share, Whole, configuration
from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream, generator
from knotgym.control.action_sequence import NO_ACTIONS, ActionSequence, step_ropes
from knotgym.control.transition_counts import TransitionCounts, TransitionRecorder
from knotgym.generate.states.archive import Archive, ArchiveConfig, Elite
from knotgym.quality.measures import Limits, base_spacing, measure
from knotgym.rope.engines import MUJOCO, EngineName, simulation, simulation_of
from knotgym.rope.macro_action_config import MacroActionConfig
from knotgym.rope.macro_actions import WaypointController, propose
from knotgym.rope.model import Array, Rope, RopeConfig, base_shifts
from knotgym.runs.engine import Batch
from knotgym.topology.crossings import find_crossings, label_many
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import Symmetry, mirror_images, shifted_base


@configuration
class SearchSettings:
    """Settings of play.

    Attributes:
        batch_size: ropes per round.
        steps: actions of each rope per round.
        longest: maximum length of the action sequence of an elite.
        room: a round starts only from elites whose sequence is at least this much shorter than
            `longest`.
        replay_share: number of sequences that a round replays with renumbered beads, as a fraction
            of the batch size.
        jitter: maximum jitter of these replays (see `ActionSequence.jittered`); the unchanged
            sequence would miss its code again.
        most_templates: recorded examples of macro-actions, per change of code.
        archive: which elites are kept.
        macro_actions: how macro-actions are drawn and executed.
    """

    batch_size: Count = 32
    steps: Count = 12
    longest: Whole = 48
    room: Whole = 4
    replay_share: Share = 0.5
    jitter: NonNegative = 0.04
    most_templates: Whole = 6
    archive: ArchiveConfig = ArchiveConfig()
    macro_actions: MacroActionConfig = MacroActionConfig()

    def __post_init__(self) -> None:
        if self.longest < self.room:
            raise InvalidInput(
                f"longest must be at least room ({self.room}), or no round can start; got"
                f" {self.longest}"
            )


@configuration
class SearchConfig(SearchSettings):
    """Settings of play in one run.

    Attributes:
        max_nx: states with more crossings are not kept.
        seed: rope i of round r draws from stream SEARCH_ROPE with counters (r, i).
        rope: physics of the rope.
        engine: the engine that moves it, see `knotgym.rope.engines`.
    """

    max_nx: Whole = 4
    seed: Seed = 0
    rope: RopeConfig = RopeConfig()
    engine: EngineName = MUJOCO

    def __post_init__(self) -> None:
        super().__post_init__()


class SearchUnit(NamedTuple):
    """A part of a round: ropes `indices` of the batch and their states (len(indices), nstate)."""

    config: SearchConfig
    round: int
    indices: range
    states: Array


class Replay(NamedTuple):
    """Action sequences to replay from the plain loop."""

    config: SearchConfig
    sequences: tuple[ActionSequence, ...]


class Reading(NamedTuple):
    """The Gauss code of a state, read from vertex `base_shift`, backwards if `reverse`."""

    code: GaussCode
    base_shift: int
    reverse: bool
    objective: float

    def elite(self, sequence: ActionSequence, state: Array) -> Elite:
        """Return an elite for a state with this reading that `sequence` reaches."""
        return Elite(self.code, self.base_shift, self.reverse, sequence, state, self.objective)


class Discovery(NamedTuple):
    """A state reached by rope (or replayed sequence) `batch_index` after `steps` actions."""

    batch_index: int
    steps: int
    reading: Reading
    state: Array


def new_archive(config: SearchConfig, start: Array | None = None) -> Archive:
    """Return an archive that starts from the plain loop, or from a configuration (beads, 3)."""
    rope = Rope(config.rope)
    first = simulation(config.engine, 1, rope)
    points = rope.loop() if start is None else start
    first.lay(rope.qpos(points)[None])
    origin = "loop" if start is None else np.asarray(points).tolist()
    archive = Archive(settings={**asdict(config), "start": origin})
    for reading in readings(first.points[0], Limits(), config.rope):
        archive.offer(reading.elite(NO_ACTIONS, first.states()[0]), config.archive)
    return archive


def search_round(
    archive: Archive,
    config: SearchConfig,
    chunk: int = 8,
    wanted: Container[GaussCode] | None = None,
) -> Iterator[Batch]:
    """Yield the work of one round, which adds to the archive as it is absorbed.

    Args:
        archive: changed in place.
        chunk: ropes per unit of work; doesn't change the result.
        wanted: as for `replays`.
    """
    number = len(archive.growth)
    actions = archive.growth[-1]["actions"] if archive.growth else 0
    # Work is chosen from the archive as it is before the round, whatever the pool absorbs first.
    replayed = replays(archive, config, number, 0, chunk, wanted)
    parents = _parents(archive, config, number)
    units = [
        SearchUnit(
            config,
            number,
            range(first, min(first + chunk, config.batch_size)),
            np.stack([elite.state for elite in parents[first : first + chunk]]),
        )
        for first in range(0, config.batch_size, chunk)
    ]

    def absorb_unit(unit: SearchUnit, played: Played) -> None:
        nonlocal actions
        archive.transitions.add(played.transitions, config.most_templates)
        actions += int(played.taken.sum())
        for discovery in played.discoveries:
            # the state's own way: that of the parent, and what this rope did until it was seen
            row, steps = discovery.batch_index - unit.indices.start, discovery.steps
            sequence = parents[discovery.batch_index].sequence + ActionSequence(
                played.beads[row, :steps], played.forces[row, :steps]
            )
            if len(sequence) <= config.longest:
                archive.offer(discovery.reading.elite(sequence, discovery.state), config.archive)

    # replays first: an elite that becomes exact can be a parent of the next round
    yield replayed
    actions += sum(len(sequence) for unit in replayed.units for sequence in unit.sequences)
    yield Batch(play, units, absorb_unit, "playing")
    archive.growth.append({"round": number, "actions": actions, "classes": len(archive.niches)})


def replays(
    archive: Archive,
    config: SearchConfig,
    round: int,
    wave: int,
    chunk: int = 8,
    wanted: Container[GaussCode] | None = None,
) -> Batch:
    """Replay sequences with renumbered beads, to make inexact elites exact.

    An inexact elite shows its code only if it is read from another base vertex or backwards. With
    its beads renumbered accordingly, the sequence should reach the code as it is read normally;
    about every second one does.

    Args:
        archive: changed as the work is absorbed.
        round, wave: keys of the random draws.
        chunk: ropes per unit of work; doesn't change the result.
        wanted: codes, without chirality, whose sequences to replay; None for all.
    """
    sequences = _unconfirmed(archive, config, (round, wave), wanted)
    units = [
        Replay(config, tuple(sequences[first : first + chunk]))
        for first in range(0, len(sequences), chunk)
    ]

    def absorb(replay: Replay, discoveries: list[Discovery]) -> None:
        for discovery in discoveries:
            sequence = replay.sequences[discovery.batch_index]
            archive.offer(discovery.reading.elite(sequence, discovery.state), config.archive)

    return Batch(confirm, units, absorb, "replaying sequences with renumbered beads")


def confirm(replay: Replay) -> list[Discovery]:
    """Replay each sequence from the plain loop; return the readings of the final states."""
    sequences, config = replay.sequences, replay.config
    ropes = simulation_of(len(sequences), config.rope, config.engine)
    rope = ropes.rope
    ropes.lay(np.repeat(rope.qpos(rope.loop())[None], len(sequences), axis=0))
    alive = np.ones(len(sequences), dtype=bool)
    lengths = np.array([len(sequence) for sequence in sequences])
    for step in range(max(lengths)):
        # Sequences differ in length: a rope whose sequence is done is not stepped any more.
        ids = np.flatnonzero(alive & (step < lengths))
        if len(ids):
            beads = np.array([sequences[row].beads[step] for row in ids])
            forces = np.stack([sequences[row].forces[step] for row in ids])
            _, alive[ids] = step_ropes(ropes, beads, forces, ids)
    return [
        Discovery(row, len(sequences[row]), reading, ropes.states([row])[0])
        for row in np.flatnonzero(alive).tolist()
        for reading in readings(ropes.points[row], Limits(), config.rope)
        if reading.code.nx <= config.max_nx
    ]


class Played(NamedTuple):
    """Result of a SearchUnit."""

    discoveries: list[Discovery]  # ordered by rope, then by step
    beads: NDArray[np.int16]  # int16 (ropes, steps), the bead pulled at each step
    forces: NDArray[np.float32]  # float32 (ropes, steps, 3), the force at each step
    taken: NDArray[np.int64]  # int (ropes,), steps of each rope before its simulation failed
    transitions: TransitionCounts  # changes of code caused by macro-actions


def play(unit: SearchUnit) -> Played:
    """Apply random macro-actions to the ropes of a unit."""
    config, count = unit.config, len(unit.indices)
    ropes = simulation_of(count, config.rope, config.engine)
    ropes.restore(unit.states)
    rngs = [generator(Stream.SEARCH_ROPE, config.seed, unit.round, index) for index in unit.indices]
    controller = WaypointController(count, config.macro_actions)
    beads = np.zeros((count, config.steps), dtype=np.int16)
    forces = np.zeros((count, config.steps, 3), dtype=np.float32)
    taken = np.full(count, config.steps)
    alive = np.ones(count, dtype=bool)
    last = label_many(ropes.points)
    discoveries: list[Discovery] = []
    shifts = base_shifts(config.rope)
    recorders = [
        TransitionRecorder(shifts, config.rope.beads, config.most_templates) for _ in unit.indices
    ]
    for step in range(config.steps):
        # A macro-action may end by itself when its bead has arrived; only then is a new one drawn.
        controller.advance(ropes.points)
        # Each rope draws from its own generator, so the ropes in a unit don't matter.
        for row in np.flatnonzero(controller.idle).tolist():
            macro_action = propose(ropes.points[row], rngs[row], config.macro_actions)
            controller.begin(row, macro_action)
            recorders[row].set_out(find_crossings(ropes.points[row]), macro_action)
        controller.advance(ropes.points)
        beads[:, step] = controller.beads
        forces[:, step] = controller.forces(ropes.points)
        _, held = step_ropes(ropes, beads[:, step], forces[:, step])
        taken[alive & ~held] = step  # the failed action itself doesn't count
        alive &= held
        controller.advance(ropes.points)
        ended = controller.idle | (step == config.steps - 1)
        codes = label_many(ropes.points)
        for row in np.flatnonzero(alive).tolist():
            # States are offered when the code changes and at the end of every macro-action.
            is_new = codes[row] != last[row]
            if is_new:
                recorders[row].show(find_crossings(ropes.points[row]))
            if codes[row].nx <= config.max_nx and (is_new or ended[row]):
                state = ropes.states([row])[0]
                discoveries += [
                    Discovery(unit.indices[row], step + 1, reading, state)
                    for reading in readings(ropes.points[row], Limits(), config.rope)
                ]
        last = codes
    discoveries.sort(key=_place)  # the archive depends on the order of the offers
    transitions = TransitionCounts()
    for recorder in recorders:
        transitions.add(recorder.transitions, config.most_templates)
    return Played(discoveries, beads, forces, taken, transitions)


def _place(discovery: Discovery) -> tuple[int, int, int, bool]:
    """Sort key of discoveries."""
    reading = discovery.reading
    return discovery.batch_index, discovery.steps, reading.base_shift, reading.reverse


def readings(points: Array, limits: Limits, rope: RopeConfig) -> list[Reading]:
    """Read the Gauss code of a state from every base vertex, in both directions.

    Of several readings with the same code, the exact one is kept, otherwise the most legible.
    """
    crossings = find_crossings(points)
    quality = measure(points, crossings, quick=True)
    # Crossings don't depend on the base vertex, only their numbering and the base spacing do.
    best: dict[GaussCode, Reading] = {}
    for base_shift in base_shifts(rope):
        code = shifted_base(crossings, base_shift)
        seen = replace(quality, base_spacing=base_spacing(points, crossings, base_shift))
        objective = limits.objective(seen, code.nx)
        for reverse in (False, True):
            reading = Reading(code.reversed() if reverse else code, base_shift, reverse, objective)
            known = best.setdefault(reading.code, reading)  # the exact reading comes first
            if objective < known.objective and (known.base_shift or known.reverse):
                best[reading.code] = reading
    return list(best.values())


def _unconfirmed(
    archive: Archive,
    config: SearchConfig,
    number: tuple[int, int],
    wanted: Container[GaussCode] | None,
) -> list[ActionSequence]:
    """Return renumbered sequences to codes that have no exact elite.

    Codes without an exact elite of any chirality come first. Renumbering works because the plain
    loop with shifted beads is the same loop, rotated; with reversed beads, mirrored.
    """
    if archive.settings["start"] != "loop":
        return []
    rng = generator(Stream.SEARCH_REPLAYS, config.seed, *number)
    # codes that some exact elite reaches, in any chirality and mirror image
    sure = {
        image.plain
        for niche in archive.niches
        if archive.sure(niche)
        for image in mirror_images(niche)
    }
    # niches still to be made exact; the plain loop (nx 0) always is
    near = [
        niche
        for niche in archive.niches
        if 0 < niche.nx <= config.max_nx
        and not archive.sure(niche)
        and (wanted is None or any(image.plain in wanted for image in mirror_images(niche)))
    ]
    drawn = [near[pick] for pick in rng.permutation(len(near))]
    # stable: within either group the random order stays
    drawn.sort(key=lambda niche: niche.plain in sure)
    sequences = []
    for niche in drawn[: int(config.replay_share * config.batch_size)]:
        elites = archive.niches[niche]
        sequence = renumbered(elites[rng.integers(len(elites))], config.rope.beads)
        sequences.append(sequence.jittered(rng.uniform(0, config.jitter), rng))
    return sequences


def renumbered(elite: Elite, beads: int) -> ActionSequence:
    """Return an elite's sequence with beads numbered in the direction in which its code is read.

    From the plain loop it leads approximately to the elite's state.
    """
    # Reversal comes before the shift, so a reversed reading shifts the other way.
    numbering = Symmetry(
        reverse=elite.reverse,
        base_shift=-elite.base_shift if elite.reverse else elite.base_shift,
    )
    forces = elite.sequence.forces.astype(np.float64)
    return ActionSequence(
        numbering.beads(elite.sequence.beads, beads).astype(np.int16),
        numbering.back_to_loop(beads).vectors(forces).astype(np.float32),
    )


def _parents(archive: Archive, config: SearchConfig, number: int) -> list[Elite]:
    """Draw the elites from which ropes start; rarely visited classes are more likely."""
    rng = generator(Stream.SEARCH_PARENTS, config.seed, number)
    # An elite whose sequence leaves no room for a round can't be a parent.
    near = {niche: elites for niche, elites in archive.niches.items() if niche.nx <= config.max_nx}
    able = {
        niche: [elite for elite in elites if len(elite.sequence) + config.room <= config.longest]
        for niche, elites in near.items()
    }
    niches = [niche for niche, elites in able.items() if elites]
    # Weights fall with visits, but slowly, so that well-known classes are still explored further.
    weights = np.array([1 / np.sqrt(1 + archive.visits.get(niche, 0)) for niche in niches])
    picks = rng.choice(len(niches), config.batch_size, p=weights / weights.sum())
    chosen = [niches[pick] for pick in picks]
    for niche in chosen:
        archive.visits[niche] = archive.visits.get(niche, 0) + 1
    return [able[niche][rng.integers(len(able[niche]))] for niche in chosen]
