"""The table of learners: from files of `knotgym evaluate --out`, beside the published scores.

    python benchmarks/results.py [--learner NAME] FILE.json...

Puts a row for each cell of the files into `benchmarks/evaluations.csv`, in the place of an earlier
measurement of the same policy on the same states, and makes `docs/benchmark.md` from all its rows.
The column `learner` names the row of the page in which a measurement counts: policies with one
name there are seeds of one learner. Empty it in the CSV where a later measurement supersedes it.
Files of one cell that were played with different seeds are counted together; the same episodes
twice, and files without digests, are refused. Without files it makes the page again.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from scores import CELL, LINE, read_scores

from knotgym.common import InvalidFile, atomic_write
from knotgym.generate import SUITE, EvaluateConfig
from knotgym.runs import identity

ROOT = Path(__file__).parents[1]
COUNTS = ("nx", "episodes", "successes", "starts", "goals")
RATES = ("success_rate", "low", "high")
TEXTS = ("steps", "seeds", "trained_seconds", "commit", "command")  # the first and third may be ""
COLUMNS = ("learner", *LINE, *CELL, *COUNTS[1:], *RATES, *TEXTS)
# rows in which these are the same measure the same thing, the later one with newer code
SAME = ("policy", "settings", "policy_sha256", *CELL)
HEAD = """# Benchmark

Success rates in per cent, one row a learner. With one training seed the range is the 95 % interval
of its rate; with several, the rate is their mean and the range goes from the worst to the best
seed. `python benchmarks/results.py` makes this page from `benchmarks/evaluations.csv`, which has
the episodes, digests, commit and command of each measurement, the rows of every seed, and
measurements that later ones superseded.

*Published* rows are of the train split of states that aren't published, of 384 episodes (random:
256). They stand beside ours for scale; the settings differ. `pretrained` acts on pictures alone, as
the published learners do, but unlike them it was trained with the simulator's vertices and forces
as targets, and it plans with a table of 94,955 labelled macro-actions. (The table isn't what
carries the score: cut to nx 2, 15 of 24 goals are reached; with all of it, 15 of 24.)
Clones choose a bead and a strand instead of six numbers, so their scores have a table of their own;
`pretrained-clone` is one of the three seeds of `clone`.

Offline learners are trained on episodes like those of [the suite](suite.md).

On [`bench`](sets.md), with 256 starts and up to 256 goals a cell, 1,024 episodes make intervals of
about 5 points to either side, or less. Learners named by a size saw the same episodes, so their
rows compare how an action is chosen: *discrete-bc* classifies the bead and regresses the forces,
clones classify bead and strand, the others regress where to pull and the forces. All see ropes in a
canonical frame, but for those that see them *as they lie*.

## Intervals

Episodes repeat start states and goals: a cell of 256 episodes has about 20 tangled states and 8 or
9 plain loops. The intervals are for the success rate on states drawn as these were, so they
resample states. A bootstrap over starts and one over goals (2,000 draws each, of a fixed random
stream, G - 1 of G states with replacement) give the variance V = V(starts) + V(goals) - p (1 - p) /
n, in which the variance within states, part of both terms, is subtracted once. The interval is
Wilson's with p (1 - p) / V effective episodes and Student's t with one degree of freedom fewer than
the states of the smaller side. Where all episodes succeed, or none, each state of the larger side
counts as one trial. A side with one state adds nothing: the interval then holds for that state
alone. `knotgym/runs/intervals.py` has the references.

On simulated cells (20 starts, 9 or 20 goals; random effects on the log odds with standard
deviations of 0 to 2 for starts and half of it for goals) the interval holds the true rate in 93 to
99 % of cells; Wilson's interval of independent episodes in 53 to 97 %, least where states differ
most: `pytest -m slow tests/runs/test_intervals.py`.
"""
Row = dict[str, Any]


def command(row: Mapping[str, Any]) -> str:
    """The command that measures a policy of `knotgym evaluate`; of several seeds, the first's."""
    flags: dict[str, Any] = {
        **{name: row[name] for name in ("policy", "task", "nx", "split")},
        "episodes": row["episodes"] // len(row["seeds"]),
        "seed": row["seeds"][0],
    }
    if row["states"] != "readable":
        flags["states"] = row["states"]
    for setting in filter(None, row["settings"].split("; ")):
        name, _, value = setting.partition("=")
        flags[name.rpartition(".")[2].replace("_", "-")] = value.strip('"')
    words = [f"--{name} {shlex.quote(str(value))}" for name, value in flags.items()]
    return " ".join(["knotgym evaluate", *words])


