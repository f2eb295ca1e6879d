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

import cv2
import numpy as np
from numpy.typing import NDArray
from rope_states import tangled

from knotgym.datasets.gallery import Tile, contact_sheet, write_png
from knotgym.quality import UNITS, Limits, Quality, measure, noise_survival
from knotgym.rendering.picture import draw
from knotgym.rendering.video import OUTCOMES
from knotgym.rope import Array
from knotgym.topology.crossings import find_crossings

EACH = 3  # pictures on either side of a limit
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
    tiles = []
    for limit in fields(Limits):
        name = limit.name
        print(f"{name:24} missed by {missed[name]}")

        def over(state: State, name: str = name) -> float:
            """How far past its limit, in shares of it; negative where it fails."""
            bound = getattr(limits, name) * (state.nx + 1 if name == "total_curvature" else 1)
            share = float((getattr(state.quality, name) - bound) / bound)
            return -share if name in ("excess_crossing_number", "total_curvature") else share

        fine = sorted((state for state in seen if not state.faults), key=over)
        short = sorted((state for state in seen if state.faults == [name]), key=over, reverse=True)
        # a limit that too few states miss, and no other, fills no row
        if min(len(fine), len(short)) < EACH:
            continue
        for word, group in (("failed", short), ("reached", fine)):
            for state in group[:EACH]:
                value = f"{getattr(state.quality, name):.3g} {SHORT[UNITS[name]]}"
                verdict = f"{'rejected' if word == 'failed' else 'accepted'}: {value}"
                tiles.append(
                    Tile(enlarged(state.points), (name.replace("_", " "), verdict), OUTCOMES[word])
                )
    write_png(args.out, contact_sheet(tiles, columns=2 * EACH))


def enlarged(points: Array) -> NDArray[np.uint8]:
    """The middle of the picture that an agent sees, or all of it, in large pixels."""
    picture = draw(points)
    rope = np.argwhere(picture.any(axis=2))
    edge = 16 if rope.min() >= 16 and rope.max() < 112 else 0
    middle = picture[edge : 128 - edge, edge : 128 - edge]
    large = cv2.resize(middle, (192, 192), interpolation=cv2.INTER_NEAREST)
    return np.asarray(large, dtype=np.uint8)


if __name__ == "__main__":
    main()
