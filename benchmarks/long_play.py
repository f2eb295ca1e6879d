"""What hard play does to the rope in either engine: NaN, gaps, knot type, memory.

    python benchmarks/long_play.py --engine chain --actions 10000000 --ropes 512 --out chain.json

Ropes are played side by side in slices. Half of each slice starts from plain loops and half from
the states that ship. The slices take these ways of playing in turn: "random" actions; "one bead",
full force on one bead in one direction; "neighbours", two neighbouring beads pulled apart in turn;
"through", a bead at a crossing pulled with full force at the strand that it crosses; "tow", the
same action; "across", a bead pulled towards the one halfway round the rope. A bead and a direction
are kept for 20 actions.

Every action is checked for NaN and for gaps (in the chain: for edges that aren't as long as a
bead). Whenever the Gauss code changes, the new one must still be of the unknot
(knotgym.topology.knots: Reidemeister moves, then Alexander and Jones). By Reidemeister's theorem
his moves then lead from the old code to the new one; "flips" counts changes of one crossing alone,
not a kink, from over to under, which is what a strand that slips through another looks like. The
chain carries out the action of a flip again, and every instant at which the code changes is found
by bisection: "explained" counts the flips in which each of those changes is one Reidemeister move.
Slices that --out holds are not played again, so an interrupted run can be resumed.
"""

from __future__ import annotations

import argparse
import functools
import json
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Failed, InvalidInput
from knotgym.rope import ENGINES, MUJOCO, Array, ChainSimulation, Simulation
from knotgym.rope import simulation as simulation_of
from knotgym.states import read_states, shipped
from knotgym.topology import (
    UNKNOT,
    GaussCode,
    faces,
    find_crossings,
    label,
    label_many,
    removals,
    shows,
)

HOLD = 20  # actions with the same bead and direction
Random = np.random.Generator
Pull = tuple[NDArray[np.int64], Array]  # beads and forces, newtons, of all ropes
Way = Callable[[Simulation, Random, int], Pull]


