"""Search of the space of Gauss codes, round by round.

A round sets out from states in the archive, one a slot, and leads each rope through random
macro-actions for a fixed number of pulls; every state that shows few enough crossings is offered to
the archive, in the order of slots. What a slot does depends on the archive at the start of the
round, the seed, the round and the slot alone: rounds come out the same on any workers.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.control.macro_actions import (
    NO_ACTIONS,
    ActionSequence,
    WaypointController,
    propose,
    step_ropes,
)
from knotgym.control.transition_counts import TransitionCounts, TransitionRecorder
from knotgym.generate.states.archive import Archive, Elite
from knotgym.quality import Limits, base_spacing, measure
from knotgym.rope import Array, Rope, RopeConfig, base_shifts
from knotgym.runs.executors import Pool
from knotgym.simulation import Simulation
from knotgym.simulation_pool import simulation_of
from knotgym.streams import Stream, generator
from knotgym.topology.crossings import find_crossings, label_many
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import Symmetry, mirror_images, shifted_base

JITTER = 0.04  # of ways that hold nearly: the same way would miss again


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """What is searched and how.

    Attributes:
        max_nx: crossings above which a state isn't kept.
        seed: rope i of round r draws from stream SEARCH_ROPE with counters (r, i).
        batch_size: ropes in a round.
        pulls: that a rope makes in a round.
        longest: ways longer than this are not gone on with.
        rope: its physics.
    """

    max_nx: int = 4
    seed: int = 0
    batch_size: int = 64
    steps: int = 12
    longest: int = 48
    rope: RopeConfig = RopeConfig()


class SearchUnit(NamedTuple):
    """A share of a round: slots `slots`, from states (len(slots), nstate)."""

    config: SearchConfig
    round: int
    indices: range
    states: Array


class Replay(NamedTuple):
    """Ways to follow from the plain loop."""

    config: SearchConfig
    sequences: tuple[ActionSequence, ...]


class Reading(NamedTuple):
    """What a state shows, walked from a sub-chain, the other way if `reverse`."""

    code: GaussCode
    base_shift: int
    reverse: bool
    objective: float

    def elite(self, sequence: ActionSequence, state: Array) -> Elite:
        """The state with this reading, reached by `way`."""
        return Elite(self.code, self.base_shift, self.reverse, sequence, state, self.objective)


class Discovery(NamedTuple):
    """A state met: by which slot, after how many pulls."""

    batch_index: int
    steps: int
    reading: Reading
    state: Array


def new_archive(config: SearchConfig, start: Array | None = None) -> Archive:
    """An archive that begins at the plain loop, or at another configuration (beads, 3)."""
    rope = Rope(config.rope)
    simulation = Simulation(1, rope)
    points = rope.loop() if start is None else start
    simulation.lay(rope.qpos(points)[None])
    archive = Archive(
        settings={
            **asdict(config),
            "start": "loop" if start is None else np.asarray(points).tolist(),
        }
    )
    for reading in readings(rope.points(simulation.qpos()[0]), Limits(), config.rope):
        archive.offer(reading.elite(NO_ACTIONS, simulation.states()[0]))
    return archive


def advance(archive: Archive, config: SearchConfig, pool: Pool, chunk: int = 16) -> int:
    """Play one round and grow the archive by it.

    Ways to codes that are known only with the walk starting at another sub-chain, or running the
    other way, are tried anew with the rope so renumbered, and the round proper follows.

    Args:
        archive: changed in place.
        config: the same for every round of an archive.
        pool: plays the units.
        chunk: slots in a unit; does not change the result.

    Returns:
        How many classes are new.
    """
    number, known = len(archive.growth), len(archive.niches)
    actions = archive.growth[-1]["actions"] if archive.growth else 0
    renumbered = _unconfirmed(archive, config, number)
    replays = [
        Replay(config, tuple(renumbered[first : first + chunk]))
        for first in range(0, len(renumbered), chunk)
    ]
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
    for replay, discoveries in zip(replays, pool.map(confirm, replays), strict=True):
        actions += sum(len(sequence) for sequence in replay.sequences)
        for find in discoveries:
            archive.offer(find.reading.elite(replay.sequences[find.batch_index], find.state))
    for discoveries, beads, forces, taken, transitions in pool.map(play, units):
        archive.transitions.add(transitions)
        actions += int(taken.sum())
        for find in discoveries:
            row = find.batch_index % chunk
            sequence = parents[find.batch_index].sequence + ActionSequence(
                beads[row, : find.steps], forces[row, : find.steps]
            )
            if len(sequence) <= config.longest:
                archive.offer(find.reading.elite(sequence, find.state))
    archive.growth.append({"round": number, "actions": actions, "classes": len(archive.niches)})
    return len(archive.niches) - known


def confirm(replay: Replay) -> list[Discovery]:
    """Follow each way from the plain loop; what it shows at its end, `Discovery.slot` counting the
    ways.
    """
    simulation = simulation_of(len(replay.sequences), replay.config.rope)
    rope = simulation.rope
    simulation.lay(np.repeat(rope.qpos(rope.loop())[None], len(replay.sequences), axis=0))
    alive = np.ones(len(replay.sequences), dtype=bool)
    for step in range(max(len(sequence) for sequence in replay.sequences)):
        ids = np.array(
            [
                row
                for row, sequence in enumerate(replay.sequences)
                if alive[row] and step < len(sequence)
            ]
        )
        if len(ids):
            _, held = step_ropes(
                simulation,
                np.array([replay.sequences[i].beads[step] for i in ids]),
                np.stack([replay.sequences[i].forces[step] for i in ids]),
                ids,
            )
            alive[ids] = held
    out: list[Discovery] = []
    for row in np.flatnonzero(alive):
        for reading in readings(simulation.points[row], Limits(), replay.config.rope):
            if reading.code.nx <= replay.config.max_nx:
                out.append(
                    Discovery(
                        int(row),
                        len(replay.sequences[row]),
                        reading,
                        simulation.states([int(row)])[0],
                    )
                )
    return out


def play(
    unit: SearchUnit,
) -> tuple[
    list[Discovery], NDArray[np.int16], NDArray[np.float32], NDArray[np.int64], TransitionCounts
]:
    """Lead the ropes of a unit through macro_actions.

    Returns:
        The discoveries, by slot and then by pull; beads int16 (slots, pulls) and forces float32
        (slots, pulls, 3) of every pull; how many pulls each slot made before its rope broke, int
        (slots,); and what the macro-actions did to codes.
    """
    config, count = unit.config, len(unit.indices)
    simulation = simulation_of(count, config.rope)
    simulation.restore(unit.states)
    rngs = [generator(Stream.SEARCH_ROPE, config.seed, unit.round, index) for index in unit.indices]
    controller, limits = WaypointController(count), Limits()
    beads = np.zeros((count, config.steps), dtype=np.int16)
    forces = np.zeros((count, config.steps, 3), dtype=np.float32)
    taken = np.full(count, config.steps)
    alive = np.ones(count, dtype=bool)
    last = label_many(simulation.points)
    discoveries: list[Discovery] = []
    watches = [
        TransitionRecorder(base_shifts(config.rope), config.rope.beads) for _ in unit.indices
    ]
    for step in range(config.steps):
        controller.advance(simulation.points)
        for row in np.flatnonzero(controller.idle):
            macro_action = propose(simulation.points[row], rngs[row])
            controller.begin(int(row), macro_action)
            watches[row].set_out(find_crossings(simulation.points[row]), macro_action)
        controller.advance(simulation.points)
        beads[:, step] = controller.beads
        forces[:, step] = controller.forces(simulation.points)
        _, held = step_ropes(simulation, beads[:, step], forces[:, step])
        taken[alive & ~held] = step
        alive &= held
        controller.advance(simulation.points)
        ended = controller.idle
        codes = label_many(simulation.points)
        for row in np.flatnonzero(alive):
            if codes[row] != last[row]:
                watches[row].show(find_crossings(simulation.points[row]))
            if codes[row].nx <= config.max_nx and (
                codes[row] != last[row] or ended[row] or step == config.steps - 1
            ):
                state = simulation.states([int(row)])[0]
                discoveries += [
                    Discovery(unit.indices[row], step + 1, reading, state)
                    for reading in readings(simulation.points[row], limits, config.rope)
                ]
        last = codes
    transitions = TransitionCounts()
    for watch in watches:
        transitions.add(watch.transitions)
    return (
        sorted(
            discoveries,
            key=lambda find: (
                find.batch_index,
                find.steps,
                find.reading.base_shift,
                find.reading.reverse,
            ),
        ),
        beads,
        forces,
        taken,
        transitions,
    )


def readings(points: Array, limits: Limits, rope: RopeConfig) -> list[Reading]:
    """What one state shows walked from each sub-chain, either way; of several readings of one code
    the exact one, or the best.
    """
    crossings = find_crossings(points)
    quality = measure(points, crossings, quick=True)
    found: dict[GaussCode, Reading] = {}
    for base_shift in base_shifts(rope):
        code = shifted_base(crossings, base_shift)
        objective = limits.objective(
            replace(quality, base_spacing=base_spacing(points, crossings, base_shift)), code.nx
        )
        for reverse in (False, True):
            reading = Reading(code.reversed() if reverse else code, base_shift, reverse, objective)
            known = found.setdefault(reading.code, reading)
            if objective < known.objective and (known.base_shift or known.reverse):
                found[reading.code] = reading
    return list(found.values())


def _unconfirmed(archive: Archive, config: SearchConfig, number: int) -> list[ActionSequence]:
    """Ways for the rope renumbered, to codes that no elite shows as it is numbered; half as many as
    slots.

    Codes of which no chirality is shown so come first.

    The plain loop, renumbered, is the plain loop again once it is turned back, or seen in a mirror
    where it is walked the other way.
    """
    if archive.settings["start"] != "loop":
        return []
    rng = generator(Stream.SEARCH_REPLAYS, config.seed, number)
    sure = {
        image.plain
        for niche in archive.niches
        if archive.sure(niche)
        for image in mirror_images(niche)
    }
    near = [
        niche
        for niche in archive.niches
        if 0 < niche.nx <= config.max_nx and not archive.sure(niche)
    ]
    drawn = [near[pick] for pick in rng.permutation(len(near))]
    sequences = []
    for niche in sorted(drawn, key=lambda one: one.plain in sure)[: config.batch_size // 2]:
        elites = archive.niches[niche]
        elite = elites[rng.integers(len(elites))]
        renumbered = Symmetry(
            reverse=elite.reverse,
            base_shift=-elite.base_shift if elite.reverse else elite.base_shift,
        )
        beads = renumbered.beads(elite.sequence.beads, config.rope.beads).astype(np.int16)
        back = renumbered.back_to_loop(config.rope.beads)
        sequence = ActionSequence(
            beads, back.vectors(elite.sequence.forces.astype(np.float64)).astype(np.float32)
        )
        sequences.append(sequence.jittered(rng.uniform(0, JITTER), rng))
    return sequences


def _parents(archive: Archive, config: SearchConfig, number: int) -> list[Elite]:
    """Draw where the slots set out from: classes seldom set out from more often, then any elite
    whose way isn't too long.
    """
    rng = generator(Stream.SEARCH_PARENTS, config.seed, number)
    near = {niche: elites for niche, elites in archive.niches.items() if niche.nx <= config.max_nx}
    able = {
        niche: [one for one in elites if len(one.sequence) + 4 <= config.longest]
        for niche, elites in near.items()
    }
    niches = [niche for niche, elites in able.items() if elites]
    weights = np.array([1 / np.sqrt(1 + archive.visits.get(niche, 0)) for niche in niches])
    chosen = [
        niches[i] for i in rng.choice(len(niches), config.batch_size, p=weights / weights.sum())
    ]
    for niche in chosen:
        archive.visits[niche] = archive.visits.get(niche, 0) + 1
    return [able[niche][rng.integers(len(able[niche]))] for niche in chosen]
