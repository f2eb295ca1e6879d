"""The table of learners: from files of `knotgym evaluate --out`, beside the published scores.

    python benchmarks/results.py evaluations/*.json

Writes `benchmarks/results.json` and `docs/benchmark.md`. Files of one set-up that were played with
different seeds are counted together; the same episodes twice are refused.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from knotgym.generate.episodes.suite_scores import InvalidScores, read_scores, score_tables

ROOT = Path(__file__).parents[1]
HEAD = """# Benchmark

Made by `python benchmarks/results.py` from files that `knotgym evaluate --out FILE.json` wrote;
`benchmarks/results.json` holds the same. Success in per cent, with the 95 % interval of Wilson, of
so many episodes. The published rows are of the train split of states that aren't published, by 384
episodes (random 256): they are beside ours for scale, not like for like.

`pretrained`, as the published learners, is given pictures alone, `sb3-ppo-pixels` too; those of
d3rlpy, OGBench and `sb3-ppo-state` the vertices of the rope and of the goal's exemplar; `random`
nothing, it draws its actions. Those of d3rlpy and OGBench were trained once each, for all their
cells, on the suite's expert and noisy expert at tie and convert, nx 2 and 3 (4,600 episodes);
`d3rlpy-bc-dagger` besides on 96 episodes that `d3rlpy-bc` played and the expert labelled, so not on
offline data alone. [What holds them down](learning.md#learners-by-libraries). `pretrained` was
trained once, on episodes of `scripted`; it acts on pictures alone, but its training saw the
simulator's vertices and forces, and it plans with a table of 94,955 labelled macro-actions. (The
table isn't what carries the score: cut to nx 2, 15 of 24 goals are reached; with all of it, 15
of 24.) Those of Stable-Baselines3 were trained online, one for
each cell, for 1,048,576 steps of states and 20,480 of pictures, [with the paper's
settings](baselines.md). Of several trainings all seconds are told.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("evaluations", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results.json")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "benchmark.md")
    given = parser.parse_args()
    try:
        found = read_scores(given.evaluations)
    except InvalidScores as error:
        sys.exit(str(error))
    given.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    given.page.write_text("\n".join([HEAD, *score_tables(found)]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
