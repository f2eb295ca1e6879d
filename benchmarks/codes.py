"""Gauss codes against pyknotid: how often they agree, chirality included, and how long one takes.

    python benchmarks/codes.py --curves 10000 --out codes.json

The curves are random Fourier series of 100 beads at the rope's length, spread evenly over the
crossing numbers, so that long codes are seen as often as short ones; and rope states, tangled by
random pulls. Where the two differ a line says what is nearly degenerate about the curve.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rope_states import tangled

from knotgym.topology import (
    GaussCode,
    find_crossings,
    label,
    label_many,
    pyknotid_code,
    visit_spacing,
)

BEADS, LENGTH = 100, 1.33  # of the rope, metres
MAX_NX = 15
CLOSE = 1e-6  # beads; under this the order of two visits is a matter of rounding
READERS: dict[str, Callable[[np.ndarray], list[GaussCode]]] = {
    "ours": lambda ropes: [label(rope) for rope in ropes],
    "ours batched": label_many,
    "pyknotid": lambda ropes: [pyknotid_code(rope) for rope in ropes],
}


def fourier_curves(count: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Draw closed curves, float64 (100, 3), metres, as many of each crossing number as chance
    allows.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, BEADS, endpoint=False)
    room = np.full(MAX_NX + 1, -(-count // (MAX_NX + 1)))
    while count > 0:
        modes = np.arange(1, int(rng.integers(2, 9)) + 1)
        waves = np.concatenate([np.cos(modes[:, None] * angle), np.sin(modes[:, None] * angle)])
        points = waves.T @ (
            rng.normal(size=(len(waves), 3)) / np.tile(modes, 2)[:, None] ** rng.uniform(0.5, 1.5)
        )
        points *= LENGTH / np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1).sum()
        nx = label(points).nx
        if nx <= MAX_NX and room[nx] > 0:
            room[nx] -= 1
            count -= 1
            yield points


def cause(points: np.ndarray) -> str:
    """Name the near-degeneracy of a curve with the smallest margin, or say that there is none."""
    crossings = find_crossings(points)
    if crossings.nx == 0:
        return "no crossing found by us"
    places = np.concatenate([crossings.over_place, crossings.under_place])
    margins = {
        "visits this close along the rope, beads": visit_spacing(crossings, len(points)),
        "crossing this close to a bead, beads": float(np.abs(places - np.round(places)).min()),
        "strands this close in height, m": float((crossings.over_z - crossings.under_z).min()),
    }
    near = {name: margin for name, margin in margins.items() if margin < CLOSE}
    return "; ".join(f"{name}: {margin:.1e}" for name, margin in near.items()) or "unexplained"


def compare(title: str, curves: Iterable[np.ndarray]) -> dict[str, Any]:
    """Read every curve with both labellers; print where they differ."""
    ropes, codes, microseconds = np.array([*curves]), {}, {}
    for name, read in READERS.items():
        read(ropes[:1])  # compile and import
        began = time.perf_counter()
        codes[name] = read(ropes)
        microseconds[name] = (time.perf_counter() - began) / len(ropes) * 1e6
    every, agreed = Counter[int](), Counter[int]()
    for rope, own, other in zip(ropes, codes["ours"], codes["pyknotid"], strict=True):
        every[own.nx] += 1
        agreed[own.nx] += own == other
        if own != other:
            print(f"{title}: ours {own.chiral!r}, pyknotid's {other.chiral!r}; {cause(rope)}")
    by_nx = {nx: [agreed[nx], every[nx]] for nx in sorted(every)}
    found = {"agreed": agreed.total(), "curves": every.total(), "microseconds a code": microseconds}
    return {**found, "agreed by nx": by_nx}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--curves", type=int, default=10_000)
    parser.add_argument("--ropes", type=int, default=2000, help="rope states beside them")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("codes.json"))
    given = parser.parse_args()
    curves = fourier_curves(given.curves, np.random.default_rng(given.seed))
    states = tangled(given.ropes, np.random.default_rng(given.seed), least=0)
    told = {"Fourier curves": curves, "rope states": states}
    results = {title: compare(title, some) for title, some in told.items()}
    for title, one in results.items():
        print(title, one)
    given.out.write_text(json.dumps({"results": results}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
