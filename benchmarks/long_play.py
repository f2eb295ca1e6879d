"""What hard play does to the rope: NaN, gaps, knot type, memory, over many actions.

    python benchmarks/long_play.py --actions 1000000 --out long_play.json

Ropes are played side by side in slices, half of each slice set out from plain loops and half from
the states that ship, by ways of playing in turn: "random" actions; "one bead", full force always on
one bead, in one direction; "neighbours", two beads side by side pulled apart in turn; "through", a
bead beside a crossing pulled straight at the strand that it crosses, as hard as can be; "tow", the
same action always. After every action the points are looked at for NaN and the closures for their
gap; every --every actions, and at a slice's end, the rope's diagram is reduced, and its knot type
has to be the one it had (knotgym.topology.knots: Reidemeister moves, then Alexander and Jones).
Slices that --out already tells are not played again, so that a run that was ended goes on.
"""

from __future__ import annotations

import argparse
import functools
import json
import resource
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.rope.model import Array
from knotgym.rope.mujoco_simulation import MujocoSimulation
from knotgym.rope.simulation import Simulation
from knotgym.states.state_file import read_states, shipped
from knotgym.topology.crossings import find_crossings
from knotgym.topology.diagrams import NotPlanar
from knotgym.topology.knots import knot_type

Random = np.random.Generator
Pull = tuple[NDArray[np.int64], Array]  # beads and forces, newtons, of all ropes
Way = Callable[[Simulation, Random, int], Pull]


def _directions(rng: Random, count: int) -> Array:
    drawn = rng.normal(size=(count, 3))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def _fixed(seeds: Random) -> Random:
    """A generator that draws the same at every action of a slice."""
    return np.random.default_rng(seeds.bit_generator.seed_seq.entropy)  # type: ignore[attr-defined]


def random_actions(simulation: Simulation, rng: Random, step: int) -> Pull:
    """As a random policy acts."""
    drawn = rng.uniform(-1, 1, (simulation.count, 6))
    return simulation.read_actions(drawn)


def one_bead(simulation: Simulation, rng: Random, step: int) -> Pull:
    """Full force on one bead, in one direction, both kept for a whole slice."""
    fixed = _fixed(rng)
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
    """The constant action, (-1, -1, -1, -1, -1, -1) and its like."""
    fixed = _fixed(rng)
    actions = fixed.choice([-1.0, 1.0], size=(simulation.count, 6))
    return simulation.read_actions(actions)


WAYS: dict[str, Way] = {
    "random": random_actions,
    "one bead": one_bead,
    "neighbours": neighbours,
    "through": through,
    "tow": tow,
}


def types(simulation: Simulation) -> list[str]:
    """The knot type of every rope; "" where its diagram is none, beads being on one another."""
    found = []
    for points in simulation.points:
        try:
            found.append(knot_type(find_crossings(points).code))
        except NotPlanar:
            found.append("")
    return found


@functools.cache
def _starts() -> Array:
    return read_states(shipped(), images=False).qpos


def play(way: str, seed: int, ropes: int, length: int, every: int) -> dict[str, Any]:
    """One slice: so many actions of each rope, all in one way."""
    began = time.process_time()
    simulation, starts = MujocoSimulation(ropes), _starts()
    rng = np.random.default_rng(seed)
    rows = rng.integers(len(starts), size=ropes // 2)
    simulation.lay(starts[rows], np.arange(len(rows)))
    before = types(simulation)
    counts: Counter[str] = Counter()
    breaks: list[str] = []
    gap = 0.0
    bead = 2 * simulation.rope.config.radius
    for step in range(length):
        whole = simulation.step(*WAYS[way](simulation, rng, step))
        gaps = simulation.rope.points_and_gaps(simulation.qpos())[1]
        gap = max(gap, float(gaps.max()))
        counts["blew up"] += int((~whole).sum())
        nan = ~np.isfinite(simulation.points).all(axis=(1, 2))
        for name, wrong in (("NaN", nan), ("wide gap", ~(gaps < bead))):
            counts[name] += int(wrong.sum())
            breaks += [
                _named(way, seed, step, rope, name) for rope in np.flatnonzero(wrong).tolist()
            ]
        if step % every == every - 1 or step == length - 1:
            now = types(simulation)
            counts["certified"] += sum(1 for one in now if one)
            counts["no diagram"] += now.count("")
            for rope, (was, is_) in enumerate(zip(before, now, strict=True)):
                if was and is_ and was != is_:
                    counts["changed knot type"] += 1
                    breaks.append(_named(way, seed, step, rope, f"{was} became {is_}"))
            before = [is_ or was for was, is_ in zip(before, now, strict=True)]
    return {
        "way": way,
        "actions": ropes * length,
        "counts": dict(counts),
        "largest_gap_mm": 1000 * gap,
        "breaks": breaks,
        "cpu_seconds": time.process_time() - began,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def _named(way: str, seed: int, step: int, rope: int, what: str) -> str:
    return f"{way}, seed {seed}, rope {rope}, action {step}: {what}"


def table(slices: list[dict[str, Any]]) -> str:
    """The slices of each way of playing, summed up."""
    lines = [
        "| way | actions | NaN | blew up | largest gap, mm | certified | no diagram |"
        " changed knot type | CPU s |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for way in WAYS:
        own = [one for one in slices if one["way"] == way]
        if own:
            counts: Counter[str] = sum((Counter(one["counts"]) for one in own), Counter())
            lines.append(
                f"| {way} | {sum(one['actions'] for one in own)} | {counts['NaN']}"
                f" | {counts['blew up']} | {max(one['largest_gap_mm'] for one in own):.1f}"
                f" | {counts['certified']} | {counts['no diagram']}"
                f" | {counts['changed knot type']} | {sum(one['cpu_seconds'] for one in own):.0f} |"
            )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--actions", type=int, default=1_000_000, help="all ropes together")
    parser.add_argument("--ropes", type=int, default=32)
    parser.add_argument("--length", type=int, default=250, help="actions of a rope in a slice")
    parser.add_argument("--every", type=int, default=10, help="actions between two looks")
    parser.add_argument("--seed", type=int, default=0, help="of the first slice")
    parser.add_argument("--out", type=Path, default=Path("long_play.json"))
    given = parser.parse_args()
    sizes = {"ropes": given.ropes, "length": given.length, "every": given.every}
    told: dict[str, Any] = {"sizes": {**sizes, "seed": given.seed}, "slices": []}
    if given.out.is_file():
        before = json.loads(given.out.read_text(encoding="utf-8"))
        told = before if before.get("sizes") == told["sizes"] else told
    slices = told["slices"]
    while sum(one["actions"] for one in slices) < given.actions:
        way = [*WAYS][len(slices) % len(WAYS)]
        slices.append(play(way, given.seed + len(slices), **sizes))
        print(*slices[-1]["breaks"], sep="\n", end="" if not slices[-1]["breaks"] else "\n")
        given.out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    print(table(slices))
    print(
        f"memory, MB: {slices[0]['peak_mb']:.0f} after the first, {slices[-1]['peak_mb']:.0f} last"
    )


if __name__ == "__main__":
    main()
