"""Whether a strand ever passes through another in hard play, seen from outside the engines.

    python benchmarks/passages.py --actions 10000000 --out passages.jsonl
    python benchmarks/passages.py --engine mujoco --ropes 8 --actions 10000 --out mujoco.jsonl

Ropes start as coils, as states of `bench` and as two knots. Slices take these ways of playing in
turn: "random" actions; "one bead", full force on one bead in one direction; "neighbours", two beads
side by side pulled apart in turn; "through", a bead at a crossing pulled at the strand that it
crosses; "tow", the same action; "across", a bead pulled towards the one halfway round. A bead and a
direction are kept for 20 actions. In the chain, every other six slices pull with ten times the
largest force, at which MuJoCo blows up, and every other twelve take all of an action in the
schedule's shortest substeps. A line of --out is a slice; a second run goes on there.

Nothing here asks the engine or `knotgym.topology`. Imagine a thread that is fixed to the rope along
one side and carried along without turning about it. Its linking number with the rope changes by 2
whenever two strands pass through each other, in whatever order and with whatever knot, and
otherwise never. It is the sum of the signs of the crossings seen from above plus the thread's turns
about the rope, of which an action adds the area that the tangents sweep on the sphere, over 2 pi
(F. B. Fuller, "Decomposition of the linking number of a closed ribbon", 1978). That area is right
if no edge turns by half a turn at once, and no joint from one side of a flat fold to the other. So
where the number seems to change, the chain carries the
action out again substep by substep; a `passage` is what still changes it. After each slice the
Alexander polynomial at -1, 2 and 3, modulo a prime, must be that of the rope's first knot.
"""

from __future__ import annotations

import json
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from knotgym.common import Array, Ids
from knotgym.drawing import drawn_curve
from knotgym.generate import PhasedPulls
from knotgym.rope import CHAIN, ENGINES, ChainSimulation, Simulation, simulation
from knotgym.states import read_states, shipped
from knotgym.topology import GaussCode

PRIME = 2**31 - 1
HOLD = 20  # actions with the same bead and direction
WAYS = ("random", "one bead", "neighbours", "through", "tow", "across")
KNOTS = ("1+,2-,3+,1-,2+,3-", "1-,2+,3-,1+,4-,3+,2-,4+")


Vector = tuple[float, float, float]


@njit
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit
def _volume(a: Vector, b: Vector, c: Vector) -> float:
    x, y, z = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
    return _dot(a, (x, y, z))


@njit
def _area(a: Vector, b: Vector, c: Vector) -> float:
    """Return the area of a triangle on the unit sphere, positive if it is left of its way round."""
    return 2 * np.arctan2(_volume(a, b, c), 1 + _dot(a, b) + _dot(b, c) + _dot(c, a))


@njit
def _turn(a: Vector, b: Vector) -> float:
    """Return how far the level direction across b is turned from that across a, carried to b."""
    k = (b[1] * a[0] - b[0] * a[1]) / (1 + _dot(a, b))
    u = -a[1] - k * (a[0] + b[0]), a[0] - k * (a[1] + b[1]), -k * (a[2] + b[2])
    v = -b[1], b[0], 0.0
    return np.arctan2(_volume(u, v, b), _dot(u, v))


@njit
def _tangents(p: Array) -> list[Vector]:
    found = [(0.0, 0.0, 0.0) for _ in range(0)]
    for i in range(len(p)):
        j = i + 1 if i + 1 < len(p) else 0
        x, y, z = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
        long = np.sqrt(x * x + y * y + z * z)
        found.append((x / long, y / long, z / long))
    return found


@njit
def _crossings(p: Array) -> list[tuple[float, float, int]]:
    """Return place on the upper strand and on the lower one, and the sign, of each crossing."""
    n, found = len(p), [(0.0, 0.0, 0) for _ in range(0)]
    for i in range(n):
        k = i + 1 if i + 1 < n else 0
        x, y, z = p[i, 0], p[i, 1], p[i, 2]
        dx, dy, dz = p[k, 0] - x, p[k, 1] - y, p[k, 2] - z
        for j in range(i + 2, n - (i == 0)):
            k = j + 1 if j + 1 < n else 0
            cx, cy, ex, ey = p[j, 0] - x, p[j, 1] - y, p[k, 0] - p[j, 0], p[k, 1] - p[j, 1]
            one, other = dx * cy - dy * cx, dx * (cy + ey) - dy * (cx + ex)
            if (one > 0) == (other > 0):  # the ends of edge j are on one side of edge i
                continue
            wide = dx * ey - dy * ex
            s, t = (cx * ey - cy * ex) / wide, one / (one - other)
            if 0 <= s < 1:
                sign = 1 if wide > 0 else -1
                if z + s * dz > p[j, 2] + t * (p[k, 2] - p[j, 2]):
                    found.append((i + s, j + t, sign))
                else:
                    found.append((j + t, i + s, -sign))
    return found


