"""Compare results: the difference of success rates, with its interval.

Episode i of a seed begins alike for every policy, so results of one cell and seed are compared
episode by episode. What makes a start hard then cancels, and the interval is narrower.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from knotgym.common import InvalidFile, InvalidInput, Mark, one_line, require_regular
from knotgym.generate.entries import read_entry, states_digests
from knotgym.generate.results import Result, read_evaluation
from knotgym.rope import ENGINES
from knotgym.runs import Difference, narrow_table


class _Score(NamedTuple):
    """A result and what it may be compared with.

    Attributes:
        file: that it is from.
        cell: settings that must be the same in what it is compared with, as text.
        seed: of the evaluation.
        protocol: of the evaluation.
        engine: digest of what the engine did; "" if the file doesn't say it.
        result: the result.
    """

    file: Path
    cell: str
    seed: int
    protocol: str
    engine: str
    result: Result


def _scores_in(path: Path) -> list[_Score]:
    """Return the results in an entry, which is replayed, or in a file of `evaluate --out`.

    Raises:
        InvalidFile: it is neither, or an entry doesn't replay.
    """
    results = list[Result]()
    if entry := read_entry(path):
        for result, faults in entry.recounted():
            if faults:
                raise InvalidFile(f"{path}: {faults[0]}")
            results.append(result)
        config, digests = entry.config, states_digests(entry.config)
        engine = ENGINES[config.task.engine].behaviour()  # which played it again
    else:
        require_regular(path, "file")
        with open(path, "rb") as file:
            if file.read(1) != b"{":
                raise InvalidFile(
                    f"{path} is neither an entry of `knotgym evaluate --record` nor a file of --out"
                    ", or it is damaged"
                )
        config, results, digests, engine, _ = read_evaluation(path)
    rules = Mark.values(config.task, "rules", "physics") | {"states": sorted(digests.values())}
    scores = []
    for result in results:
        cell = str(rules | {"task": result.task, "nx": result.nx, "split": result.split})
        scores.append(_Score(path, cell, config.seed, config.protocol, engine, result))
    return scores


def _difference(score: _Score, base: _Score) -> tuple[Difference, bool]:
    """Return how much higher a success rate is than another in its cell, and whether episodes were
    paired: they are if both have the same seed, and so the same starts.
    """
    outcomes = score.result.outcomes, base.result.outcomes
    sides = [(outcome["success"], [outcome["start"], outcome["goal"]]) for outcome in outcomes]
    n = min(len(success) for success, _ in sides)
    drawn = [[rows[:n] for rows in clusters] for _, clusters in sides]
    if score.seed != base.seed or drawn[0] != drawn[1]:
        return Difference.between(*sides), False
    gained = np.subtract(sides[0][0][:n], sides[1][0][:n])
    return Difference.between((gained, drawn[1])), True


def compare(paths: Sequence[Path], console: Console) -> None:
    """Print, for each cell, how much higher success rates are than that of its first result.

    Args:
        paths: entries and files of `evaluate --out`.
        console: where to print.

    Raises:
        InvalidFile: an entry doesn't replay, or a file is neither.
        InvalidInput: no two results are of one cell, or engines that do otherwise played some.
    """
    cells = dict[str, list[_Score]]()
    for path in paths:
        for score in _scores_in(path):
            cells.setdefault(score.cell, []).append(score)
    if all(len(group) < 2 for group in cells.values()):
        raise InvalidInput("no two results are of the same task, nx, split, states and engine")
    for group in filter(lambda group: len(group) > 1, cells.values()):
        base, engines = group[0], {score.engine: score.file for score in group if score.engine}
        if len(engines) > 1:
            which = ", ".join(f"{file} {digest}" for digest, file in engines.items())
            raise InvalidInput(one_line(f"engines that do otherwise played these results: {which}"))
        differences = [_difference(score, base) for score in group[1:]]
        names, cell = [_name(score, group) for score in group], base.result
        protocols = " or ".join(sorted({score.protocol or "none" for score in group}))
        title = f"{cell.task} nx {cell.nx}, {cell.split}, protocol {protocols}, against {names[0]}"
        columns = "policy", "success", "difference", "better"
        table = narrow_table(columns, title=title, left=columns[:1])
        rates = [f"{100 * score.result.success_rate:.1f} %" for score in group]
        table.add_row(names[0], rates[0], "", "")
        for name, rate, (gained, _) in zip(names[1:], rates[1:], differences, strict=True):
            mean, low, high, better = (100 * part for part in gained)
            gain = f"{mean:+.1f} ({low:+.1f} to {high:+.1f})"
            table.add_row(name, rate, gain, f"{better:.0f} %")
        console.print(table)
        paired = sum(is_paired for _, is_paired in differences)
        console.print(f"{paired} of {len(differences)} paired by episode", highlight=False)


def _name(score: _Score, others: Sequence[_Score]) -> str:
    """Name a policy; where another has that name its file or folder, too."""
    same = [other for other in others if other.result.policy == score.result.policy]
    if len(same) < 2:
        return one_line(score.result.policy)
    files = {other.file for other in same}
    ways = (lambda file: file.stem), (lambda file: file.name), (lambda file: file.parent.name), str
    way = next(way for way in ways if len({*map(way, files)}) == len(files))
    return one_line(f"{score.result.policy}, {way(score.file)}")
