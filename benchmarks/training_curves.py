"""How trainings went, as a picture: from the folders that `baselines/ppo.py` wrote.

    python benchmarks/training_curves.py ppo-tie ppo-unknot --out docs/ppo-training

Success, explored as in training, over the environment's steps, a line for each folder, with
Wilson's 95 % interval, which is for the states trained on. Rows of `curve.json` are counted
together, --window steps of them. Writes OUT.svg, and OUT.json with the rows behind it.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from knotgym.runs.intervals import wilson

WIDE, LEFT, TOP, LABELS = 560, 70, 30, 240  # pixels
INK, PALE = "#222222", "#767676"
COLOURS = ("#2a6f97", "#b5482e", "#4f772d", "#6d597a")  # of the lines of a curve
HIGH = 240  # pixels, of the field of a curve
Row = dict[str, Any]


def text(x: float, y: float, words: object, anchor: str = "middle", colour: str = INK) -> str:
    """A line of words."""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}">'
        f"{escape(str(words))}</text>"
    )


def picture(width: float, height: float, parts: Sequence[str]) -> str:
    """A whole SVG file."""
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}"'
            f' width="{width:.0f}" font-family="sans-serif" font-size="13">',
            f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
            *parts,
            "</svg>\n",
        ]
    )


def course(folder: Path, window: int) -> dict[str, Any]:
    """One training: what it was of, and its rows, counted together.

    Raises:
        OSError, ValueError, KeyError, TypeError: it can't be read, or no episode ended in it.
    """
    task = json.loads((folder / "ppo.json").read_text(encoding="utf-8"))["task"]
    told = json.loads((folder / "curve.json").read_text(encoding="utf-8"))
    rows = []
    for _, part in itertools.groupby(told["rows"], lambda row: (row["steps"] - 1) // window):
        own = list(part)
        episodes, successes = (sum(row[name] for row in own) for name in ("episodes", "successes"))
        if episodes:
            low, high = wilson(successes, episodes)
            rate = successes / episodes
            counts = {"steps": own[-1]["steps"], "episodes": episodes, "successes": successes}
            rows.append({**counts, "success_rate": rate, "interval": [low, high]})
    if not rows:
        raise ValueError("no episode ended in it")
    last = told["rows"][-1]
    return {
        **{name: task[name] for name in ("task", "nx", "observation")},
        "states": task["states"] or "readable",
        "resumed_at": told["resumed_at"],
        "steps_per_second": last["steps"] / last["seconds"],
        "steps_per_cpu_second": last["steps"] / last["cpu_seconds"],
        "rows": rows,
    }


def drawn(courses: list[dict[str, Any]]) -> str:
    """All of them in one field."""
    highest = max(row["interval"][1] for one in courses for row in one["rows"])
    most = math.ceil(10 * highest) / 10
    steps = max(one["rows"][-1]["steps"] for one in courses)

    def at(row: Row, rate: float) -> str:
        x, y = LEFT + WIDE * row["steps"] / steps, TOP + HIGH * (1 - rate / most)
        return f"{x:.1f},{y:.1f}"

    parts = []
    for k in range(6):
        y = TOP + HIGH * (1 - k / 5)
        parts.append(f'<path d="M{LEFT} {y:.1f}h{WIDE}" stroke="#e3e3e3"/>')
        parts.append(text(LEFT - 8, y + 4, f"{20 * k * most:.0f} %", "end", PALE))
    parts.append(text(LEFT, TOP + HIGH + 20, "0", colour=PALE))
    parts.append(text(LEFT + WIDE, TOP + HIGH + 20, f"{steps:,}", colour=PALE))
    parts.append(text(LEFT + WIDE / 2, TOP + HIGH + 44, "steps of the environment"))
    for k, one in enumerate(courses):
        rows, colour = one["rows"], COLOURS[k % len(COLOURS)]
        low, high = ([at(row, row["interval"][end]) for row in rows] for end in (0, 1))
        band = " ".join([*low, *reversed(high)])
        parts.append(f'<polygon points="{band}" fill="{colour}" fill-opacity="0.15"/>')
        line = " ".join(at(row, row["success_rate"]) for row in rows)
        parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="2"/>')
        label = f"{one['task']} nx {one['nx']}, {one['states']}, {one['observation']}"
        parts.append(text(LEFT + WIDE + 12, TOP + 14 + 20 * k, label, "start", colour))
    return picture(LEFT + WIDE + LABELS, TOP + HIGH + 60, parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True, help="without .svg and .json")
    parser.add_argument("--window", type=int, default=65_536, help="steps counted together")
    given = parser.parse_args()
    if given.window < 1:
        sys.exit(f"--window must be at least 1, got {given.window}")
    courses = []
    for folder in given.folders:
        try:
            courses.append(course(folder, given.window))
        except (OSError, ValueError, KeyError, TypeError) as error:
            sys.exit(f"{folder} isn't a training of baselines/ppo.py: {error}")
    given.out.with_suffix(".svg").write_text(drawn(courses), encoding="utf-8")
    given.out.with_suffix(".json").write_text(json.dumps(courses, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
