"""Search of the space of Gauss codes, round by round.

A round sets out from states in the archive, one a slot, and leads each rope through random
manoeuvres for a fixed number of pulls; every state that shows few enough crossings is offered to
the archive, in the order of slots. What a slot does depends on the archive at the start of the
round, the seed, the round and the slot alone: rounds come out the same on any workers.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.control.macro_actions import NO_WAY, Hand, Way, propose, pull
from knotgym.control.transition_counts import Transitions, Watch
from knotgym.generate.states.archive import Archive, Elite
from knotgym.quality import Limits, base_spacing, measure
from knotgym.rope import Array, Rope, RopeConfig
from knotgym.runs.executors import Pool
from knotgym.simulation import Simulation
from knotgym.streams import Stream, generator
from knotgym.topology.crossings import find_crossings, label_many
from knotgym.topology.gauss import GaussCode
from knotgym.topology.symmetry import Symmetry, mirror_images, rolled, rolls

JITTER = 0.04  # of ways that hold nearly: the same way would miss again


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """What is searched and how.

    Attributes:
        max_nx: crossings above which a state isn't kept.
        seed: rope i of round r draws from stream SEARCH_ROPE with counters (r, i).
        slots: ropes in a round.
        pulls: that a rope makes in a round.
        longest: ways longer than this are not gone on with.
        rope: its physics.
    """

    max_nx: int = 4
    seed: int = 0
    slots: int = 64
    pulls: int = 12
    longest: int = 48
    rope: RopeConfig = RopeConfig()


class Shift(NamedTuple):
    """A share of a round: slots `slots`, from states (len(slots), nstate)."""

    config: SearchConfig
    round: int
    slots: range
    states: Array


class Trial(NamedTuple):
    """Ways to follow from the plain loop."""

    config: SearchConfig
    ways: tuple[Way, ...]


class Reading(NamedTuple):
    """What a state shows, walked from a sub-chain, the other way if `reverse`."""

    code: GaussCode
    roll: int
    reverse: bool
    badness: float

    def elite(self, way: Way, state: Array) -> Elite:
        """The state with this reading, reached by `way`."""
        return Elite(self.code, self.roll, self.reverse, way, state, self.badness)


class Find(NamedTuple):
    """A state met: by which slot, after how many pulls."""

    slot: int
    pulls: int
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
        archive.offer(reading.elite(NO_WAY, simulation.states()[0]))
    return archive


def advance(archive: Archive, config: SearchConfig, pool: Pool, chunk: int = 16) -> int:
    """Play one round and grow the archive by it.

    Ways to codes that are known only with the walk starting at another sub-chain, or running the
    other way, are tried anew with the rope so renumbered, and the round proper follows.

    Args:
        archive: changed in place.
        config: the same for every round of an archive.
        pool: plays the shifts.
        chunk: slots in a shift; does not change the result.

    Returns:
        How many classes are new.
    """
    number, known = len(archive.growth), len(archive.niches)
    actions = archive.growth[-1]["actions"] if archive.growth else 0
    renumbered = _unconfirmed(archive, config, number)
    trials = [
        Trial(config, tuple(renumbered[first : first + chunk]))
        for first in range(0, len(renumbered), chunk)
    ]
    parents = _parents(archive, config, number)
    shifts = [
        Shift(
            config,
            number,
            range(first, min(first + chunk, config.slots)),
            np.stack([elite.state for elite in parents[first : first + chunk]]),
        )
        for first in range(0, config.slots, chunk)
    ]
    for trial, finds in zip(trials, pool.map(confirm, trials), strict=True):
        actions += sum(len(way) for way in trial.ways)
        for find in finds:
            archive.offer(find.reading.elite(trial.ways[find.slot], find.state))
    for finds, beads, forces, taken, transitions in pool.map(play, shifts):
        archive.transitions.add(transitions)
        actions += int(taken.sum())
        for find in finds:
            row = find.slot % chunk
            way = parents[find.slot].way + Way(beads[row, : find.pulls], forces[row, : find.pulls])
            if len(way) <= config.longest:
                archive.offer(find.reading.elite(way, find.state))
    archive.growth.append({"round": number, "actions": actions, "classes": len(archive.niches)})
    return len(archive.niches) - known


def confirm(trial: Trial) -> list[Find]:
    """Follow each way from the plain loop; what it shows at its end, `Find.slot` counting the
    ways.
    """
    simulation = simulation_of(len(trial.ways), trial.config.rope)
    rope = simulation.rope
    simulation.lay(np.repeat(rope.qpos(rope.loop())[None], len(trial.ways), axis=0))
    alive = np.ones(len(trial.ways), dtype=bool)
    for step in range(max(len(way) for way in trial.ways)):
        ids = np.array(
            [row for row, way in enumerate(trial.ways) if alive[row] and step < len(way)]
        )
        if len(ids):
            _, held = pull(
                simulation,
                np.array([trial.ways[i].beads[step] for i in ids]),
                np.stack([trial.ways[i].forces[step] for i in ids]),
                ids,
            )
            alive[ids] = held
    out: list[Find] = []
    for row in np.flatnonzero(alive):
        for reading in readings(simulation.points[row], Limits(), trial.config.rope):
            if reading.code.nx <= trial.config.max_nx:
                out.append(
                    Find(int(row), len(trial.ways[row]), reading, simulation.states([int(row)])[0])
                )
    return out


def play(
    shift: Shift,
) -> tuple[list[Find], NDArray[np.int16], NDArray[np.float32], NDArray[np.int64], Transitions]:
    """Lead the ropes of a shift through manoeuvres.

    Returns:
        The finds, by slot and then by pull; beads int16 (slots, pulls) and forces float32 (slots,
        pulls, 3) of every pull; how many pulls each slot made before its rope broke, int (slots,);
        and what the manoeuvres did to codes.
    """
    config, slots = shift.config, len(shift.slots)
    simulation = simulation_of(slots, config.rope)
    simulation.restore(shift.states)
    rngs = [generator(Stream.SEARCH_ROPE, config.seed, shift.round, slot) for slot in shift.slots]
    hand, limits = Hand(slots), Limits()
    beads = np.zeros((slots, config.pulls), dtype=np.int16)
    forces = np.zeros((slots, config.pulls, 3), dtype=np.float32)
    taken = np.full(slots, config.pulls)
    alive = np.ones(slots, dtype=bool)
    last = label_many(simulation.points)
    finds: list[Find] = []
    watches = [Watch(rolls(config.rope), config.rope.beads) for _ in shift.slots]
    for step in range(config.pulls):
        for row in np.flatnonzero(hand.idle(simulation.points)):
            manoeuvre = propose(simulation.points[row], rngs[row])
            hand.take(int(row), manoeuvre)
            watches[row].set_out(find_crossings(simulation.points[row]), manoeuvre)
        hand.idle(simulation.points)
        beads[:, step] = hand.beads
        forces[:, step] = hand.forces(simulation.points)
        _, held = pull(simulation, beads[:, step], forces[:, step])
        taken[alive & ~held] = step
        alive &= held
        ended = hand.idle(simulation.points)
        codes = label_many(simulation.points)
        for row in np.flatnonzero(alive):
            if codes[row] != last[row]:
                watches[row].show(find_crossings(simulation.points[row]))
            if codes[row].nx <= config.max_nx and (
                codes[row] != last[row] or ended[row] or step == config.pulls - 1
            ):
                state = simulation.states([int(row)])[0]
                finds += [
                    Find(shift.slots[row], step + 1, reading, state)
                    for reading in readings(simulation.points[row], limits, config.rope)
                ]
        last = codes
    transitions = Transitions()
    for watch in watches:
        transitions.add(watch.transitions)
    return (
        sorted(
            finds, key=lambda find: (find.slot, find.pulls, find.reading.roll, find.reading.reverse)
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
    for roll in rolls(rope):
        code = rolled(crossings, roll)
        badness = limits.badness(
            replace(quality, base_spacing=base_spacing(points, crossings, roll)), code.nx
        )
        for reverse in (False, True):
            reading = Reading(code.reversed() if reverse else code, roll, reverse, badness)
            known = found.setdefault(reading.code, reading)
            if badness < known.badness and (known.roll or known.reverse):
                found[reading.code] = reading
    return list(found.values())


def _unconfirmed(archive: Archive, config: SearchConfig, number: int) -> list[Way]:
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
    ways = []
    for niche in sorted(drawn, key=lambda one: one.plain in sure)[: config.slots // 2]:
        elites = archive.niches[niche]
        elite = elites[rng.integers(len(elites))]
        renumbered = Symmetry(
            reverse=elite.reverse, roll=-elite.roll if elite.reverse else elite.roll
        )
        beads = renumbered.beads(elite.way.beads, config.rope.beads).astype(np.int16)
        back = renumbered.back_to_loop(config.rope.beads)
        way = Way(beads, back.vectors(elite.way.forces.astype(np.float64)).astype(np.float32))
        ways.append(way.jittered(rng.uniform(0, JITTER), rng))
    return ways


def _parents(archive: Archive, config: SearchConfig, number: int) -> list[Elite]:
    """Draw where the slots set out from: classes seldom set out from more often, then any elite
    whose way isn't too long.
    """
    rng = generator(Stream.SEARCH_PARENTS, config.seed, number)
    near = {niche: elites for niche, elites in archive.niches.items() if niche.nx <= config.max_nx}
    able = {
        niche: [one for one in elites if len(one.way) + 4 <= config.longest]
        for niche, elites in near.items()
    }
    niches = [niche for niche, elites in able.items() if elites]
    weights = np.array([1 / np.sqrt(1 + archive.visits.get(niche, 0)) for niche in niches])
    chosen = [niches[i] for i in rng.choice(len(niches), config.slots, p=weights / weights.sum())]
    for niche in chosen:
        archive.visits[niche] = archive.visits.get(niche, 0) + 1
    return [able[niche][rng.integers(len(able[niche]))] for niche in chosen]


_simulations: dict[tuple[int, RopeConfig], Simulation] = {}


def simulation_of(count: int, config: RopeConfig) -> Simulation:
    """This process's simulation of this size, made once; whoever asks lays or restores every rope
    before use.
    """
    key = count, config
    if key not in _simulations:
        _simulations[key] = Simulation(count, Rope(config))
    return _simulations[key]
