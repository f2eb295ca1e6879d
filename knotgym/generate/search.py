"""Search of the space of Gauss codes, round by round.

A round sets out from states in the archive, one a slot, and leads each rope through random manoeuvres for a fixed number of
pulls; every state that shows few enough crossings is offered to the archive, in the order of slots. What a slot does depends
on the archive at the start of the round, the seed, the round and the slot alone: rounds come out the same on any workers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from knotgym.crossings import label, label_many
from knotgym.gauss import GaussCode
from knotgym.generate.archive import Archive, Elite, begun
from knotgym.generate.manoeuvres import Hand, Way, propose, pull
from knotgym.generate.quality import Limits, measure
from knotgym.rope import Array, Rope, RopeConfig
from knotgym.simulation import Simulation


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """What is searched and how.

    Attributes:
        max_nx: crossings above which a state isn't kept.
        seed: slot s of round r draws from SeedSequence([seed, r, s]).
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


class Pool(Protocol):
    """Something that maps a function over work, results in the order of the work; see `engines`."""

    def map(self, function: Callable[[Any], Any], work: Iterable[Any]) -> Iterable[Any]: ...


class Shift(NamedTuple):
    """A share of a round: slots `slots`, from states (len(slots), nstate)."""

    config: SearchConfig
    round: int
    slots: range
    states: Array


class Find(NamedTuple):
    """A state met: by which slot, after how many pulls."""

    slot: int
    pulls: int
    code: GaussCode
    badness: float
    state: Array


def new_archive(config: SearchConfig, start: Array | None = None) -> Archive:
    """An archive that begins at the plain loop, or at another configuration (beads, 3)."""
    rope = Rope(config.rope)
    simulation = Simulation(1, rope)
    points = rope.loop() if start is None else start
    simulation.lay(rope.qpos(points)[None])
    return begun(simulation.states()[0], label(points), {**asdict(config), "start": np.asarray(points).tolist() if start is not None else "loop"})


def advance(archive: Archive, config: SearchConfig, pool: Pool, chunk: int = 16) -> list[GaussCode]:
    """Play one round and grow the archive by it.

    Args:
        archive: changed in place.
        config: the same for every round of an archive.
        pool: plays the shifts.
        chunk: slots in a shift; does not change the result.

    Returns:
        The classes that are new.
    """
    number = len(archive.growth)
    parents = _parents(archive, config, number)
    shifts = [
        Shift(config, number, range(first, min(first + chunk, config.slots)), np.stack([elite.state for elite in parents[first : first + chunk]]))
        for first in range(0, config.slots, chunk)
    ]
    new: list[GaussCode] = []
    actions = archive.growth[-1]["actions"] if archive.growth else 0
    for finds, beads, forces, taken in pool.map(play, shifts):
        actions += int(taken.sum())
        for find in finds:
            row = find.slot % chunk
            way = parents[find.slot].way + Way(beads[row, : find.pulls], forces[row, : find.pulls])
            if len(way) <= config.longest and archive.offer(Elite(find.code, way, find.state, find.badness)):
                new.append(find.code)
    archive.growth.append({"round": number, "actions": actions, "classes": len(archive.niches)})
    return new


def play(shift: Shift) -> tuple[list[Find], Array, Array, Array]:
    """Lead the ropes of a shift through manoeuvres.

    Returns:
        The finds, by slot and then by pull; beads int16 (slots, pulls) and forces float32 (slots, pulls, 3) of every pull;
        and how many pulls each slot made before its rope broke, int (slots,).
    """
    config, slots = shift.config, len(shift.slots)
    simulation = _simulation(slots, config.rope)
    simulation.restore(shift.states)
    rngs = [np.random.default_rng([config.seed, shift.round, slot]) for slot in shift.slots]
    hand, limits = Hand(slots), Limits()
    beads = np.zeros((slots, config.pulls), dtype=np.int16)
    forces = np.zeros((slots, config.pulls, 3), dtype=np.float32)
    taken = np.full(slots, config.pulls)
    alive = np.ones(slots, dtype=bool)
    last = label_many(simulation.points)
    finds: list[Find] = []
    for step in range(config.pulls):
        for row in np.flatnonzero(hand.idle(simulation.points)):
            hand.take(int(row), propose(simulation.points[row], rngs[row]))
        hand.idle(simulation.points)
        beads[:, step] = hand.beads
        forces[:, step] = hand.forces(simulation.points)
        _, held = pull(simulation, beads[:, step], forces[:, step])
        taken[alive & ~held] = step
        alive &= held
        ended = hand.idle(simulation.points)
        codes = label_many(simulation.points)
        for row in np.flatnonzero(alive):
            if codes[row].nx <= config.max_nx and (codes[row] != last[row] or ended[row] or step == config.pulls - 1):
                badness = limits.badness(measure(simulation.points[row]), codes[row].nx)
                finds.append(Find(shift.slots[row], step + 1, codes[row], badness, simulation.states([row])[0]))
        last = codes
    return sorted(finds, key=lambda find: (find.slot, find.pulls)), beads, forces, taken


def _parents(archive: Archive, config: SearchConfig, number: int) -> list[Elite]:
    """Draw where the slots set out from: classes seldom set out from more often, then any elite whose way isn't too long."""
    rng = np.random.default_rng([config.seed, number, config.slots])
    able = {niche: [one for one in elites if len(one.way) + 4 <= config.longest] for niche, elites in archive.niches.items() if niche.nx <= config.max_nx}
    niches = [niche for niche, elites in able.items() if elites]
    weights = np.array([1 / np.sqrt(1 + archive.visits.get(niche, 0)) for niche in niches])
    chosen = [niches[i] for i in rng.choice(len(niches), config.slots, p=weights / weights.sum())]
    for niche in chosen:
        archive.visits[niche] = archive.visits.get(niche, 0) + 1
    return [able[niche][rng.integers(len(able[niche]))] for niche in chosen]


_simulations: dict[tuple[int, RopeConfig], Simulation] = {}


def _simulation(count: int, config: RopeConfig) -> Simulation:
    """This process's simulation of this size, made once; whoever asks lays or restores every rope before use."""
    key = count, config
    if key not in _simulations:
        _simulations[key] = Simulation(count, Rope(config))
    return _simulations[key]
