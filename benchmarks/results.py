"""The board: from the entries in `benchmarks/entries`, beside published scores.

    python benchmarks/results.py [--check | --all]

Replays the entries that are new or changed, and makes `docs/benchmark.md`, its picture and README's
table from what it counts. What it counted stands in `benchmarks/ledger.json`, by the digest of the
entry, so a new entry takes seconds. --check writes nothing and trusts less: it replays what is new
since the last commit and a tenth of the rest, drawn by the commit, and ends with 1 if a file would
differ. --all replays everything. The page's text is in `benchmarks/page.md`. Needs SciPy (the extra
`check`).

A cell is a protocol, an engine, a task and nx. An entry that has no protocol, or other rules than
its own, is refused by name, and so are entries that share episodes. What others wrote is text: a
row's key is the name of its file, and names are escaped. A policy of the package is played again.
"""

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
from board_rows import UNLEARNED, Refused, Row, require_apart, rows_of
from cyclopts import run
from numpy.typing import NDArray

from knotgym.common import KnotgymError, atomic_write, one_line
from knotgym.generate import SuiteConfig
from knotgym.runs import cluster_interval

ROOT = Path(__file__).parents[1]
BENCHMARKS = ROOT / "benchmarks"
ENTRIES, TEXT = BENCHMARKS / "entries", BENCHMARKS / "page.md"
SUITE = SuiteConfig.SUITE
SETUPS, BENCH_ENGINE = list(product(SUITE["tasks"], SUITE["nx"])), SUITE["bench"]["engine"]
_OUTCOMES = ("start", "goal", "success")
CLONERS = ("BC", "DiscreteBC", "GCBC", "NextBC", "d3rlpy recipe", "torch recipe")
# entries that the project's own scripts made, of which README's table is
OURS = re.compile(r"random|random-macro|expert|matching(-pixels)?|recipe-\w+|[a-z]+-nx\d[-\w]+")
# rows of README's table: how they are called, what they see, their protocol, and whose they may be
Fits = Callable[[str, str], bool]
SHOWN: dict[str, tuple[str, str, Fits]] = {
    "random pulls": ("nothing", "code", lambda name, _: name == "random"),
    "random macro-actions": ("nothing", "code", lambda name, _: name == "random macro-actions"),
    "`matching`, follows a shape": ("vertices", "goal-state", lambda name, _: name == "matching"),
    "cloning:": ("vertices", "goal-state", lambda name, _: name in CLONERS),
    "best of demonstrations (`noisy`, recipes):": (
        *("its code", "code"),
        lambda name, tier: "noisy" in tier or name.endswith("recipe"),
    ),
    "best of random macro-actions (`wander`):": ("its code", "code", lambda _, t: "wander" in t),
    "`expert`, plans in the simulator": ("its code", "code", lambda name, _: name == "expert"),
}
MOST = 16  # states named of each cell
SEVERAL = 3  # seeds that are compared, at least
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000", "#999999")
Floats = NDArray[np.float64]


def table(head: Sequence[object], rows: Sequence[Sequence[object]]) -> list[str]:
    """The lines of a Markdown table."""
    return [f"| {' | '.join(map(str, one))} |" for one in (head, ["---"] * len(head), *rows)]


def over_seeds(found: Sequence[Row]) -> tuple[float, float, float]:
    """The rate of rows of one cell, and its interval over states and, of several, seeds."""
    parts = [np.concatenate([getattr(one, name) for one in found]) for name in _OUTCOMES]
    seeds = [np.repeat(range(len(found)), [len(one.success) for one in found])]
    parts += seeds[: len(found) > 1]
    interval = cluster_interval(parts[2].tolist(), parts[0], parts[1], *parts[3:])
    return float(parts[2].mean()), *interval


def share(rate: float, cell: tuple[str, str, int], protocol: str, rows: Sequence[Row]) -> str:
    """A rate on the scale from the best row that doesn't learn, 0, to the expert, 100."""
    here = [one for one in rows if one.cell == cell and protocol in one.protocols]
    low = [one.rate for one in here if one.learner in UNLEARNED]
    high = [one.rate for one in here if one.learner == "expert"]
    if not (low and high and high[0] > max(low)):
        return ""
    return f", {100 * (rate - max(low)) / (high[0] - max(low)):.0f}"


