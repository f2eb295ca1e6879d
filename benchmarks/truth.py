"""Does the picture show on top the strand that the label says is over? At every crossing of many
rope states.

    python benchmarks/truth.py --states 1000

Both renderers if there is a GL for MuJoCo's, OpenCV's alone if not. A crossing counts as ambiguous
where it lies outside the picture, where the two strands have nearly one colour (under 25 levels
apart), or where a third strand lies above it. Each is looked at again in a picture of 512 pixels,
the same view. Writes JSON to --out.
"""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from cyclopts import run
from picture_check import shown_strands

from knotgym.common import Array, KnotgymError
from knotgym.generate import PhasedPulls
from knotgym.rendering import PictureConfig, draw
from knotgym.rope import CHAIN, RopeConfig, simulation_of
from knotgym.topology import find_crossings, label

ROPES, EVERY, MOST = 64, 4, 15  # ropes side by side; pulls between two looks; most crossings


def tangled(count: int, rng: np.random.Generator) -> Iterator[Array]:
    """Yield `count` configurations (beads, 3) that random pulls have tangled, none chosen."""
    simulation = simulation_of(ROPES, RopeConfig(), CHAIN)
    start = simulation.rope.qpos(PhasedPulls.coil(simulation.rope))
    simulation.set_qpos(np.repeat(start[None], ROPES, axis=0))
    given = 0
    while given < count:
        for _ in range(EVERY):
            simulation.act(rng.uniform(-1, 1, (ROPES, 6)).astype(np.float32))
        for points in simulation.points:
            if given < count and 1 <= label(points).nx <= MOST:
                yield points.copy()
                given += 1


def main(*, states: int = 1000, seed: int = 0, out: Path = Path("truth.json")) -> None:
    """Print which strand pictures show on top, by renderer and size.

    Args:
        states: how many ropes.
        seed: of the pulls that tangle them.
        out: file that gets the counts.
    """
    ropes, figures = [*tangled(states, np.random.default_rng(seed))], {}
    print("renderer   pixels states crossings as labelled  wrong ambiguous")
    for renderer in ("opencv", "mujoco"):
        for size in (64, 128, 256, 512):
            config = PictureConfig(size=size, renderer=renderer)
            shown: Counter[str] = Counter()
            try:
                for points in ropes:
                    image, crossings = draw(points, config), find_crossings(points)
                    shown.update(shown_strands(image, crossings, points, config).tolist())
            except KnotgymError as error:
                print(f"{renderer:10} {error}")
                break
            figures[f"{renderer} {size}"] = dict(shown)
            print(
                f"{renderer:10} {size:6} {states:6} {shown.total():9} {shown['over']:11}"
                f" {shown['under']:6} {shown['ambiguous']:9}"
            )
    told = {"states": states, "seed": seed, "crossings": figures}
    out.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    run(main)
