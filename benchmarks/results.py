"""The board: from the entries in `benchmarks/entries`, beside published scores.

    python benchmarks/results.py [--check]

Replays every entry, and makes `docs/benchmark.md`, its picture and the rows of README's table that
have entries from what it counts. The page's text, and rows without an entry, which it shows as
reported, are in `benchmarks/page.md`. With --check nothing is written: the status is 1 if a file
would differ. Needs SciPy (the extra `check`).
"""

import re
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterator, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from seeds import CELLS, CHANGES, LEARNERS, ORDERED, SEEDS

from knotgym.common import atomic_write
from knotgym.generate import Result, SuiteConfig, read_entry
from knotgym.rope import CHAIN
from knotgym.runs import cluster_interval

ROOT = Path(__file__).parents[1]
ENTRIES, TEXT = ROOT / "benchmarks" / "entries", ROOT / "benchmarks" / "page.md"
SUITE = SuiteConfig.SUITE
SETUPS = list(product(SUITE["tasks"], SUITE["nx"]))
BENCH = ("bench", "test", True, False)
# rows of README's table: how they begin, and the learner, tier and track of their entries
SHOWN = {
    "| `bench`, chain | random actions ": ("random", "", BENCH),
    "| | [d3rlpy": ("d3rlpy recipe", "", BENCH),
    "| | [DiscreteBC": ("DiscreteBC", "100k", BENCH),
    "| | [torch": ("torch recipe", "", BENCH),
    "| | `expert`": ("expert", "", BENCH),
    "| `readable`, MuJoCo | random actions ": ("random", "", ("readable", "test", False, False)),
}
MOST = 16  # rows that are named of each cell
NO_LEARNERS = ("random", "scripted", "expert")
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000", "#999999")
Floats = NDArray[np.float64]
Track = tuple[str, str, bool, bool]  # states, split, chain engine, macro-actions


class Row(NamedTuple):
    """A result of an entry, and what its learner is called: its name and the tier of its set."""

    learner: str
    tier: str
    track: Track
    result: Result


def rows_of(path: Path) -> Iterator[Row]:
    """The results of an entry, which is replayed."""
    entry = read_entry(path)
    if entry is None:
        raise SystemExit(f"{path} isn't an entry")
    config = entry.config
    for (one, faults), claimed in zip(entry.recounted(), entry.claimed, strict=True):
        if faults:
            raise SystemExit(f"{path}: {faults[0]}")
        training = claimed["training"]
        name = training.get("learner", one.policy) if ":" in one.policy else one.policy
        (tier,) = {*re.findall(r"-(\d+[kM])-v0", " ".join(training.get("data", {})))} or {""}
        in_chain, in_macros = config.task.engine == CHAIN, one.action == "macro"
        yield Row(
            name, tier, (config.task.states or "readable", one.split, in_chain, in_macros), one
        )


def table(head: Sequence[object], rows: Sequence[Sequence[object]]) -> list[str]:
    """The lines of a Markdown table."""
    return [f"| {' | '.join(map(str, one))} |" for one in (head, ["---"] * len(head), *rows)]


def over_seeds(found: Sequence[Result]) -> tuple[float, float, float]:
    """The rate of results of one cell, and its interval over states and, of several, seeds."""
    if len(found) == 1:
        return found[0].success_rate, found[0].low, found[0].high
    names = found[0].outcomes
    parts = {name: [k for one in found for k in one.outcomes[name]] for name in names}
    seeds = np.repeat(range(len(found)), [one.episodes for one in found])
    interval = cluster_interval(parts["success"], parts["start"], parts["goal"], seeds)
    return float(np.mean(parts["success"])), *interval


def boards(rows: Sequence[Row]) -> Iterator[str]:
    """A table for each set of states, split, engine and kind of action."""
    for track in sorted({row.track for row in rows}):
        states, split, in_chain, in_macros = track
        body: list[tuple[object, ...]] = []
        own = [row for row in rows if row.track == track]
        played = {(row.result.task, row.result.nx) for row in own}
        setups = [setup for setup in SETUPS if setup in played]
        head = ("learner", "seeds", *(f"{task} {nx}" for task, nx in setups))
        for learner, tier in sorted({(row.learner, row.tier) for row in own}):
            mine = [row.result for row in own if (row.learner, row.tier) == (learner, tier)]
            cells = [[one for one in mine if (one.task, one.nx) == setup] for setup in setups]
            shown = [
                "**{:.1f}** ({:.0f} to {:.0f})".format(*(100 * one for one in over_seeds(cell)))
                if cell
                else ""
                for cell in cells
            ]
            body.append((learner + f", {tier}" * bool(tier), max(map(len, cells)), *shown))
        yield (
            f"### States {states}, {split} split"
            + ", chain engine" * in_chain
            + (", macro-actions" * in_macros)
        )
        yield from ("", *table(head, body), "")