@njit
def _level(p: Array, tangents: list[Vector]) -> float:
    """Return the linking number of a rope with a thread, but for the thread's turns."""
    total = 0.0
    for crossing in _crossings(p):
        total += crossing[2]
    for i in range(len(p)):
        total -= _turn(tangents[i - 1], tangents[i]) / (2 * np.pi)
    return total


@njit
def linking(old: Array, new: Array) -> Array:
    """Return by how much a motion changes each thread's linking number: float64 (ropes,)."""
    found = np.empty(len(old))
    for rope in range(len(old)):
        before, after = _tangents(old[rope]), _tangents(new[rope])
        swept = 0.0
        for i in range(len(before)):
            a, b, c, d = before[i - 1], before[i], after[i], after[i - 1]
            swept += _area(a, b, c) + _area(a, c, d)
        found[rope] = _level(new[rope], after) - _level(old[rope], before) + swept / (2 * np.pi)
    return found


@njit
def alexander(p: Array, at: int) -> int:
    """Return D(t) D(1/t) modulo PRIME of the knot's Alexander polynomial D, which has no units."""
    found = _crossings(p)
    under, product = np.sort(np.array([crossing[1] for crossing in found])), 1
    for t in (at, _power(at, PRIME - 2)):
        rows = np.zeros((len(found), len(found)), np.int64)
        for over_place, under_place, sign in found:
            row = np.searchsorted(under, under_place)
            over = np.searchsorted(under, over_place) % len(under)
            # arc k ends at the k-th under-crossing, and arc k + 1 begins there
            rows[row, over] += 1 - t
            rows[row, row] += t if sign > 0 else -1
            rows[row, (row + 1) % len(under)] += -1 if sign > 0 else t
        product = product * _determinant(rows[1:, 1:] % PRIME) % PRIME
    return product


@njit
def _power(base: int, exponent: int) -> int:
    found = 1
    while exponent:
        if exponent % 2:
            found = found * base % PRIME
        base, exponent = base * base % PRIME, exponent // 2
    return found


@njit
def _determinant(rows: Ids) -> int:
    found = 1
    for k in range(len(rows)):
        pivot = k
        while pivot < len(rows) and not rows[pivot, k]:
            pivot += 1
        if pivot == len(rows):
            return 0
        for c in range(k, len(rows)):
            rows[k, c], rows[pivot, c] = rows[pivot, c], rows[k, c]
        found = (found if pivot == k else PRIME - found) * rows[k, k] % PRIME
        inverse = _power(rows[k, k], PRIME - 2)
        for r in range(k + 1, len(rows)):
            if rows[r, k]:
                factor = rows[r, k] * inverse % PRIME
                for c in range(k, len(rows)):
                    rows[r, c] = (rows[r, c] - factor * rows[k, c]) % PRIME
    return found


def knot(points: Array) -> list[int]:
    """Return what tells the type of a rope's knot."""
    return [alexander(points, at) for at in (PRIME - 1, 2, 3)]


@njit
def at_crossings(points: Array, chance: Array, beads: Ids, others: Ids) -> None:
    """Write for each rope that crosses itself a bead at a crossing and the one across it."""
    for rope in range(len(points)):
        found = _crossings(points[rope])
        if found:
            over, under, _ = found[int(chance[rope, 0] * len(found))]
            if chance[rope, 1] < 0.5:
                over, under = under, over
            beads[rope], others[rope] = int(over), int(under)