def commit() -> str:
    """The commit of this checkout."""
    words = ["git", "-C", str(ROOT), "rev-parse", "--short=12", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


def as_cell(row: Mapping[str, Any], at: str, learner: str) -> Row:
    """A row of `read_scores` as the table has it; measured with the code of commit `at`.

    Raises:
        InvalidFile: the code that measured it isn't that of this checkout.
    """
    code = identity(EvaluateConfig())["versions"]["code"]
    if row["code_sha256"] != code:
        raise InvalidFile(
            f"{row['policy']}, {row['task']} nx {row['nx']} was measured with code"
            f" {row['code_sha256'][:8]}, and this checkout has {code[:8]}: check out"
            " its commit, or measure it again"
        )
    trained = row["training"].get("seconds")
    return {
        "learner": learner,
        **{name: row[name] for name in (*LINE, *CELL, *COUNTS)},
        **dict(zip(RATES, (row["success_rate"], *row["interval"]), strict=True)),
        "steps": row["steps"],
        "seeds": row["seeds"],
        "trained_seconds": trained,
        "commit": at,
        "command": row["training"].get("command") or command(row),
    }


def read_table(path: Path) -> list[Row]:
    """The rows of the table; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        rows: list[Row] = list(csv.DictReader(file))
    for row in rows:
        row |= {name: int(row[name]) for name in COUNTS}
        row |= {name: float(row[name]) for name in RATES}
        row |= {name: json.loads(row[name] or "null") for name in TEXTS[:3]}
    return rows


def table_text(rows: Sequence[Row]) -> str:
    """The table as CSV."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        told = {name: json.dumps(row[name]) for name in TEXTS[:3] if row[name] is not None}
        rates = {name: f"{row[name]:.5f}" for name in RATES}
        writer.writerow({**row, **dict.fromkeys(TEXTS[:3], ""), **told, **rates})
    return text.getvalue()


def page(rows: Sequence[Row]) -> str:
    """docs/benchmark.md: a table for each set of states, split, engine and kind of action."""
    setups = list(product(SUITE["tasks"], SUITE["nx"]))
    head = ("learner", "seeds", *(f"{task} {nx}" for task, nx in setups))
    lines = [HEAD]
    for track in sorted({_track(row) for row in rows if row["learner"]}):
        in_macros, states, split, in_chain = track
        body: list[tuple[object, ...]] = []
        own = [row for row in rows if row["learner"] and _track(row) == track]
        for learner in sorted({row["learner"] for row in own}):
            cells: dict[tuple[str, int], list[Row]] = {}
            for row in own:
                if row["learner"] == learner:
                    cells.setdefault((row["task"], row["nx"]), []).append(row)
            seeds = max(map(len, cells.values()))
            body.append((learner, seeds, *(_rate(cells.get(setup, [])) for setup in setups)))
        # they were measured on states like those of both other sets
        if not in_macros and not in_chain and states != "bench":
            body += [(f"*{name}, published*", "", *own) for name, own in SUITE["published"].items()]
        title = f"## States {states}, {split} split" + ", chain engine" * in_chain
        title += ", macro-actions" * in_macros
        lines += [
            title,
            "",
            *(f"| {' | '.join(map(str, one))} |" for one in (head, ["---"] * len(head), *body)),
            "",
        ]
    return "\n".join(lines).rstrip("\n") + "\n"


def _track(row: Row) -> tuple[bool, str, str, bool]:
    """What has a table of its own: whether actions are macro-actions, states, split, engine."""
    settings = row["settings"].split("; ")
    in_macros, in_chain = ('action="macro"' in settings), ('engine="chain"' in settings)
    return in_macros, row["states"], row["split"], in_chain


def _rate(seeds: Sequence[Row]) -> str:
    """The rate of one seed with its interval; of several, the mean with the worst and the best."""
    if not seeds:
        return ""
    rates = [100 * row["success_rate"] for row in seeds]
    low, high = (100 * seeds[0]["low"], 100 * seeds[0]["high"])
    if len(seeds) > 1:
        low, high = min(rates), max(rates)
    return f"**{sum(rates) / len(rates):.1f}** ({low:.0f} to {high:.0f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("evaluations", type=Path, nargs="*")
    parser.add_argument("--learner", help="row of the page; by default the policy's name")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "evaluations.csv")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "benchmark.md")
    given = parser.parse_args()
    try:
        scores = read_scores(given.evaluations)
        measured = [as_cell(row, commit(), given.learner or row["policy"]) for row in scores]
    except InvalidFile as error:
        sys.exit(str(error))
    rows = {tuple(str(row[name]) for name in SAME): row for row in read_table(given.out)}
    rows |= {tuple(str(row[name]) for name in SAME): row for row in measured}
    ordered = sorted(rows.values(), key=lambda row: [str(row[name]) for name in (*CELL, *LINE)])
    for path, text in ((given.out, table_text(ordered)), (given.page, page(ordered))):
        with atomic_write(path) as part:
            part.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