def boards(rows: Sequence[Row]) -> Iterator[str]:
    """A table for each protocol and engine."""
    for protocol, engine in sorted({(own, row.engine) for row in rows for own in row.protocols}):
        own = [row for row in rows if row.engine == engine and protocol in row.protocols]
        cells = sorted({row.cell for row in own})
        body = []
        for who in sorted({row.who for row in own}):
            mine = {cell: [r for r in own if (r.who, r.cell) == (who, cell)] for cell in cells}
            _, learner, tier, action = who
            shown = []
            for cell, found in mine.items():
                rate, low, high = over_seeds(found) if found else (0.0, 0.0, 0.0)
                of_way = share(rate, cell, protocol, own)
                text = f"**{100 * rate:.1f}** ({100 * low:.0f} to {100 * high:.0f}{of_way})"
                shown.append(text if found else "")
            sizes = sorted({len(one.success) for found in mine.values() for one in found})
            several = max(map(len, mine.values()))
            named = learner + f", {tier}" * bool(tier)
            body.append((named, several, action, ", ".join(map(str, sizes)), *shown))
        yield f"### {protocol}, {engine} engine\n"
        names = (f"{task} {nx}" for _, task, nx in cells)
        yield from table(("learner", "seeds", "acts in", "N", *names), body)
        yield ""


def grid(rows: Sequence[Row]) -> dict[str, dict[str, Floats]]:
    """Success rates (seeds,) of learners with several seeds, by the entries' name and learner."""
    found: dict[str, dict[str, Floats]] = {}
    for row in rows:
        if "code" not in row.protocols:
            continue
        own = found.setdefault(row.source, {})
        own[row.learner] = np.append(own.get(row.learner, ()), row.rate)
    return {
        name: own
        for name, own in sorted(found.items())
        if len(own) > 1 and min(map(len, own.values())) >= SEVERAL
    }


def better(first: Floats, second: Floats) -> float:
    """The probability of improvement: that a seed of the first beats one of the second."""
    from scipy.stats import mannwhitneyu  # here, as --help needs no SciPy

    return float(mannwhitneyu(first, second).statistic / (len(first) * len(second)))


def iqm(*cells: Floats, axis: int = -1) -> Any:
    """The mean of the middle half of all seeds of all cells."""
    from scipy.stats import trim_mean

    return trim_mean(np.concatenate(cells, axis=axis), 0.25, axis=axis)


def tau(first: Sequence[float], second: Sequence[float]) -> float:
    """Kendall's tau of two orders of the same learners."""
    from scipy.stats import kendalltau

    return float(kendalltau(first, second).statistic)


def agreement(rates: Floats) -> float:
    """Kendall's tau of the order of learners (learners, seeds), on average, between two seeds."""
    return float(np.mean([tau(one, other) for one, other in combinations(rates.T, 2)]))


def seeds(cells: dict[str, dict[str, Floats]]) -> Iterator[str]:
    """Learners with several trainings: what is more than chance."""
    from scipy.stats import bootstrap

    if not cells:
        return
    rng, names = np.random.default_rng(0), sorted(set.intersection(*map(set, cells.values())))
    body = []
    for name in names:
        own = [rates[name] for rates in cells.values()]
        drawn = bootstrap(own, iqm, n_resamples=2000, method="percentile", rng=rng)
        low, high = (100 * end for end in drawn.confidence_interval)
        ends = [[100 * rate for rate in (one.mean(), one.min(), one.max())] for one in own]
        rates = [f"{mean:.1f} ({least:.0f} to {most:.0f})" for mean, least, most in ends]
        middle = 100 * float(iqm(*own))
        line = name, f"{middle:.1f}", f"{low:.1f} to {high:.1f}", *rates
        body.append((middle, name, line))
    body.sort(reverse=True)
    counts = (f"{name}, {len(own[names[0]])} seeds, mean (range)" for name, own in cells.items())
    yield from table(("learner", "IQM", "95 % interval", *counts), [line for *_, line in body])
    yield "\n![Share of trainings with at least a success rate, by learner](profile.svg)\n"
    order = [name for _, name, _ in body]
    yield "How often a training of the row is better than one of the column, in per cent:\n"
    chances = [
        [f"{100 * chance(cells, one, other):.0f}" * (one != other) for other in order]
        for one in order
    ]
    pairs = [(name, *own) for name, own in zip(order, chances, strict=True)]
    yield from table(("", *order), pairs)
    yield "\nKendall's tau of their order: of one cell between two seeds, of two between means:\n"
    grids = {name: np.array([own[one] for one in names]) for name, own in cells.items()}
    taus = [
        [
            agreement(one) if one is other else tau(one.mean(1), other.mean(1))
            for other in grids.values()
        ]
        for one in grids.values()
    ]
    shown = [(name, *(f"{one:.2f}" for one in row)) for name, row in zip(cells, taus, strict=True)]
    yield from table(("", *cells), shown)
    yield ""