def _directions(rng: Random, count: int) -> Array:
    drawn = rng.normal(size=(count, 3))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def _fixed(seeds: Random, step: int) -> Random:
    """A generator that draws the same at HOLD actions of a slice, one after the other."""
    entropy = seeds.bit_generator.seed_seq.entropy  # type: ignore[attr-defined]
    return np.random.default_rng((entropy, step // HOLD))


def random_actions(simulation: Simulation, rng: Random, step: int) -> Pull:
    """As a random policy acts."""
    drawn = rng.uniform(-1, 1, (simulation.count, 6))
    return simulation.read_actions(drawn)


def one_bead(simulation: Simulation, rng: Random, step: int) -> Pull:
    """Full force on one bead, in one direction."""
    fixed = _fixed(rng, step)
    beads = fixed.integers(simulation.rope.config.beads, size=simulation.count)
    return beads, simulation.max_force * _directions(fixed, simulation.count)


def neighbours(simulation: Simulation, rng: Random, step: int) -> Pull:
    """Two beads side by side, pulled apart in turn."""
    beads, forces = one_bead(simulation, rng, step)
    turned = (beads + step % 2) % simulation.rope.config.beads
    return turned, forces if step % 2 else -forces


def through(simulation: Simulation, rng: Random, step: int) -> Pull:
    """A bead at a crossing pulled at the strand that it crosses; where none is, at random."""
    beads, forces = random_actions(simulation, rng, step)
    for rope, points in enumerate(simulation.points):
        crossings = find_crossings(points)
        if not len(crossings.over_place):
            continue
        one = int(rng.integers(len(crossings.over_place)))
        places = (crossings.over_place[one], crossings.under_place[one])
        above, below = (int(place) % len(points) for place in places)
        bead, other = (above, below) if rng.integers(2) else (below, above)
        toward = points[other] - points[bead]
        # the strand is thin: aimed straight at it, the bead pushes and can't go round
        beads[rope] = bead
        forces[rope] = simulation.max_force * toward / max(1e-9, float(np.linalg.norm(toward)))
    return beads, forces


def tow(simulation: Simulation, rng: Random, step: int) -> Pull:
    """The same action, (-1, -1, -1, -1, -1, -1) and its like."""
    fixed = _fixed(rng, step)
    actions = fixed.choice([-1.0, 1.0], size=(simulation.count, 6))
    return simulation.read_actions(actions)


def across(simulation: Simulation, rng: Random, step: int) -> Pull:
    """A bead pulled towards the one halfway round the rope, which draws the rope through itself."""
    beads, count = one_bead(simulation, rng, step)[0], simulation.rope.config.beads
    points, rows = simulation.points, np.arange(simulation.count)
    toward = points[rows, (beads + count // 2) % count] - points[rows, beads]
    lengths = np.maximum(1e-9, np.linalg.norm(toward, axis=1, keepdims=True))
    return beads, simulation.max_force * toward / lengths


WAYS: dict[str, Way] = {
    "random": random_actions,
    "one bead": one_bead,
    "neighbours": neighbours,
    "through": through,
    "tow": tow,
    "across": across,
}


def turned(rng: Random) -> Array:
    """A random rotation."""
    matrix: Array = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return matrix * np.sign(np.linalg.det(matrix))


def verdict(points: Array, code: GaussCode, rng: Random) -> str:
    """Whether the rope is "unknotted" or "knotted", seen from other sides where one can't tell."""
    for _ in range(8):
        try:
            return "unknotted" if shows(code, UNKNOT) else "knotted"
        except InvalidInput:  # beads on one another
            found = "no diagram"
        except Failed:
            found = "undecided"
        code = label(points @ turned(rng))
    return found


def is_flip(before: GaussCode, after: GaussCode) -> bool:
    """Whether one crossing that isn't a kink went from over to under, and nothing else changed."""
    if before.nx != after.nx:
        return False
    changed = {abs(a) for a, b in zip(before.visits, after.visits, strict=True) if a != b}
    signs = enumerate(zip(before.signs, after.signs, strict=True), 1)
    if len(changed) != 1 or {crossing for crossing, (a, b) in signs if a != b} != changed:
        return False
    one, other = (k for k, visit in enumerate(after.visits) if abs(visit) in changed)
    return other - one not in (1, 2 * after.nx - 1)


def sideways(code: GaussCode) -> Iterator[GaussCode]:
    """Yield the codes one move away with as many crossings: base point shifts and third moves."""
    if code.nx:
        # the base point slides over the first crossing, or back over the last
        yield code.rebased(1)
        yield code.rebased(-1)
    visits, count = code.visits, len(code.visits)
    for face in faces(code) if code.nx >= 3 else ():
        # dart 2 k and 2 k + 1 are the two sides of edge k, which leads from visit k to the next
        edges = [dart // 2 for dart in face]
        ends = [(visits[edge], visits[(edge + 1) % count]) for edge in edges]
        labels = {abs(visit) for pair in ends for visit in pair}
        # A triangle allows a third move if one of its edges is over at both ends, one under at
        # both, and one over at one end. The move swaps the two visits of each edge.
        heights = sorted((a > 0) + (b > 0) for a, b in ends)
        if len(face) == len(labels) == 3 and heights == [0, 1, 2]:
            moved = list(visits)
            # each strand passes its two crossings in the other order
            for edge in edges:
                after = (edge + 1) % count
                moved[edge], moved[after] = moved[after], moved[edge]
            yield code.of_visits(tuple(moved))


def is_one_move(before: GaussCode, after: GaussCode) -> bool:
    """Whether one Reidemeister move, or a slide of the base point, leads from code to code."""
    down, up = sorted((before, after), key=lambda code: code.nx)
    return down in [*removals(up)] or after in sideways(before)


def changes_within(
    simulation: ChainSimulation, state: Array, bead: int, force: Array
) -> list[tuple[GaussCode, GaussCode]]:
    """The codes before and after each change within an action, for vertices on straight lines.

    Args:
        simulation: the rope's.
        state: of the rope before the action, as `Simulation.states` gives it.
        bead: that is pulled.
        force: float64 (3,), newtons.
    """
    moved = ChainSimulation(1, simulation.rope)
    moved.restore(state)
    found: list[tuple[GaussCode, GaussCode]] = []

    def look(start: float, end: float, before: GaussCode, after: GaussCode) -> None:
        if end - start > (2**-11 if before == after else 1e-12):
            middle = (start + end) / 2
            code = label(x + (moved.points[0] - x) * middle)
            look(start, middle, before, code)
            look(middle, end, code, after)
        elif before != after:
            found.append((before, after))

    for share in simulation.schedule:
        x, moved.schedule = moved.points[0].copy(), (share,)
        moved.step([bead], force[None])
        look(0.0, 1.0, label(x), label(moved.points[0]))
    return found


def gaps(simulation: Simulation) -> Array:
    """The widest gap of each rope, in the chain the largest error of an edge's length, metres."""
    if simulation.engine == MUJOCO:
        return simulation.rope.points_and_gaps(simulation.qpos())[1]
    edges = np.roll(simulation.points, -1, axis=1) - simulation.points
    off = np.linalg.norm(edges, axis=2) - simulation.rope.config.bead_length
    return np.asarray(np.abs(off).max(axis=1))


@functools.cache
def _starts() -> Array:
    return read_states(shipped(), images=False).qpos


def play(engine: str, way: str, seed: int, ropes: int, length: int) -> dict[str, Any]:
    """One slice: so many actions of each rope, all in one way."""
    began = time.process_time()
    simulation, starts = simulation_of(engine, ropes), _starts()
    rng = np.random.default_rng(seed)
    rows = rng.integers(len(starts), size=ropes // 2)
    simulation.lay(starts[rows], np.arange(len(rows)))
    codes: Sequence[GaussCode] = label_many(simulation.points)
    counts: Counter[str] = Counter()
    breaks: list[str] = []
    widest, most = 0.0, 0
    bead = 2 * simulation.rope.config.radius
    for step in range(length):
        before_action, (beads, forces) = simulation.states(), WAYS[way](simulation, rng, step)
        whole = simulation.step(beads, forces)
        counts["held back"] += int((simulation.applied_shares < 1).sum())
        wide = gaps(simulation)
        widest = max(widest, float(wide.max()))
        counts["blew up"] += int((~whole).sum())
        nan = ~np.isfinite(simulation.points).all(axis=(1, 2))
        for name, wrong in (("NaN", nan), ("wide gap", ~(wide < bead))):
            counts[name] += int(wrong.sum())
            breaks += [
                _named(way, seed, step, rope, name) for rope in np.flatnonzero(wrong).tolist()
            ]
        now = label_many(simulation.points)
        for rope, (before, after) in enumerate(zip(codes, now, strict=True)):
            if before == after:
                continue
            most = max(most, after.nx)
            found = verdict(simulation.points[rope], after, rng)
            counts["changes"] += 1
            counts[found] += 1
            if is_flip(before, after):
                counts["flips"] += 1
                if isinstance(simulation, ChainSimulation):
                    state, pull = before_action[[rope]], (int(beads[rope]), forces[rope])
                    moves = changes_within(simulation, state, *pull)
                    counts["explained"] += all(is_one_move(*move) for move in moves)
            if found == "knotted":
                text = f"{before.chiral} became {after.chiral}"
                breaks.append(_named(way, seed, step, rope, text))
        codes = now
    return {
        "way": way,
        "actions": ropes * length,
        "counts": dict(counts),
        "largest_gap_mm": 1000 * widest,
        "most_crossings": most,
        "breaks": breaks,
        "cpu_seconds": time.process_time() - began,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def _named(way: str, seed: int, step: int, rope: int, what: str) -> str:
    return f"{way}, seed {seed}, rope {rope}, action {step}: {what}"


def table(slices: list[dict[str, Any]]) -> str:
    """The slices of each way of playing, summed up."""
    columns = (
        "NaN",
        "blew up",
        "held back",
        "changes",
        "knotted",
        "undecided",
        "no diagram",
        "flips",
        "explained",
    )
    lines = [
        f"| way | actions | {' | '.join(columns)} | largest gap, mm | most crossings | CPU s |",
        f"| --- |{' ---: |' * (len(columns) + 4)}",
    ]
    for way in WAYS:
        own = [one for one in slices if one["way"] == way]
        if own:
            counts: Counter[str] = sum((Counter(one["counts"]) for one in own), Counter())
            lines.append(
                f"| {way} | {sum(one['actions'] for one in own)}"
                f" | {' | '.join(str(counts[name]) for name in columns)}"
                f" | {max(one['largest_gap_mm'] for one in own):.3g}"
                f" | {max(one['most_crossings'] for one in own)}"
                f" | {sum(one['cpu_seconds'] for one in own):.0f} |"
            )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--engine", choices=ENGINES, default=MUJOCO)
    parser.add_argument("--actions", type=int, default=1_000_000, help="all ropes together")
    parser.add_argument("--ropes", type=int, default=32)
    parser.add_argument("--length", type=int, default=250, help="actions of a rope in a slice")
    parser.add_argument("--seed", type=int, default=0, help="of the first slice")
    parser.add_argument("--out", type=Path, default=Path("long_play.json"))
    given = parser.parse_args()
    sizes = {"engine": given.engine, "ropes": given.ropes, "length": given.length}
    told: dict[str, Any] = {"sizes": {**sizes, "seed": given.seed}, "slices": []}
    if given.out.is_file():
        before = json.loads(given.out.read_text(encoding="utf-8"))
        told = before if before.get("sizes") == told["sizes"] else told
    slices = told["slices"]
    while sum(one["actions"] for one in slices) < given.actions:
        way = [*WAYS][len(slices) % len(WAYS)]
        slices.append(play(way=way, seed=given.seed + len(slices), **sizes))
        print(*slices[-1]["breaks"], sep="\n", end="" if not slices[-1]["breaks"] else "\n")
        given.out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    print(table(slices))
    print(
        f"memory, MB: {slices[0]['peak_mb']:.0f} after the first, {slices[-1]['peak_mb']:.0f} last"
    )


if __name__ == "__main__":
    main()
