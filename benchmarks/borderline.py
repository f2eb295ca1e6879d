"""A page of borderline pictures: for every quality limit, states that just pass it beside states
that just fail it.

    python benchmarks/borderline.py --out docs/borderline.png

The states are ropes tangled by random macro-actions, at rest or not, with one to four crossings;
those shown differ from acceptable ones in that measure alone, or nearly so. Prints how many of all
states miss each limit.
"""

import argparse
from collections import Counter
from dataclasses import fields, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rope_states import tangled

from knotgym.datasets.gallery import contact_sheet, write_png
from knotgym.quality import UNITS, Limits, Quality, measure, noise_survival
from knotgym.rendering.picture import draw
from knotgym.rope import Array
from knotgym.topology.crossings import find_crossings

EACH = 6  # pictures on either side of a limit
SHORT = {
    "degrees": "deg",
    "pixels": "px",
    "square pixels": "px2",
    "millimetres": "mm",
    "crossings": "crossings",
    "turns": "turns",
    "share": "",
}


class State(NamedTuple):
    """A rope's points, its crossings, what was measured, and the limits that it misses."""

    points: Array
    nx: int
    quality: Quality
    faults: list[str]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--states", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("borderline.png"))
    args = parser.parse_args()
    rng, limits = np.random.default_rng(args.seed), Limits()
    seen: list[State] = []
    for points in tangled(args.states, rng, least=1, most=4):
        crossings = find_crossings(points)
        quality = measure(points, crossings)
        if len(limits.faults(quality, crossings.nx)) <= 1:
            quality = replace(quality, noise_survival=noise_survival(points, 0.015, rng))
        faults = list(limits.faults(quality, crossings.nx))
        seen.append(State(points, crossings.nx, quality, faults))
    missed = Counter(fault for state in seen for fault in state.faults)
    accepted = sum(not state.faults for state in seen)
    print(f"{len(seen)} states; {accepted} keep to every limit")
    images, captions, colours = [], [], []
    for limit in fields(Limits):
        name = limit.name
        print(f"{name:24} missed by {missed[name]}")

        def over(state: State, name: str = name) -> float:
            """How far past its limit, in shares of it; negative where it fails."""
            bound = getattr(limits, name) * (state.nx + 1 if name == "total_curvature" else 1)
            share = float((getattr(state.quality, name) - bound) / bound)
            return -share if name in ("excess_crossing_number", "total_curvature") else share

        fine = sorted((state for state in seen if not state.faults), key=over)[:EACH]
        short = sorted((state for state in seen if state.faults == [name]), key=over, reverse=True)
        for group, colour in ((short[:EACH], (255, 120, 120)), (fine, (120, 255, 120))):
            for k in range(EACH):
                images.append(
                    draw(group[k].points)
                    if k < len(group)
                    else np.zeros((128, 128, 3), dtype=np.uint8)
                )
                word = "accepted" if group is fine else "rejected"
                value = (
                    f"{word}: {getattr(group[k].quality, name):.3g} {SHORT[UNITS[name]]}"
                    if k < len(group)
                    else f"no {word}"
                )
                captions.append((name.replace("_", " "), value))
                colours.append(colour)
    write_png(args.out, contact_sheet(np.stack(images), captions, colours, columns=2 * EACH))


if __name__ == "__main__":
    main()