def pulls(ropes: Simulation, way: str, step: int, number: int) -> tuple[Ids, Array]:
    """Return beads and forces, in units of the largest, of an action of slice `number`."""
    rng, held = (np.random.default_rng([number, *at]) for at in ((1, step), (2, step // HOLD)))
    count, total, rows = ropes.count, ropes.rope.config.beads, np.arange(ropes.count)
    beads, forces = ropes.read_actions(rng.uniform(-1, 1, (count, 6)))
    others = (beads + 1) % total
    if way == "tow":
        return ropes.read_actions(held.choice([-1.0, 1.0], (count, 6)))
    if way in ("one bead", "neighbours", "across"):
        beads, forces = held.integers(total, size=count), held.normal(size=(count, 3))
        others = (beads + total // 2) % total
    if way == "neighbours":
        beads, forces = (beads + step % 2) % total, (1 - step % 2 * 2) * forces
    if way == "through":
        at_crossings(ropes.points, rng.random((count, 2)), beads, others)
    if way in ("through", "across"):
        forces = ropes.points[rows, others] - ropes.points[rows, beads]
    if way != "random":
        forces = forces / np.linalg.norm(forces, axis=1, keepdims=True)
    return beads, forces


def gaps(ropes: Simulation) -> Array:
    """Return the widest gap of each rope, in the chain its largest error of an edge, metres."""
    if not isinstance(ropes, ChainSimulation):
        return ropes.rope.points_and_gaps(ropes.qpos())[1]
    edges = np.linalg.norm(np.roll(ropes.points, -1, axis=1) - ropes.points, axis=2)
    return np.asarray(np.abs(edges - ropes.rope.config.bead_length).max(axis=1))


def starts(ropes: Simulation) -> Array:
    """Return qpos: a quarter each coiled, of `bench`, and of two knots."""
    rng, curves = np.random.default_rng(0), [PhasedPulls.coil(ropes.rope)]
    curves += [drawn_curve(GaussCode.parse(code), rng) for code in KNOTS]
    found = np.array([*map(ropes.rope.qpos, curves)] * (ropes.count // 4 + 1))
    bench = read_states(shipped("bench"), images=False).qpos
    rows = rng.integers(len(bench), size=ropes.count - ropes.count // 4 * 3)
    return np.concatenate([found[: ropes.count // 4 * 3], bench[rows]])


def substeps(ropes: ChainSimulation, state: Array, bead: Ids, force: Array) -> Array:
    """Carry out an action of one rope again; return its points before and after each substep."""
    one = ChainSimulation(1, ropes.rope)
    one.restore(state)
    found = [one.points.copy()]
    for share in ropes.schedule:
        one.schedule = (share,)
        one.step(bead, force)
        found.append(one.points.copy())
    return np.concatenate(found)


def play(engine: str, number: int, count: int, length: int) -> dict[str, Any]:
    """Play slice `number`: `count` ropes for `length` actions each."""
    ropes, counts, began = simulation(engine, count), Counter[str](), time.process_time()
    way, strength, fine, widest = WAYS[number % len(WAYS)], 1, False, 0.0
    if isinstance(ropes, ChainSimulation):
        strength, fine = (1, 10)[number // 6 % 2], bool(number // 12 % 2)
        ropes.schedule = (1,) * sum(ropes.schedule) if fine else ropes.schedule
    ropes.set_qpos(starts(ropes))
    knots = [*map(knot, ropes.points)]
    for step in range(length):
        states, before = ropes.states(), ropes.points.copy()
        beads, forces = pulls(ropes, way, step, number)
        forces = strength * ropes.max_force * forces
        counts["blew up"] += int((~ropes.step(beads, forces)).sum())
        counts["held back"] += int((ropes.applied_shares < 1).sum())
        counts["not finite"] += int((~np.isfinite(ropes.points).all(axis=(1, 2))).sum())
        widest = max(widest, 1000 * float(gaps(ropes).max()))
        for k in np.flatnonzero(~(np.abs(linking(before, ropes.points)) < 0.5)).tolist():
            changed = True
            if isinstance(ropes, ChainSimulation):
                points = substeps(ropes, states[[k]], beads[[k]], forces[[k]])
                assert np.array_equal(points[-1], ropes.points[k]), "an action has two ends"
                parts = np.flatnonzero(~(np.abs(linking(points[:-1], points[1:])) < 0.5))
                # within a substep vertices move on straight lines
                lines = [np.linspace(points[part], points[part + 1], 65) for part in parts]
                changed = any((np.abs(linking(p[:-1], p[1:])) > 0.5).any() for p in lines)
            counts["passages"] += changed
            counts["looked at again"] += 1
    after = [*map(knot, ropes.points)]
    counts["other knots"] = sum(a != b for a, b in zip(knots, after, strict=True))
    counts["actions"] = count * length
    told = {"number": number, "way": way, "strength": strength, "shortest": fine, "gap": widest}
    return {**told, "seconds": round(time.process_time() - began, 1), "counts": counts}


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--engine", choices=ENGINES, default=CHAIN)
    parser.add_argument("--actions", type=int, default=10_000_000, help="all ropes together")
    parser.add_argument("--ropes", type=int, default=384)
    parser.add_argument("--length", type=int, default=100, help="actions of a rope in a slice")
    parser.add_argument("--out", type=Path, default=Path("passages.jsonl"))
    given = parser.parse_args()
    given.out.touch()
    slices = [json.loads(line) for line in given.out.read_text().splitlines()]
    while sum(one["counts"]["actions"] for one in slices) < given.actions:
        slices.append(play(given.engine, len(slices), given.ropes, given.length))
        with given.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(slices[-1]) + "\n")
    for strength, way in product((1, 10), WAYS):
        own = [one for one in slices if (one["strength"], one["way"]) == (strength, way)]
        counts = sum((Counter(one["counts"]) for one in own), Counter[str]())
        if own:
            gap = max(one["gap"] for one in own)
            print(f"{strength} x the force, {way}: {dict(counts)}, gaps up to {gap:.2g} mm")


if __name__ == "__main__":
    main()
