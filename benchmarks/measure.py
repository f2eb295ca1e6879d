"""Measure the cells of the benchmark, then put them into its table.

    python benchmarks/measure.py --out measured [--only random,constant] [--episodes pretrained=256]

Every cell is one `knotgym evaluate` in one process, cheapest policies first, into a file of its own
in the folder --out. The same command goes on after an interruption; a cell that was measured with
other code is refused. `python benchmarks/results.py` runs at the end, over all files of --out.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
TASKS, CROSSINGS = ("unknot", "tie", "convert"), (2, 3, 4)
BOTH = ("readable", "random-walk")
# policy -> sets of states, splits, episodes a cell
PLAN: dict[str, tuple[tuple[str, ...], tuple[str, ...], int]] = {
    "random": (BOTH, ("train", "test"), 256),
    "constant": (BOTH, ("train", "test"), 256),
    "expert": (("readable",), ("test",), 64),
    "pretrained": (BOTH, ("test",), 128),
}


def cells(only: list[str], episodes: dict[str, int], seed: int) -> Iterator[tuple[str, list[str]]]:
    """The name of each cell's file, and the words of its command."""
    for policy in only:
        sets, splits, usual = PLAN[policy]
        for states in sets:
            for split in splits:
                for task in TASKS:
                    for nx in CROSSINGS:
                        name = f"{policy}-{states}-{split}-{task}-nx{nx}-seed{seed}.json"
                        words = f"--policy {policy} --task {task} --nx {nx} --split {split}"
                        words += f" --episodes {episodes.get(policy, usual)} --seed {seed}"
                        words += f" --states {states}" if states != "readable" else ""
                        yield name, words.split()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", default=",".join(PLAN), help="policies, with commas")
    parser.add_argument("--episodes", action="append", default=[], help="POLICY=N; repeated")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    episodes = {
        name: int(count) for name, _, count in (one.partition("=") for one in given.episodes)
    }
    given.out.mkdir(parents=True, exist_ok=True)
    for name, words in cells(given.only.split(","), episodes, given.seed):
        command = ["-m", "knotgym", "evaluate", *words, "--workers", "1", "--quiet", "--resume"]
        print(" ".join(["knotgym evaluate", *words]), flush=True)
        subprocess.run([sys.executable, *command, "--out", str(given.out / name)], check=True)
    files = sorted(map(str, given.out.glob("*.json")))
    subprocess.run([sys.executable, str(ROOT / "benchmarks" / "results.py"), *files], check=True)


if __name__ == "__main__":
    main()
