"""The table of learners: from files of `knotgym evaluate --out`, beside the published scores.

    python benchmarks/results.py evaluations/*.json

Writes `benchmarks/results.json` and `docs/benchmark.md`. A setup that two files tell of is refused.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
TASKS, CROSSINGS = ("unknot", "tie", "convert"), (2, 3, 4)
# per cent on the train split after a million steps; arXiv 2505.18028
PUBLISHED = {
    "random": (11.1, 8.4, 6.7, 35.9, 2.5, 1.4, 36.8, 9.2, 2.9),
    "DreamerV3": (93.3, 93.4, 89.3, 83.2, 16.1, 4.1, 71.5, 15.3, 5.4),
    "PPO": (65.7, 63.3, 37.0, 41.3, 3.3, 1.3, 47.7, 6.3, 4.7),
    "TD-MPC2": (71.3, 55.4, 50.3, 39.2, 4.6, 1.7, 40.8, 8.7, 3.8),
}
HEAD = """# Benchmark

Made by `python benchmarks/results.py` from files that `knotgym evaluate --out FILE.json` wrote;
`benchmarks/results.json` holds the same. Success in per cent, with the 95 % interval of Wilson, of
so many episodes. The published rows are of the train split of states that aren't published, by 384
episodes (random 256): they are beside ours for scale, not like for like.
"""


def rows(paths: list[Path]) -> list[dict[str, Any]]:
    """One row for each setup of each evaluation."""
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for path in paths:
        told = json.loads(path.read_text(encoding="utf-8"))
        for one in told["results"]:
            row = {
                "policy": one["policy"],
                "states": told["settings"]["task"]["states"] or "readable",
                "split": one["split"],
                "task": one["task"],
                "nx": one["nx"],
                "episodes": one["episodes"],
                "successes": one["successes"],
                "success_rate": one["success_rate"],
                "interval": [one["low"], one["high"]],
                "steps": one["steps"],
                "planned_actions": one["planned_actions"],
                "planning_seconds": one["planning_seconds"],
                "seed": told["settings"]["seed"],
                "version": told["version"],
            }
            key = tuple(row[name] for name in ("policy", "states", "split", "task", "nx"))
            if key in found:
                sys.exit(f"{path} tells once more of {', '.join(map(str, key))}")
            found[key] = row
    return [found[key] for key in sorted(found, key=str)]


def page(found: list[dict[str, Any]]) -> str:
    """The Markdown of the table."""
    setups = [(task, nx) for task in TASKS for nx in CROSSINGS]
    lines = [HEAD]
    for states, split in dict.fromkeys((row["states"], row["split"]) for row in found):
        lines += [
            f"\n## States {states}, {split} split\n",
            "| policy | " + " | ".join(f"{task} {nx}" for task, nx in setups) + " |",
            "| --- " * (len(setups) + 1) + "|",
        ]
        own = [row for row in found if (row["states"], row["split"]) == (states, split)]
        for policy in dict.fromkeys(row["policy"] for row in own):
            cells = {(row["task"], row["nx"]): row for row in own if row["policy"] == policy}
            told = [_cell(cells[setup]) if setup in cells else "" for setup in setups]
            lines.append(f"| {policy} | " + " | ".join(told) + " |")
        for policy, scores in PUBLISHED.items():
            lines.append(f"| *{policy}, published* | " + " | ".join(map(str, scores)) + " |")
    return "\n".join(lines) + "\n"


def _cell(row: dict[str, Any]) -> str:
    low, high = row["interval"]
    rate = 100 * row["success_rate"]
    return f"**{rate:.1f}** ({100 * low:.0f} to {100 * high:.0f}, of {row['episodes']})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("evaluations", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results.json")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "benchmark.md")
    given = parser.parse_args()
    found = rows(given.evaluations)
    given.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    given.page.write_text(page(found), encoding="utf-8")


if __name__ == "__main__":
    main()
