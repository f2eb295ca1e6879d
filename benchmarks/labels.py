"""Gauss codes against an independent labeller, on millions of ropes, with every doubt counted.

    python benchmarks/labels.py --frames 1000000 --out labels.json

Ropes come from random pulls in the chain engine, from curves drawn from codes, and from both of
these made hard: flattened, scaled, dented onto another strand, with vertices that nearly coincide.
Chunk k depends on (seed, k) alone. The file keeps what was counted, and a second run goes on there.

The labeller here shares no code with the package. Signs of orientations come from floating point
where a bound on the rounding error allows it, and from rational numbers where it doesn't
(Shewchuk, Adaptive Precision Floating-Point Arithmetic, 1997); so do the order of two crossings on
one edge and the order of two heights. A rope is unclear where the package's float64 can't tell such
an order either: two visits closer than MARGIN edges, or two heights closer than MARGIN of the
largest height. Its labels may then differ.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from knotgym.generate import PhasedPulls
from knotgym.rope import CHAIN, RopeConfig, simulation_of
from knotgym.states import read_states, shipped
from knotgym.topology import label_many

Array = NDArray[np.float64]

ROPES = 256  # a chunk
MARGIN = 1e-9  # float64 computes both to 1e-13 or better
_EPSILON = np.finfo(np.float64).eps
_BOUND = (3 + 16 * _EPSILON) * _EPSILON / 2  # of an orientation, times the sum of its two products
_WAYS = ("as they are", "flat", "small", "large", "dented", "doubled")


def labels(points: Array) -> tuple[list[str], Array]:
    """Label ropes.

    Args:
        points: float64 (ropes, beads, 3).

    Returns:
        The codes with chirality, and float64 (ropes,) with the smallest difference that decided an
        order: of two visits, in edges, or of two heights, as a share of the largest.
    """
    ropes, beads = points.shape[:2]
    start = points
    end = np.roll(points, -1, axis=1)
    side = _sides(start, end)  # [r, i, j]: on which side of edge i bead j lies
    after = np.roll(side, -1, axis=2)
    apart = (side > 0) != (after > 0)  # edge j has its ends on both sides of edge i's line
    hit = np.triu(apart & apart.transpose(0, 2, 1), 2)
    hit[:, 0, beads - 1] = False  # these two share a bead
    codes, margins = [""] * ropes, np.full(ropes, np.inf)
    which, first, second = np.nonzero(hit)
    for rope in np.unique(which):
        own = which == rope
        codes[rope], margins[rope] = _code(points[rope], first[own], second[own])
    return codes, margins


def _sides(start: Array, end: Array) -> NDArray[np.int8]:
    """Return the signs of the orientations of all edges and beads: int8 (ropes, beads, beads)."""
    a, b, c = start[:, :, None, :2], end[:, :, None, :2], start[:, None, :, :2]
    left = (a[..., 0] - c[..., 0]) * (b[..., 1] - c[..., 1])
    right = (a[..., 1] - c[..., 1]) * (b[..., 0] - c[..., 0])
    sign = np.sign(left - right).astype(np.int8)
    unsure = np.abs(left - right) <= _BOUND * (np.abs(left) + np.abs(right)) * 2
    beads = start.shape[1]
    at = np.arange(beads)
    unsure[:, at, at] = unsure[:, at, (at + 1) % beads] = False  # its own ends: nothing to decide
    for rope, i, j in zip(*np.nonzero(unsure), strict=True):
        sign[rope, i, j] = _exact_side(*map(_exact, (start[rope, i], end[rope, i], start[rope, j])))
    return sign


Point = tuple[Fraction, Fraction, Fraction]


def _exact(point: Array) -> Point:
    x, y, z = map(Fraction, point.tolist())
    return x, y, z


def _turn(a: Point, b: Point, c: Point) -> Fraction:
    return (a[0] - c[0]) * (b[1] - c[1]) - (a[1] - c[1]) * (b[0] - c[0])


def _exact_side(a: Point, b: Point, c: Point) -> int:
    turn = _turn(a, b, c)
    return (turn > 0) - (turn < 0)


def _code(points: Array, first: NDArray[np.intp], second: NDArray[np.intp]) -> tuple[str, float]:
    """Return the code of one rope whose edges `first` and `second` cross, and its margin."""
    beads = [_exact(point) for point in points]
    strands = []  # (edge, fraction along it, height, number of the crossing), two a crossing
    upward = []  # whether d_first x d_second points up
    for number, (i, j) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        a, b, c, d = beads[i], beads[(i + 1) % len(beads)], beads[j], beads[(j + 1) % len(beads)]
        ends = (_turn(c, d, a), _turn(c, d, b)), (_turn(a, b, c), _turn(a, b, d))
        for edge, p, q, (here, there) in ((i, a, b, ends[0]), (j, c, d, ends[1])):
            fraction = here / (here - there)
            strands.append((edge, fraction, p[2] + fraction * (q[2] - p[2]), number))
        upward.append((b[0] - a[0]) * (d[1] - c[1]) > (b[1] - a[1]) * (d[0] - c[0]))
    heights = [[strands[2 * n][2], strands[2 * n + 1][2]] for n in range(len(upward))]
    walk = sorted(range(len(strands)), key=lambda s: strands[s][:2])
    tall = float(np.abs(points[:, 2]).max()) or 1.0
    gaps = [abs(float(one - other)) / tall for one, other in heights]
    for k, s in enumerate(walk):
        edge, fraction = strands[s][:2]
        next_edge, next_fraction = strands[walk[(k + 1) % len(walk)]][:2]
        gaps.append(abs(float((next_edge - edge) % len(beads) + next_fraction - fraction)))
    numbers: dict[int, int] = {}
    words = []
    for s in walk:
        n = strands[s][3]
        numbers.setdefault(n, len(numbers) + 1)
        over = heights[n][s % 2] > heights[n][1 - s % 2]
        first_is_over = heights[n][0] > heights[n][1]
        sign = "c" if upward[n] == first_is_over else "a"
        words.append(f"{numbers[n]}{'+' if over else '-'}{sign}")
    return ",".join(words), min(gaps)


class Ropes:
    """Ropes of the chain engine that random pulls tangle, and states that ship, made hard."""

    def __init__(self) -> None:
        self._simulation = simulation_of(ROPES, RopeConfig(), CHAIN)
        self._start = self._simulation.rope.qpos(PhasedPulls.coil(self._simulation.rope))
        self._drawn = read_states(shipped("bench"), images=False).points

    def chunk(self, rng: np.random.Generator, frames: int) -> tuple[str, Array]:
        """Return the kind of a chunk and its ropes: float64 (frames, beads, 3)."""
        kind = _WAYS[int(rng.integers(len(_WAYS)))]
        found = [self._drawn[rng.integers(len(self._drawn), size=frames // 8)]]
        self._simulation.lay(np.repeat(self._start[None], ROPES, axis=0))
        while sum(map(len, found)) < frames:
            self._simulation.act(rng.uniform(-1, 1, (ROPES, 6)).astype(np.float32))
            found.append(self._simulation.points.copy())
        points = np.concatenate(found)[:frames]
        return kind, _harder(points, kind, rng)


def _harder(points: Array, kind: str, rng: np.random.Generator) -> Array:
    """Return ropes changed in one of `_WAYS`."""
    rows, beads = np.arange(len(points)), points.shape[1]
    bead, other = rng.integers(beads, size=(2, len(points)))
    points = points.copy()
    if kind == "flat":
        points[..., 2] *= 1e-6
    elif kind in ("small", "large"):
        points *= 1e-6 if kind == "small" else 1e6
    elif kind == "dented":  # a bead moves beside another strand, at a distance near rounding error
        share = rng.random((len(points), 1))
        on = points[rows, other] * share + points[rows, (other + 1) % beads] * (1 - share)
        points[rows, bead, :2] = on[:, :2] + rng.normal(size=(len(points), 2)) * 1e-15
    elif kind == "doubled":  # nearer than 1e-15 m they are one vertex, see `same_spot`
        points[rows, bead] = points[rows, (bead + 1) % beads] + rng.normal(
            size=(len(points), 3)
        ) * 10.0 ** -rng.integers(9, 13, (len(points), 1))
    return points


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--chunk", type=int, default=16_384)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("labels.json"))
    args = parser.parse_args()
    made = {"seed": args.seed, "chunk": args.chunk, "chunks": 0, "seconds": 0.0}
    counts: Counter[str] = Counter()
    doubts: list[list[object]] = []
    if args.out.exists():
        stored = json.loads(args.out.read_text())
        if any(stored[name] != made[name] for name in ("seed", "chunk")):
            parser.error(f"{args.out} is of another seed or chunk; name another file")
        made = {name: stored[name] for name in made}
        counts.update(stored["counts"])
        doubts = stored["doubts"]
    ropes = Ropes()
    while made["chunks"] * args.chunk < args.frames:
        kind, points = ropes.chunk(np.random.default_rng([args.seed, made["chunks"]]), args.chunk)
        began = time.process_time()
        ours = label_many(points)
        made["seconds"] += time.process_time() - began
        for at in range(0, len(points), ROPES):
            codes, margins = labels(points[at : at + ROPES])
            for row, (code, margin) in enumerate(zip(codes, margins, strict=True), at):
                same = ours[row].chiral == code
                clear = margin > MARGIN
                verdict = "equal" if same else "wrong" if clear else "differs, unclear"
                counts[f"{kind}: {verdict}"] += 1
                counts[f"{kind}: unclear"] += int(not clear)
                if not same:
                    doubts.append(
                        [made["chunks"], row, kind, float(margin), code, ours[row].chiral]
                    )
        made["chunks"] += 1
        args.out.write_text(json.dumps({**made, "counts": counts, "doubts": doubts}, indent=1))
    for name, count in sorted(counts.items()):
        print(f"{count:12,}  {name}")
    frames = made["chunks"] * args.chunk
    print(f"{frames:12,}  frames, {made['seconds'] / frames * 1e6:.1f} us a label")


if __name__ == "__main__":
    main()
