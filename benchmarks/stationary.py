"""How long a random walk remembers what the rope began as: a coil and a plain loop, side by side.

    python benchmarks/stationary.py [--ropes 32] [--actions 1000] [--out stationary.json]

Every row is an average over the ropes and over the frames since the row before (every tenth action
is a frame): the radius of gyration, metres, the crossings, the share of plain loops. Where the
rows of both starts agree within their errors (of the mean over ropes, each rope counted once), the
start is forgotten; `RandomWalkConfig.burn_in` is from the coil.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from knotgym.common.streams import Stream, key
from knotgym.generate.states.random_walk import STARTS
from knotgym.rope.actions import drawn_actions
from knotgym.rope.mujoco_simulation import MujocoSimulation
from knotgym.topology.crossings import count_crossings

FRAME = 10  # actions
_WHAT = ("radius", "crossings", "loops")


def walked(start: str, ropes: int, actions: int, seed: int) -> NDArray[np.float64]:
    """Radius of gyration and crossings, (actions // FRAME, 2, ropes)."""
    simulation = MujocoSimulation(ropes, threads=0)
    qpos = simulation.rope.qpos(STARTS[start](simulation.rope))
    simulation.lay(np.repeat(qpos[None], ropes, axis=0))
    drawn = [drawn_actions(key(Stream.RANDOM_WALK, seed, rope), actions) for rope in range(ropes)]
    seen = []
    for step in range(1, actions + 1):
        simulation.act([each[step - 1] for each in drawn])
        if step % FRAME == 0:
            points = simulation.points
            centred = points - points.mean(axis=1, keepdims=True)
            radius = np.sqrt((centred**2).sum(axis=2).mean(axis=1))
            seen.append([radius, [count_crossings(one) for one in points]])
    return np.array(seen, dtype=np.float64)


def mean(values: NDArray[np.float64]) -> tuple[float, float]:
    """The mean of (frames, ropes), and its standard error over the ropes."""
    each = values.mean(axis=0)
    return float(each.mean()), float(each.std(ddof=1) / np.sqrt(len(each)))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ropes", type=int, default=32)
    parser.add_argument("--actions", type=int, default=1000)
    parser.add_argument("--every", type=int, default=100, help="actions of a row")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("stationary.json"))
    args = parser.parse_args()
    seen = {start: walked(start, args.ropes, args.actions, args.seed) for start in STARTS}
    table = Table("actions", *(f"{start}: {what}" for start in STARTS for what in _WHAT))
    rows = []
    for first in range(0, args.actions // FRAME, args.every // FRAME):
        row: dict[str, object] = {"actions": FRAME * first + args.every}
        cells = [str(row["actions"])]
        for start, values in seen.items():
            frames = values[first : first + args.every // FRAME]
            radius, crossings = mean(frames[:, 0]), mean(frames[:, 1])
            loops = mean((frames[:, 1] == 0).astype(np.float64))
            row[start] = dict(zip(_WHAT, (radius, crossings, loops), strict=True))
            cells += [
                f"{radius[0]:.3f} ± {radius[1]:.3f}",
                f"{crossings[0]:.2f} ± {crossings[1]:.2f}",
                f"{100 * loops[0]:.1f} %",
            ]
        rows.append(row)
        table.add_row(*cells)
    Console(width=120).print(table)
    settings = {"ropes": args.ropes, "actions": args.actions, "seed": args.seed}
    args.out.write_text(
        json.dumps({"settings": settings, "rows": rows}, indent=1) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    main()
