"""Does the picture show on top the strand that the label says is over? At every crossing of many
rope states.

    python benchmarks/truth.py --states 1000

Both renderers if there is a GL for MuJoCo's, OpenCV's alone if not. A crossing counts as ambiguous
where it lies outside the picture, where the two strands have nearly one colour (under 25 levels
apart), or where a third strand lies above it. Each is looked at again in a picture of 512 pixels,
the same view. Writes JSON to --out.
"""

import json
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from pathlib import Path

import numpy as np
from picture_check import shown_strands
from rope_states import tangled

from knotgym.common import KnotgymError
from knotgym.rendering import PictureConfig, draw
from knotgym.topology import find_crossings


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("truth.json"))
    args = parser.parse_args()
    states = list(tangled(args.states, np.random.default_rng(args.seed)))
    figures = {}
    print(
        f"{'renderer':10} {'pixels':>6} {'states':>6} {'crossings':>9} {'as labelled':>11}"
        f" {'wrong':>6} {'ambiguous':>9}"
    )
    for renderer in ("opencv", "mujoco"):
        for size in (64, 128, 256, 512):
            config = PictureConfig(size=size, renderer=renderer)
            shown: Counter[str] = Counter()
            try:
                for points in states:
                    crossings = find_crossings(points)
                    shown.update(
                        shown_strands(draw(points, config), crossings, points, config).tolist()
                    )
            except KnotgymError as error:
                print(f"{renderer:10} {error}")
                break
            figures[f"{renderer} {size}"] = dict(shown)
            print(
                f"{renderer:10} {size:6} {len(states):6} {shown.total():9} {shown['over']:11}"
                f" {shown['under']:6} {shown['ambiguous']:9}"
            )
    args.out.write_text(
        json.dumps({"states": len(states), "seed": args.seed, "crossings": figures}, indent=1)
        + "\n"
    )


if __name__ == "__main__":
    main()
