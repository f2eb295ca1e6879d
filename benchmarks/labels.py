"""Gauss codes against an independent labeller, on millions of ropes, with every doubt counted.

    python benchmarks/labels.py --frames 10000000 --out labels.json
    python benchmarks/labels.py --frames 100000 --pieces 4 --out pieces.json    # open and several

Ropes come from random pulls in both engines, from the states of `bench` and from curves drawn from
codes of 0 to 10 crossings. Each is seen as it is and from seven random sides; seven of the eight
are then made hard: flattened, scaled, dented onto another strand, with vertices that nearly
coincide or strands that are nearly as high. With `--pieces` each is then cut into 1 to so many, and
every piece is open or closed by a coin. Chunk k depends on (seed, k) alone. The file keeps what
was counted, and a second run goes on there.

The labeller here shares no code with the package. It decides signs of orientations, the order of
two crossings on one edge and the order of two heights in floating point where a bound on the
rounding error allows it (`_certain`), and otherwise labels the whole rope in rational numbers
(`_code`). The margin of such a rope is its smallest difference of two places or two heights, in
units of the rounding error that the formulas have in float64. Below 1 floating point alone could
not tell. At 0 the label is unclear: two crossings are at one place, two strands equally high, or
three beads in line, and each labeller may break the tie in its own way.
"""

from __future__ import annotations

import json
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from knotgym.common import Array, Failed, Ids
from knotgym.drawing import drawn_curve
from knotgym.generate import PhasedPulls
from knotgym.rope import CHAIN, MUJOCO, RopeConfig, simulation_of
from knotgym.states import read_states, shipped
from knotgym.topology import CodeArrays, find_ropes_crossings, label, uniform_code

WIDTH = 128  # crossings; the few ropes with more are labelled in rational numbers
_HALF_ULP = 2.0**-53
# Shewchuk's bound on the error of an orientation, for the sum of the sizes of its two products
# (Adaptive Precision Floating-Point Arithmetic, 1997)
_BOUND = (3 + 16 * _HALF_ULP) * _HALF_ULP
_WAYS = ("as they are", "turned", "flat", "small", "large", "dented", "doubled", "level")


@njit
def _turn(a: Array, b: Array, c: Array) -> tuple[float, float]:
    """Return the orientation of three points in the plane, and a bound on its error."""
    left, right = (a[0] - c[0]) * (b[1] - c[1]), (a[1] - c[1]) * (b[0] - c[0])
    return left - right, _BOUND * (abs(left) + abs(right))


@njit
def _error(a: Array, b: Array, c: Array) -> float:
    """Return a bound on the error of (b - a) x (c - a), as the usual formula computes it."""
    return max(_turn(a, b, c)[1], _turn(b, c, a)[1])


@njit
def _certain(p: Array, after: Ids, visits: NDArray[np.int16], signs: NDArray[np.int8]) -> int:
    """Label a rope in floating point; return its crossings, or -1 where an order isn't certain.

    Args:
        p: float64 (beads, 3).
        after: int64 (beads,), the bead that each is joined to, -1 for none.
        visits: int16 (2 WIDTH,), written: numbers of crossings, negative on the lower strand.
        signs: int8 (WIDTH,), written: 1 where (over x under) points up, else -1.
    """
    n, hits = len(p), 0
    # of strand s, one of hit s // 2: edge, fraction along it and its error, height and its error
    strand, upward = np.empty((2 * WIDTH, 5)), np.empty(WIDTH, np.bool_)
    for i in range(n):
        a, b = p[i], p[after[i]]
        for j in range(i + 1, n):
            if min(after[i], after[j]) < 0 or after[i] == j or after[j] == i:
                continue
            c, d = p[j], p[after[j]]
            if (
                max(a[0], b[0]) < min(c[0], d[0]) or max(c[0], d[0]) < min(a[0], b[0])
                or max(a[1], b[1]) < min(c[1], d[1]) or max(c[1], d[1]) < min(a[1], b[1])
            ):  # fmt: skip
                continue
            of_c, of_d, of_a, of_b = _turn(a, b, c), _turn(a, b, d), _turn(c, d, a), _turn(c, d, b)
            for side, error in (of_c, of_d, of_a, of_b):
                if abs(side) <= error:
                    return -1
            if of_c[0] * of_d[0] > 0 or of_a[0] * of_b[0] > 0:
                continue
            if hits == WIDTH:
                return -1
            upward[hits] = of_d[0] > 0
            for side, edge, q, r, s, t, here, there in (
                (0, i, a, b, c, d, of_a, of_b),
                (1, j, c, d, a, b, of_c, of_d),
            ):
                # here and there have opposite signs, so their difference is as exact as they are
                wide = abs(here[0]) + abs(there[0])
                off = 2 * (_error(s, t, q) + _error(s, t, r)) / wide + 4 * _HALF_ULP
                row, rise = strand[2 * hits + side], r[2] - q[2]
                row[0], row[1], row[2] = edge, abs(here[0]) / wide, off
                row[3] = q[2] + row[1] * rise
                row[4] = off * abs(rise) + 4 * _HALF_ULP * (abs(q[2]) + abs(r[2]))
            hits += 1
    walk = np.argsort(strand[: 2 * hits, 0] + strand[: 2 * hits, 1])
    numbers, count, before = np.zeros(hits, np.int64), 0, strand[walk[0]] if hits else strand[0]
    for k in range(2 * hits):
        one, other = strand[walk[k]], strand[walk[k] ^ 1]
        if k and one[0] == before[0] and not one[1] - before[1] > one[2] + before[2]:
            return -1
        if one[0] < before[0] or abs(one[3] - other[3]) <= one[4] + other[4]:
            return -1
        before, hit, over = one, walk[k] // 2, one[3] > other[3]
        if not numbers[hit]:
            count += 1
            numbers[hit] = count
            # the edges' own order is (side 0, side 1); over first keeps the sign of their product
            signs[count - 1] = 1 if upward[hit] == (over == (walk[k] % 2 == 0)) else -1
        visits[k] = numbers[hit] if over else -numbers[hit]
    return hits


