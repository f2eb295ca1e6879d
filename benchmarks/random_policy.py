"""What a random policy does to the rope: NaN, gaps, knot type, over many steps.

    python benchmarks/random_policy.py --steps 100000 [--integrator-steps 24]

Every step is certified: the rope's diagram is reduced by Reidemeister moves to the empty one, or
told by its Alexander or Jones polynomial (knotgym.topology.knots.is_unknot); a rope that starts as
a plain loop has to stay an unknot. Episodes start over every --horizon steps; half of them are long
(20 x horizon), so that tangled ropes are stepped too. Writes JSON to --out.
"""

import argparse
import json
import time
from collections import Counter
from pathlib import Path

import numpy as np

from knotgym.rope import Rope, RopeConfig
from knotgym.simulation import Simulation
from knotgym.topology.crossings import label_many
from knotgym.topology.diagrams import NotPlanar
from knotgym.topology.knots import is_unknot


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--ropes", type=int, default=32)
    parser.add_argument("--horizon", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--integrator-steps",
        type=int,
        default=24,
        help="in an action; environments take 20 and more",
    )
    parser.add_argument("--out", type=Path, default=Path("random_policy.json"))
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    config = RopeConfig(
        frame_skip=args.integrator_steps, timestep=24 * 0.008 / args.integrator_steps
    )
    simulation = Simulation(args.ropes, Rope(config), threads=0)
    loop = simulation.rope.qpos(simulation.rope.loop())
    crossings: Counter[int] = Counter()
    nan = failed = knotted = undrawable = 0
    gap, began = 0.0, time.perf_counter()
    rounds = -(-args.steps // args.ropes)
    for step in range(rounds):
        if step % args.horizon == 0:
            short = np.arange(args.ropes // 2)
            simulation.lay(np.repeat(loop[None], len(short), axis=0), short)
        if step % (20 * args.horizon) == 0:
            simulation.lay(np.repeat(loop[None], args.ropes, axis=0))
        failed += int(
            (~simulation.act(rng.uniform(-1, 1, (args.ropes, 6)).astype(np.float32))).sum()
        )
        nan += int((~np.isfinite(simulation.points)).any(axis=(1, 2)).sum())
        gap = max(gap, float(simulation.rope.points_and_gaps(simulation.qpos())[1].max()))
        for code in label_many(simulation.points):
            crossings[code.nx] += 1
            try:
                knotted += not is_unknot(code)
            except NotPlanar:
                undrawable += 1
    figures = {
        "steps": rounds * args.ropes,
        "nan": nan,
        "simulation_failed": failed,
        "changed_knot_type": knotted,
        "undrawable_codes": undrawable,
        "largest_gap_mm": 1000 * gap,
        "crossings": dict(sorted(crossings.items())),
        "seconds": time.perf_counter() - began,
    }
    for name, value in figures.items():
        print(f"{name:20} {value}")
    args.out.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
