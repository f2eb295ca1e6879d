"""What a learner's training does for it, as a picture: from files of `knotgym evaluate --out`.

    python benchmarks/learner_curves.py matrix evaluations/*.json --out docs/generalization
    python benchmarks/learner_curves.py data evaluations/*.json --out docs/data-curve
    python benchmarks/learner_curves.py goals evaluations/*.json --out docs/goal-curve

`matrix` shows success by the learner, a row each, and the set-ups it was tested at, a column each;
`data` success by the number of episodes that learners were trained on; `goals` by that of goal
configurations, the `--max-goals` that a learner was tried with on the train split. Files of one
set-up with different seeds are counted together. Writes OUT.svg, and OUT.json with the rows behind
it.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from knotgym.generate.episodes.suite_scores import InvalidScores, read_scores

INK, PALE = "#222222", "#767676"
COLOURS = ("#2a6f97", "#b5482e", "#4f772d", "#6d597a")  # of the lines of a curve
CELL, LEFT, TOP = 96, 190, 64  # pixels
WIDE, HIGH = 420, 240  # of the field of a curve
WORDS = {"data": "episodes trained on", "goals": "goal configurations trained on"}
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


def interval(row: Row) -> str:
    """In per cent."""
    low, high = row["interval"]
    return f"{100 * low:.0f} to {100 * high:.0f}"


def matrix(rows: Sequence[Row], names: dict[str, str]) -> str:
    """Learners by set-ups; every cell has its rate, interval and number of episodes."""
    learners = [policy for policy in names if any(row["policy"] == policy for row in rows)]
    columns = sorted({(row["task"], row["nx"]) for row in rows})
    cells = {(row["policy"], row["task"], row["nx"]): row for row in rows}
    parts = [text(LEFT + CELL * len(columns) / 2, 22, "tested at")]
    parts += [
        text(LEFT + CELL * (i + 0.5), 48, f"{task} {nx}") for i, (task, nx) in enumerate(columns)
    ]
    for j, policy in enumerate(learners):
        y = TOP + CELL * j
        parts.append(text(LEFT - 12, y + CELL / 2 + 4, names[policy], "end"))
        for i, setup in enumerate(columns):
            row, x = cells.get((policy, *setup)), LEFT + CELL * i
            if row is None:
                parts.append(text(x + CELL / 2, y + CELL / 2, "not run", colour=PALE))
                continue
            rate = row["success_rate"]
            shade = [round(255 + rate * (own - 255)) for own in (42, 111, 151)]
            colour = "#ffffff" if rate > 0.7 else INK
            parts.append(
                f'<rect x="{x + 2}" y="{y + 2}" width="{CELL - 4}" height="{CELL - 4}" rx="4"'
                f' fill="rgb({shade[0]},{shade[1]},{shade[2]})" stroke="#d0d0d0"/>'
            )
            told = (f"{100 * rate:.0f} %", interval(row), f"of {row['episodes']}")
            for k, words in enumerate(told):
                parts.append(text(x + CELL / 2, y + 36 + 19 * k, words, colour=colour))
    return picture(LEFT + CELL * len(columns) + 20, TOP + CELL * len(learners) + 16, parts)


def curve(rows: Sequence[Row], numbers: dict[str, int], words: str) -> str:
    """Success by a number that each policy has, on a logarithmic axis, with intervals."""
    marks = sorted(set(numbers.values()))
    low, high = math.log(marks[0] / 1.3), math.log(marks[-1] * 1.3)
    most = math.ceil(10 * max(row["interval"][1] for row in rows)) / 10  # of the field

    def at(number: int, rate: float) -> tuple[float, float]:
        share = (math.log(number) - low) / (high - low)
        return 70 + WIDE * share, 30 + HIGH * (1 - rate / most)

    parts = []
    for k in range(6):
        y = 30 + HIGH * (1 - k / 5)
        parts.append(f'<path d="M70 {y:.1f}h{WIDE}" stroke="#e3e3e3"/>')
        parts.append(text(62, y + 4, f"{20 * k * most:.0f} %", "end", PALE))
    for number in marks:
        parts.append(text(at(number, 0)[0], 30 + HIGH + 20, number, colour=PALE))
    parts.append(text(70 + WIDE / 2, 30 + HIGH + 44, words))
    lines = sorted({(row["task"], row["nx"], row["split"]) for row in rows})
    for k, line in enumerate(lines):
        own = [row for row in rows if (row["task"], row["nx"], row["split"]) == line]
        own.sort(key=lambda row: numbers[row["policy"]])
        colour, aside = COLOURS[k % len(COLOURS)], 4 * k  # so that intervals don't hide each other
        points = [at(numbers[row["policy"]], row["success_rate"]) for row in own]
        drawn = " ".join(f"{x + aside:.1f},{y:.1f}" for x, y in points)
        parts.append(f'<polyline points="{drawn}" fill="none" stroke="{colour}" stroke-width="2"/>')
        for (x, y), row in zip(points, own, strict=True):
            below, above = (at(1, rate)[1] for rate in row["interval"])
            parts.append(f'<path d="M{x + aside:.1f} {below:.1f}V{above:.1f}" stroke="{colour}"/>')
            parts.append(f'<circle cx="{x + aside:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>')
        label = f"{line[0]} nx {line[1]}, {line[2]} split"
        parts.append(text(80 + WIDE, 44 + 20 * k, label, "start", colour))
    return picture(70 + WIDE + 160, 30 + HIGH + 60, parts)


def numbers_of(kind: str, rows: Sequence[Row]) -> dict[str, int]:
    """What a curve is drawn over, for each policy."""
    if kind == "data":
        told = {row["policy"]: row["training"].get("episodes") for row in rows}
        missing = "doesn't say how many episodes it was trained on"
    else:
        told = dict.fromkeys(row["policy"] for row in rows)
        told |= {
            row["policy"]: row["rules"]["max_goals"]
            for row in rows
            if row["split"] == "train" and row["rules"]["max_goals"] is not None
        }
        missing = "wasn't tried on the train split with --max-goals"
    for policy, number in told.items():
        if number is None:
            sys.exit(f"{policy} {missing}")
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("kind", choices=("matrix", "data", "goals"))
    parser.add_argument("evaluations", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True, help="without .svg and .json")
    parser.add_argument(
        "--names", default="", help="rows of the matrix: the last part of a policy=words, by commas"
    )
    given = parser.parse_args()
    try:
        rows = read_scores(given.evaluations)
    except InvalidScores as error:
        sys.exit(str(error))
    told = dict(pair.split("=", 1) for pair in given.names.split(",") if "=" in pair)
    policies = {Path(row["policy"]).name: row["policy"] for row in rows}
    order = [*[name for name in told if name in policies], *sorted({*policies} - {*told})]
    names = {policies[name]: told.get(name, name) for name in order}
    if given.kind == "matrix":
        drawn = matrix(rows, names)
    else:
        drawn = curve(rows, numbers_of(given.kind, rows), WORDS[given.kind])
    given.out.with_suffix(".svg").write_text(drawn, encoding="utf-8")
    for row in rows:
        if Path(row["policy"]).is_absolute():  # no folder of this machine
            row["policy"] = Path(row["policy"]).name
    given.out.with_suffix(".json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