@njit
def _label_all(points: Array, after: Ids, visits: Array, signs: Array, counts: Ids) -> None:
    for rope in range(len(points)):
        counts[rope] = _certain(points[rope], after[rope], visits[rope], signs[rope])


Point = tuple[Fraction, Fraction, Fraction]


def labels(points: Array, after: Ids | None = None) -> tuple[str, float]:
    """Label a rope in rational numbers.

    Args:
        points: float64 (beads, 3).
        after: as of `_certain`; None for one closed curve.

    Returns:
        The code with chirality, and the margin, see the module; 0 where three beads are in line.
    """
    after = np.append(np.arange(1, len(points)), 0) if after is None else after
    ends = points[:, None], points[after][:, None], points[None]
    side, error = _turn.py_func(*(np.moveaxis(one, -1, 0) for one in ends))
    n, sign, in_line = len(points), np.sign(side), False
    error[np.arange(n), np.arange(n)] = error[np.arange(n), after] = -1.0
    beads = [(Fraction(x), Fraction(y), Fraction(z)) for x, y, z in points.tolist()]
    for i, j in np.argwhere(np.abs(side) <= error).tolist():
        turn = _turn.py_func(beads[i], beads[after[i]], beads[j])[0]
        sign[i, j] = (turn > 0) - (turn < 0)
        in_line |= not turn
    apart = (sign > 0) != (sign[:, after] > 0)  # edge j has its ends on both sides of i
    hit = apart & apart.T
    hit[after < 0] = hit[:, after < 0] = False
    hit[np.arange(n), after] = hit[after, np.arange(n)] = False  # these two share a bead
    code, margin = _code(beads, after.tolist(), np.argwhere(np.triu(hit, 1)).tolist())
    return code, 0.0 if in_line else margin


def _code(beads: list[Point], after: list[int], hits: list[list[int]]) -> tuple[str, float]:
    """Return the code of one rope with pairs of edges that cross, and its margin."""
    # edge, fraction along it, height, number of the crossing, errors of both; two a crossing
    strands: list[tuple[int, Fraction, Fraction, int, float, float]] = []
    upward = []  # whether d_first x d_second points up
    for number, (i, j) in enumerate(hits):
        a, b, c, d = beads[i], beads[after[i]], beads[j], beads[after[j]]
        for edge, p, q, r, s in ((i, a, b, c, d), (j, c, d, a, b)):
            here, there = _turn.py_func(r, s, p)[0], _turn.py_func(r, s, q)[0]
            error = sum(_error(*(tuple(map(float, x)) for x in (r, s, t))) for t in (p, q))
            fraction, rise = here / (here - there), q[2] - p[2]
            off = 2 * error / abs(float(here - there)) + 4 * _HALF_ULP
            off_z = off * abs(float(rise)) + 4 * _HALF_ULP * float(abs(p[2]) + abs(q[2]))
            strands.append((edge, fraction, p[2] + fraction * rise, number, off, off_z))
        upward.append((b[0] - a[0]) * (d[1] - c[1]) > (b[1] - a[1]) * (d[0] - c[0]))
    walk = sorted(range(len(strands)), key=lambda s: strands[s][:2])
    ordered = [strands[s] for s in walk]
    margins = [
        abs(float(one[2] - other[2])) / ((one[5] + other[5]) or 1.0)
        for one, other in zip(strands[::2], strands[1::2], strict=True)
    ]
    for one, other in pairwise(ordered):
        if one[0] == other[0]:
            margins.append(float(other[1] - one[1]) / (one[4] + other[4]))
    numbers: dict[int, int] = {}
    words = []
    for k in walk:
        n = strands[k][3]
        numbers.setdefault(n, len(numbers) + 1)
        over = strands[k][2] > strands[k ^ 1][2]
        first_is_over = strands[2 * n][2] > strands[2 * n + 1][2]
        sign = "c" if upward[n] == first_is_over else "a"
        words.append(f"{numbers[n]}{'+' if over else '-'}{sign}")
    return ",".join(words), min(margins, default=np.inf)


