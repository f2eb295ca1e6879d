"""Gauss codes against pyknotid: how often they agree, chirality included, why not, and how long a
code takes.

    python benchmarks/codes.py --curves 10000 --out codes.json

The curves are random Fourier series of 100 beads at the rope's length, spread evenly over the
crossing numbers, so that long codes are seen as often as short ones.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rope_states import tangled

from knotgym.topology.crossings import find_crossings, label, label_many, visit_spacing
from knotgym.topology.reference_labeller import pyknotid_code

BEADS = 100
LENGTH = 1.33  # metres
MAX_NX = 15
CLOSE = 1e-6  # beads; under this the order of two visits is a matter of rounding


@dataclass(frozen=True, kw_only=True)
class Disagreement:
    """One curve that the two read differently; `cause` names what is nearly degenerate about it."""

    index: int
    ours: str
    theirs: str
    cause: str


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What came out for one family of curves; times are mean microseconds a code."""

    curves: int
    agreed: int
    curves_by_nx: dict[int, int]
    agreed_by_nx: dict[int, int]
    disagreements: list[Disagreement]
    ours_us: float
    ours_batched_us: float
    theirs_us: float


def fourier_curves(
    count: int, rng: np.random.Generator, max_nx: int = MAX_NX
) -> Iterator[np.ndarray]:
    """Draw closed curves, float64 (100, 3), metres, as many of each crossing number 0..max_nx as
    chance allows.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, BEADS, endpoint=False)
    room = np.full(max_nx + 1, -(-count // (max_nx + 1)))
    while count > 0:
        modes = np.arange(1, int(rng.integers(2, 9)) + 1)
        waves = np.concatenate([np.cos(modes[:, None] * angle), np.sin(modes[:, None] * angle)])
        points = waves.T @ (
            rng.normal(size=(len(waves), 3)) / np.tile(modes, 2)[:, None] ** rng.uniform(0.5, 1.5)
        )
        points *= LENGTH / np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1).sum()
        nx = label(points).nx
        if nx <= max_nx and room[nx] > 0:
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


def compare(curves: Iterable[np.ndarray]) -> Comparison:
    """Read every curve, float64 (beads, 3), metres, with both labellers."""
    ropes = [np.array(points, dtype=np.float64) for points in curves]
    label(ropes[0]), label_many([ropes[0]]), pyknotid_code(ropes[0])  # compile and import
    start = time.perf_counter()
    ours = [label(rope) for rope in ropes]
    ours_us = (time.perf_counter() - start) / len(ropes) * 1e6
    same_size = [
        np.array([rope for rope in ropes if len(rope) == beads])
        for beads in sorted({len(rope) for rope in ropes})
    ]
    start = time.perf_counter()
    for batch in same_size:
        label_many(batch)
    batched_us = (time.perf_counter() - start) / len(ropes) * 1e6
    start = time.perf_counter()
    theirs = [pyknotid_code(rope) for rope in ropes]
    theirs_us = (time.perf_counter() - start) / len(ropes) * 1e6
    by_nx: dict[int, int] = {}
    agreed: dict[int, int] = {}
    disagreements = []
    for index, (own, other) in enumerate(zip(ours, theirs, strict=True)):
        by_nx[own.nx] = by_nx.get(own.nx, 0) + 1
        agreed[own.nx] = agreed.get(own.nx, 0) + (own == other)
        if own != other:
            disagreements.append(
                Disagreement(
                    index=index, ours=own.chiral, theirs=other.chiral, cause=cause(ropes[index])
                )
            )
    return Comparison(
        curves=len(ropes),
        agreed=sum(agreed.values()),
        curves_by_nx=dict(sorted(by_nx.items())),
        agreed_by_nx=dict(sorted(agreed.items())),
        disagreements=disagreements,
        ours_us=ours_us,
        ours_batched_us=batched_us,
        theirs_us=theirs_us,
    )


def show(title: str, comparison: Comparison, console: Console) -> None:
    """Print the table."""
    table = Table("nx", "curves", "agreed", title=title)
    for nx, curves in comparison.curves_by_nx.items():
        table.add_row(str(nx), str(curves), str(comparison.agreed_by_nx[nx]))
    table.add_row("all", str(comparison.curves), str(comparison.agreed))
    console.print(table)
    for unlike in comparison.disagreements:
        console.print(
            f"curve {unlike.index}: ours {unlike.ours!r}, pyknotid's {unlike.theirs!r};"
            f" {unlike.cause}"
        )
    console.print(
        f"microseconds a code: ours {comparison.ours_us:.1f}, ours batched"
        f" {comparison.ours_batched_us:.1f}, pyknotid {comparison.theirs_us:.0f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--curves", type=int, default=10_000)
    parser.add_argument(
        "--ropes",
        type=int,
        default=2000,
        help="rope states beside them, tangled by random macro-actions",
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    settings = parser.parse_args()
    if settings.curves < 1:
        parser.error(f"--curves must be at least 1, got {settings.curves}")
    comparisons = {
        "Fourier curves": compare(
            fourier_curves(settings.curves, np.random.default_rng(settings.seed))
        )
    }
    if settings.ropes:
        comparisons["rope states"] = compare(
            tangled(settings.ropes, np.random.default_rng(settings.seed), least=0)
        )
    for title, comparison in comparisons.items():
        show(title, comparison, Console())
    if settings.out is not None:
        results = {title: asdict(comparison) for title, comparison in comparisons.items()}
        settings.out.write_text(
            json.dumps(
                {"curves": settings.curves, "seed": settings.seed, "results": results}, indent=1
            )
            + "\n"
        )


if __name__ == "__main__":
    main()