def grid(rows: Sequence[Row]) -> dict[str, Floats]:
    """Success rates of the learners with several seeds, (learners, seeds), by cell of `seeds`."""
    found: dict[str, Floats] = {}
    for name, (task, nx, tier, _) in CELLS.items():
        rates = [
            [
                row.result.success_rate
                for row in rows
                if (row.learner, row.tier, row.track)
                == (learner, tier, ("bench", "test", True, False))
                and (row.result.task, row.result.nx) == (task, nx)
            ]
            for learner in LEARNERS
        ]
        if all(rates):
            count = min(map(len, rates))
            found[name] = np.array([own[:count] for own in rates])
    return found


def better(first: Floats, second: Floats) -> float:
    """The probability of improvement: that a seed of the first beats one of the second."""
    from scipy.stats import mannwhitneyu  # here, as --help needs no SciPy

    return float(mannwhitneyu(first, second).statistic / (len(first) * len(second)))


def iqm(*cells: Floats, axis: int = -1) -> Any:
    """The mean of the middle half of all seeds of all cells."""
    from scipy.stats import trim_mean

    return trim_mean(np.concatenate(cells, axis=axis), 0.25, axis=axis)


def agreement(rates: Floats) -> tuple[float, float]:
    """Kendall's tau of the learners' order, on average: of two seeds, and of two halves."""
    from scipy.stats import kendalltau

    def tau(one: Sequence[int], other: Sequence[int]) -> float:
        means = (rates[:, list(own)].mean(axis=1) for own in (one, other))
        return float(kendalltau(*means).statistic)

    seeds = range(rates.shape[1])
    single = [tau([one], [other]) for one, other in combinations(seeds, 2)]
    halves = [
        tau(one, other)
        for one, other in combinations(combinations(seeds, len(seeds) // 2), 2)
        if not {*one} & {*other}
    ]
    return float(np.mean(single)), float(np.mean(halves))


def expected(cells: dict[str, Floats]) -> Iterator[tuple[str, str, str]]:
    """What was expected before the first training, what was found, and whether it came true."""
    number = {name: k for k, name in enumerate(LEARNERS)}

    def gain(first: str, second: str, cell: str) -> float:
        return float(100 * (cells[cell][number[first]] - cells[cell][number[second]]).mean())

    for first, second in ORDERED:
        own = cells["tie-nx2-10k"]
        chance = better(own[number[first]], own[number[second]])
        found = f"{gain(first, second, 'tie-nx2-10k'):+.1f} points, {100 * chance:.0f} % of pairs"
        yield f"{first} above {second}", found, "yes" if chance >= 0.9 else "no"
    for first, second, before, after in CHANGES:
        text = f"{first} above {second} at {before}, below at {after}"
        gains = [gain(first, second, cell) for cell in (before, after) if cell in cells]
        found = " and ".join(f"{one:+.1f} points" for one in gains)
        if len(gains) < 2:
            yield text, f"{found}; {after} isn't measured yet", "no" if gains[0] <= 0 else "open"
        else:
            yield text, found, "yes" if gains[0] > 0 > gains[1] else "no"


def five_seeds(cells: dict[str, Floats]) -> Iterator[str]:
    """Learners with several trainings: what is more than chance."""
    from scipy.stats import bootstrap

    if not cells:
        return
    for name, trained in cells.items():
        yield f"{name}: {trained.shape[1]} of {SEEDS} seeds are trained so far.\n"
    rng = np.random.default_rng(0)
    body = []
    for k, name in enumerate(LEARNERS):
        own = [rates[k] for rates in cells.values()]
        drawn = bootstrap(own, iqm, n_resamples=2000, method="percentile", rng=rng)
        low, high = (100 * end for end in drawn.confidence_interval)
        rates = (
            f"{100 * one.mean():.1f} ({100 * one.min():.0f} to {100 * one.max():.0f})"
            for one in own
        )
        body.append((100 * float(iqm(*own)), name, low, high, *rates))
    body.sort(reverse=True)
    head = ("learner", "IQM", "95 % interval", *(f"{name}, mean (worst to best)" for name in cells))
    lines = [
        (name, f"{middle:.1f}", f"{low:.1f} to {high:.1f}", *own)
        for middle, name, low, high, *own in body
    ]
    yield from table(head, lines)
    yield "\n![Share of trainings with at least a success rate, by learner](profile.svg)\n"
    order = [row[1] for row in body]
    yield "How often a training of the row is better than one of the column, in per cent:\n"
    chances = [
        [f"{100 * chance(cells, one, other):.0f}" * (one != other) for other in order]
        for one in order
    ]
    pairs = [(name, *own) for name, own in zip(order, chances, strict=True)]
    yield from table(("", *order), pairs)
    yield ""
    for name, trainings in cells.items():
        single, halves = agreement(trainings)
        yield (
            f"In {name}, Kendall's tau of the learners' order is {single:.2f} between two seeds,"
            f" and {halves:.2f} between two halves of the seeds.\n"
        )
    yield "Expected before the first training (`benchmarks/seeds.py`), and found:\n"
    yield from table(("expected", "found", "came true"), list(expected(cells)))
    yield ""


def chance(cells: dict[str, Floats], one: str, other: str) -> float:
    """The probability of improvement on average over cells."""
    rows = [(rates[LEARNERS.index(one)], rates[LEARNERS.index(other)]) for rates in cells.values()]
    return float(np.mean([better(*pair) for pair in rows]))


def profile(cells: dict[str, Floats]) -> str:
    """Performance profiles: the share of trainings whose rate is at least x."""
    lines = []
    for k, name in enumerate(LEARNERS if cells else ()):
        own = np.concatenate([rates[k] for rates in cells.values()])
        steps = [f"{40 + 4 * x:.0f},{220 - 200 * np.mean(own >= x / 100):.0f}" for x in range(101)]
        lines.append(
            f'<polyline fill="none" stroke="{COLOURS[k]}" stroke-width="2"'
            f' points="{" ".join(steps)}"/>'
            f'<text x="455" y="{30 + 22 * k}" fill="{COLOURS[k]}">{name}</text>'
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
    """For each cell of bench: random, the best learner, and what every learner fails on."""
    body, failed = [], dict[str, list[int]]()
    for task, nx in SETUPS:
        here = [row for row in rows if row.track[:3] == BENCH[:3]]
        own = [row for row in here if (row.result.task, row.result.nx) == (task, nx)]
        learners = [row for row in own if row.learner not in NO_LEARNERS]
        rates = {row.learner: 100 * row.result.success_rate for row in own}
        if not learners:
            continue
        best = max(learners, key=lambda row: row.result.success_rate)
        side = "goal" if task == "tie" else "start"  # the other one of tie is a plain loop
        tangled: dict[int, list[int]] = {}
        for row in learners:
            found = row.result.outcomes
            for state, done in zip(found[side], found["success"], strict=True):
                tangled.setdefault(state, []).append(done)
        failed[f"{task} {nx}"] = sorted(state for state, done in tangled.items() if not any(done))
        share = 100 * len(failed[f"{task} {nx}"]) / len(tangled)
        told = [f"{rates[name]:.1f}" if name in rates else "" for name in ("random", "expert")]
        shown = f"{100 * best.result.success_rate:.1f} ({best.learner})"
        body.append((f"{task} {nx}", *told, shown, len(learners), f"{share:.1f} of {len(tangled)}"))
    head = ("cell", "random", "expert", "best learner", "trainings", "all fail on, % of states")
    yield from table(head, body)
    yield ""
    for cell, states in failed.items():
        if states:
            yield f"{cell}, rows of `bench`: {', '.join(map(str, states[:MOST]))}\n"


def page(rows: Sequence[Row]) -> str:
    """docs/benchmark.md: the text, with tables in the places of its marks."""
    published = [(f"*{name}*", *own) for name, own in SUITE["published"].items()]
    parts = {
        "boards": boards(rows),
        "seeds": five_seeds(grid(rows)),
        "hard": hard_starts(rows),
        "published": table(("learner", *(f"{task} {nx}" for task, nx in SETUPS)), published),
    }
    text = TEXT.read_text(encoding="utf-8")
    for name, lines in parts.items():
        text = text.replace(f"<!-- {name} -->", "\n".join(lines).rstrip("\n"))
    return text


def readme(text: str, rows: Sequence[Row]) -> str:
    """README with the rates of the rows that have entries."""
    for begins, wanted in SHOWN.items():
        found: dict[tuple[str, int], list[float]] = {}
        for row in rows:
            if (row.learner, row.tier, row.track) == wanted:
                own = found.setdefault((row.result.task, row.result.nx), [])
                own.append(100 * row.result.success_rate)
        if not found:
            continue
        rates = {cell: f"{np.mean(own):.1f}".replace("100.0", "100") for cell, own in found.items()}
        cells = [
            ", ".join(rates.get((task, nx), "-") for nx in SUITE["nx"]) for task in SUITE["tasks"]
        ]
        cells = ["-" if not re.search(r"\d", cell) else cell for cell in cells]
        pattern = re.compile(rf"^({re.escape(begins)}[^|]*\|).*$", re.M)
        text, made = pattern.subn(rf"\1 {' | '.join(cells)} |", text)
        if made != 1:
            raise SystemExit(f"README.md has {made} rows that begin with {begins!r}")
    return text


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; 1 if a file differs")
    parser.add_argument("--entries", type=Path, default=ENTRIES, help="folder of entries")
    parser.add_argument("--root", type=Path, default=ROOT, help="folder of README.md and docs")
    given = parser.parse_args()
    rows = [row for path in sorted(given.entries.glob("*.h5")) for row in rows_of(path)]
    played = [
        (*row[:3], row.result.task, row.result.nx, *row.result.outcomes.values()) for row in rows
    ]
    for k, one in enumerate(played):
        if one in played[:k]:
            sys.exit(f"two entries of {one[0]}, {one[3]} nx {one[4]}, hold the same episodes")
    made = {
        "docs/benchmark.md": page(rows),
        "docs/profile.svg": profile(grid(rows)),
        "README.md": readme((given.root / "README.md").read_text(encoding="utf-8"), rows),
    }
    for name, text in made.items():
        path = given.root / name
        if path.is_file() and path.read_text(encoding="utf-8") == text:
            continue
        if given.check:
            sys.exit(f"{name} isn't what the entries make: run benchmarks/results.py")
        with atomic_write(path, overwrite=True) as part:
            part.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