def compare(
    points: Array, cuts: list[Cut] | None = None
) -> tuple[NDArray[np.bool_], dict[int, tuple[str, float]]]:
    """Label ropes here and by the package.

    Args:
        points: float64 (ropes, beads, 3).
        cuts: how each is cut into pieces; None if all are whole.

    Returns:
        bool (ropes,), whether the label is certain and the package's equals it; and by row the code
        and the margin of those labelled in rational numbers.
    """
    ropes, beads, _ = points.shape
    after = np.tile(np.append(np.arange(1, beads), 0), (ropes, 1))
    for own, (ends, closed) in zip(after, cuts or (), strict=bool(cuts)):
        own[ends - 1] = np.where(closed, np.append(0, ends[:-1]), -1)
    visits, signs = np.zeros((ropes, 2 * WIDTH), np.int16), np.zeros((ropes, WIDTH), np.int8)
    counts = np.empty(ropes, np.int64)
    _label_all(points, after, visits, signs, counts)
    if cuts is None:
        ours = CodeArrays.read(points, WIDTH)
        same = (counts == ours.crossings) & (ours.visits[:, : 2 * WIDTH] == visits).all(axis=1)
        same &= (ours.signs[:, :WIDTH] == signs).all(axis=1)
    else:
        same = np.zeros(ropes, np.bool_)
        for row, count in enumerate(counts.tolist()):
            code = ours_of(points[row], cuts[row])
            same[row] = code == _text(visits[row, : 2 * count], signs[row])
    doubted = np.flatnonzero(counts < 0).tolist()
    return same, {row: labels(points[row], after[row]) for row in doubted}


Cut = tuple[Ids, NDArray[np.bool_]]  # where each piece ends, and whether it is closed


def ours_of(points: Array, cut: Cut) -> str:
    """Return the package's code, with chirality, of the pieces of a rope, one after the other."""
    pieces = np.split(points, cut[0][:-1])
    code = find_ropes_crossings(pieces, cut[1].tolist()).code
    signs = np.array([1 if one == "c" else -1 for one in code.chirality or ""])
    return _text(np.array([visit for walk in code.visits for visit in walk], np.int64), signs)


def _text(visits: NDArray[Any], signs: NDArray[Any]) -> str:
    words = [f"{abs(v)}{'+' if v > 0 else '-'}{'c' if signs[abs(v) - 1] > 0 else 'a'}"
             for v in visits.tolist()]  # fmt: skip
    return ",".join(words)