def chance(cells: dict[str, dict[str, Floats]], one: str, other: str) -> float:
    """The probability of improvement on average over cells."""
    return float(np.mean([better(rates[one], rates[other]) for rates in cells.values()]))


def profile(cells: dict[str, dict[str, Floats]]) -> str:
    """Performance profiles: the share of trainings whose rate is at least x."""
    lines = []
    for k, name in enumerate(sorted({name for own in cells.values() for name in own})):
        own = np.concatenate([rates[name] for rates in cells.values() if name in rates])
        steps = [f"{40 + 4 * x:.0f},{220 - 200 * np.mean(own >= x / 100):.0f}" for x in range(101)]
        colour = COLOURS[k % len(COLOURS)]
        lines.append(
            f'<polyline fill="none" stroke="{colour}" stroke-width="2"'
            f' points="{" ".join(steps)}"/>'
            f'<text x="455" y="{30 + 22 * k}" fill="{colour}">{name}</text>'
        )
    marks = [f'<text x="{35 + 100 * k}" y="240">{25 * k}</text>' for k in range(5)]
    return "\n".join(
        [
            '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 560 265" font-family="sans-serif"'
            ' font-size="13"><rect width="560" height="265" fill="white"/>',
            '<path d="M40 20V220H440" fill="none" stroke="#666"/><text x="8" y="25">100</text>'
            '<text x="20" y="224">0</text><text x="150" y="258">success rate at least, %</text>',
            *marks,
            *lines,
            "</svg>\n",
        ]
    )


def hard_starts(rows: Sequence[Row]) -> Iterator[str]:
    """For each cell of protocol code: random, the best learner, what every learner fails on."""
    body, failed = [], dict[str, list[int]]()
    own = [row for row in rows if "code" in row.protocols and row.engine == BENCH_ENGINE]
    for cell in sorted({row.cell for row in own}):
        here = [row for row in own if row.cell == cell]
        learners = [row for row in here if row.learner not in (*UNLEARNED, "expert")]
        rates = {row.learner: 100 * row.rate for row in here}
        if not learners:
            continue
        best = max(learners, key=lambda row: row.rate)
        name = " ".join(map(str, cell[1:]))
        tangled: dict[int, list[int]] = {}
        for row in learners:
            side = row.goal if row.task == "tie" else row.start  # the other is a plain loop
            for state, done in zip(side.tolist(), row.success.tolist(), strict=True):
                tangled.setdefault(state, []).append(done)
        failed[name] = sorted(state for state, done in tangled.items() if not any(done))
        rest = f"{100 * len(failed[name]) / len(tangled):.1f} of {len(tangled)}"
        told = [f"{rates[one]:.1f}" if one in rates else "" for one in ("random", "expert")]
        body.append((name, *told, f"{100 * best.rate:.1f} ({best.learner})", len(learners), rest))
    head = ("cell", "random", "expert", "best learner", "trainings", "all fail on, % of states")
    yield from table(head, body)
    yield ""
    for name, states in failed.items():
        if states:
            yield f"{name}, rows of `bench`: {', '.join(map(str, states[:MOST]))}\n"


def page(rows: Sequence[Row]) -> str:
    """docs/benchmark.md: the text, with tables in the places of its marks."""
    published = [(f"*{name}*", *own) for name, own in SUITE["published"].items()]
    parts = {
        "boards": boards(rows),
        "seeds": seeds(grid(rows)),
        "hard": hard_starts(rows),
        "published": table(("learner", *(f"{task} {nx}" for task, nx in SETUPS)), published),
    }
    whole = TEXT.read_text(encoding="utf-8")
    for name, lines in parts.items():
        whole = whole.replace(f"<!-- {name} -->", "\n".join(lines).rstrip("\n"))
    return whole


