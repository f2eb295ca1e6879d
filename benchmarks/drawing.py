"""How the strengths of the drawing's forces were set: single drawings within the limits.

    python benchmarks/drawing.py --nx 6 --count 60

Draws codes sampled uniformly, each once, with the constants of `drawing.layout_relaxation` as they
are and with each halved and doubled, and prints the share of drawings that meet the limits of a
legible state but noise survival, before any simulation. All settings draw the same codes.
"""

import argparse
import json

import numpy as np

from knotgym.common.errors import Failed
from knotgym.drawing import layout_relaxation
from knotgym.drawing.drawn_curve import drawn_curve
from knotgym.quality.limits import LEGIBLE
from knotgym.quality.measures import measure
from knotgym.topology.uniform_codes import uniform_code

NAMES = ("TENSION", "BENDING", "CROSSING", "PUSH", "REACH", "POWER", "MOST", "STEP")


def within(nx: int, count: int) -> float:
    """Draw `count` codes; return the share within the limits."""
    codes = [uniform_code(nx, np.random.default_rng([0, k])) for k in range(count)]
    good = 0
    for k, code in enumerate(codes):
        try:
            points = drawn_curve(code, np.random.default_rng([1, k]))
        except Failed:
            continue
        good += not LEGIBLE.faults(measure(points), nx)
    return good / count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nx", type=int, default=6)
    parser.add_argument("--count", type=int, default=60)
    args = parser.parse_args()
    print(json.dumps({"as they are": within(args.nx, args.count)}), flush=True)
    for name in NAMES:
        usual = getattr(layout_relaxation, name)
        told = {}
        for factor in (0.5, 2.0):
            setattr(layout_relaxation, name, factor * usual)
            told[str(factor)] = within(args.nx, args.count)
        setattr(layout_relaxation, name, usual)
        print(json.dumps({name: told}), flush=True)


if __name__ == "__main__":
    main()