def cut_of(beads: int, most: int, rng: np.random.Generator) -> Cut:
    """Cut a rope into 1 to `most` pieces of at least 3 beads, each open or closed."""
    inner = 3 * rng.choice(np.arange(1, beads // 3), rng.integers(most), replace=False)
    ends = np.append(np.sort(inner), beads)
    return ends, rng.random(len(ends)) < 0.5


class Ropes:
    """Ropes from play in both engines, states that ship and drawings, made hard.

    Of 64 ropes, 57 are random play in the chain engine, half from coils and half from states, 4 are
    states, 2 drawings, and 1 is random play in MuJoCo.
    """

    def __init__(self) -> None:
        rng, states = np.random.default_rng(0), read_states(shipped("bench"), images=False)
        self._states = states
        self._chain, self._mujoco = (
            simulation_of(count, RopeConfig(), engine)
            for count, engine in ((128, CHAIN), (8, MUJOCO))
        )
        self._coil = self._chain.rope.qpos(PhasedPulls.coil(self._chain.rope))
        drawn: list[Array] = []
        while len(drawn) < 44:  # four of each number of crossings
            with suppress(Failed):  # too tight for the rope
                drawn.append(drawn_curve(uniform_code(len(drawn) // 4, rng), rng))
        self._drawn = np.array(drawn)

    def chunk(self, rng: np.random.Generator, frames: int) -> Iterator[tuple[str, Array]]:
        """Yield each way of making ropes hard, with its ropes: float64 (frames / 8, beads, 3)."""
        count = frames // len(_WAYS)
        rows = rng.integers(len(self._states), size=count)
        found = [self._states.points[rows[: count // 16]]]
        found.append(self._drawn[rng.integers(len(self._drawn), size=count // 32)])
        for ropes, part in ((self._mujoco, count // 64), (self._chain, count)):
            ropes.set_qpos(self._states.qpos[rng.integers(len(self._states), size=ropes.count)])
            half = np.arange(ropes.count // 2)
            ropes.set_qpos(np.repeat(self._coil[None], len(half), axis=0), half)
            until = min(count, sum(map(len, found)) + part)
            while sum(map(len, found)) < until:
                ropes.act(rng.uniform(-1, 1, (ropes.count, 6)).astype(np.float32))
                found.append(ropes.points.copy())
        points = np.concatenate(found)[:count]
        for way in _WAYS:
            turned = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
            yield way, harder(points if way == _WAYS[0] else points @ turned, way, rng)


def harder(points: Array, way: str, rng: np.random.Generator) -> Array:
    """Return ropes changed in one of `_WAYS`; mirror images among them."""
    rows, beads = np.arange(len(points)), points.shape[1]
    bead, other = rng.integers(beads, size=(2, len(points)))
    tiny = 10.0 ** -rng.uniform(5, 15, (len(points), 1))  # metres, down to the rounding error
    points = points.copy()
    if way == "flat":
        points[..., 2] *= 1e-6
    elif way in ("small", "large"):
        points *= 1e-6 if way == "small" else 1e6
    elif way == "dented":  # a bead moves beside another strand
        share = rng.random((len(points), 1))
        on = points[rows, other] * share + points[rows, (other + 1) % beads] * (1 - share)
        points[rows, bead, :2] = on[:, :2] + rng.normal(size=(len(points), 2)) * tiny
    elif way == "doubled":  # nearer than 1e-15 m they are one vertex, see `same_spot`
        near = rng.normal(size=(len(points), 3)) * np.maximum(tiny, 1e-13)
        points[rows, bead] = points[rows, (bead + 1) % beads] + near
    elif way == "level":  # strands on the same step are nearly as high
        steps = 0.02 * np.round(points[..., 2] / 0.02)
        points[..., 2] = steps + rng.normal(size=steps.shape) * tiny
    return points


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10_000_000)
    parser.add_argument("--chunk", type=int, default=16_384, help="a multiple of 8")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pieces", type=int, default=0, help="most pieces of a rope; 0: whole")
    parser.add_argument("--out", type=Path, default=Path("labels.json"))
    args = parser.parse_args()
    sizes = {"seed": args.seed, "chunk": args.chunk, "pieces": args.pieces}
    told = {**sizes, "chunks": 0, "seconds": 0.0, "counts": {}, "wrong": []}
    if args.out.exists():
        told = json.loads(args.out.read_text())
        if any(told.get(name, 0) != value for name, value in sizes.items()):
            parser.error(f"{args.out} is of another seed or chunk; name another file")
    counts, ropes, began = Counter(told["counts"]), Ropes(), time.process_time() - told["seconds"]
    while told["chunks"] * args.chunk < args.frames:
        rng = np.random.default_rng([args.seed, told["chunks"]])
        for way, points in ropes.chunk(rng, args.chunk):
            most = args.pieces
            cuts = [cut_of(points.shape[1], most, rng) for _ in points] if most else None
            same, exact = compare(points, cuts)
            for row, (code, margin) in exact.items():
                ours = ours_of(points[row], cuts[row]) if cuts else label(points[row]).chiral
                same[row] = code == ours
                counts[f"{way}: beyond float64"] += 0 < margin <= 1
                counts[f"{way}: unclear"] += not margin
                counts[f"{way}: unclear and different"] += not margin and not same[row]
            wrong = ~same
            wrong[[row for row, (_, margin) in exact.items() if not margin]] = False
            for row in np.flatnonzero(wrong).tolist():
                told["wrong"].append([told["chunks"], way, row, exact.get(row)])
            counts[f"{way}: wrong"] += int(wrong.sum())
            counts[f"{way}: labelled"] += len(points)
            counts[f"{way}: in rational numbers"] += len(exact)
        told["chunks"] += 1
        told["counts"], told["seconds"] = counts, time.process_time() - began
        args.out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    for name, count in sorted(counts.items()):
        print(f"{count:12,}  {name}")
    frames = told["chunks"] * args.chunk
    print(f"{frames:12,}  frames, {told['seconds'] / frames * 1e6:.0f} us each")


if __name__ == "__main__":
    main()