def readme(text_: str, rows: Sequence[Row]) -> str:
    """README with its table: who doesn't learn, the best of each kind, and the expert."""
    cells = [(BENCH_ENGINE, task, nx) for task, nx in product(("tie", "convert"), (2, 3))]
    shown = []
    for says, (sees, protocol, fits) in SHOWN.items():
        line: list[str] = []
        for cell in cells:
            whose: dict[tuple[str, ...], list[float]] = {}
            for row in rows:
                mine = row.cell == cell and OURS.fullmatch(row.source) and protocol in row.protocols
                if mine and fits(row.learner, row.tier):
                    whose.setdefault(row.who, []).append(100 * row.rate)
            means = sorted((float(np.mean(own)), who[1]) for who, own in whose.items())
            rate, name = means[-1] if means else (0.0, "")
            named = f", {name}" * says.endswith(":")
            line.append(f"{rate:.1f}{named}" if means else "not played")
        if {*line} != {"not played"}:
            shown.append((says.rstrip(":"), sees, *line))
    head = ("policy", "sees of the goal", *(f"{task} {nx}" for _, task, nx in cells))
    lines = "\n".join(table(head, shown))
    made, count = re.subn(
        r"(<!-- board -->\n).*?(?=<!-- end of board -->)",
        lambda found: f"{found[1]}\n{lines}\n\n",
        text_,
        flags=re.S,
    )
    if count != 1:
        raise SystemExit("README.md has no one place for the board")
    return made


def replayed_in_ci(paths: Sequence[Path], ledger: dict[str, Any]) -> set[Path]:
    """The entries that --check replays: new since the last commit, and a tenth of the rest."""

    def git(*words: str) -> str:
        made = subprocess.run(("git", "-C", ROOT, *words), capture_output=True, text=True)
        return made.stdout if made.returncode == 0 else ""

    before = json.loads(git("show", "HEAD~1:benchmarks/ledger.json") or '{"entries": {}}')
    known, new = before["entries"], ledger["entries"]
    old = [path for path in paths if new.get(path.name) == known.get(path.name, 0)]
    rng = np.random.default_rng(int(git("rev-parse", "HEAD").strip()[:12] or "0", 16))
    drawn = rng.permutation(len(old))[: -(-len(old) // 10)]
    return {*paths} - {one for k, one in enumerate(old) if k not in drawn}


def main(
    *, check: bool = False, all: bool = False, entries: Path = ENTRIES, root: Path = ROOT
) -> None:
    """Make the board from the entries.

    Args:
        check: write nothing; status 1 if a file differs.
        all: replay every entry.
        entries: folder of entries.
        root: folder of README.md and docs.
    """
    paths, place = sorted(entries.glob("*.h5")), root / "benchmarks" / "ledger.json"
    ledger: dict[str, Any] = {"episodes": {}, "entries": {}}
    if place.is_file():
        ledger = json.loads(place.read_text(encoding="utf-8"))
    ledger["entries"] = {k: v for k, v in ledger["entries"].items() if entries / k in paths}
    again = replayed_in_ci(paths, ledger) if check else {*paths} if all else set()
    rows, faults = list[tuple[Row, list[bytes]]](), list[str]()
    for number, path in enumerate(paths, 1):
        print(f"{number} of {len(paths)}: {path.name}", file=sys.stderr)
        try:
            own = [*rows_of(path, ledger, path in again)]
            require_apart([*rows, *own], len(rows))
            rows += own
            if not check:  # so that an interrupted run is continued
                place.write_text(json.dumps(ledger, indent=1) + "\n", encoding="utf-8")
        except (Refused, KnotgymError, LookupError, TypeError, ValueError) as error:
            faults.append(f"{path.name} {one_line(str(error))}")
    if faults:
        sys.exit("\n".join(faults))
    found = [row for row, _ in rows]
    made = {
        "docs/benchmark.md": page(found),
        "docs/profile.svg": profile(grid(found)),
        "README.md": readme((root / "README.md").read_text(encoding="utf-8"), found),
        "benchmarks/ledger.json": json.dumps(ledger, indent=1) + "\n",
    }
    for name, content in made.items():
        path = root / name
        if path.is_file() and path.read_text(encoding="utf-8") == content:
            continue
        if check:
            sys.exit(f"{name} isn't what the entries make: run benchmarks/results.py")
        with atomic_write(path, overwrite=True) as part:
            part.write_text(content, encoding="utf-8")


if __name__ == "__main__":
    run(main)
