"""Compare results: the difference of success rates, with its interval.

Episode i of a seed begins alike for every policy, so results of one cell and seed are compared
episode by episode. What makes a start hard then cancels, and the interval is narrower.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from knotgym.common import InvalidFile, InvalidInput, Mark, from_json, one_line, require_regular
from knotgym.generate.entries import read_entry, states_digests
from knotgym.generate.episode_configs import EvaluateConfig
from knotgym.generate.results import Result, evaluation_in
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
        for one, faults in entry.recounted():
            if faults:
                raise InvalidFile(f"{path}: {faults[0]}")
            results.append(one)
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
        with evaluation_in(path) as (content, results):
            config = from_json(EvaluateConfig, content["config"])
            digests = dict((content["source"] or {}).get("states", {}))
            engine = str(content.get("engine", ""))
    rules = Mark.values(config.task, "rules", "physics") | {"states": sorted(digests.values())}
    own = ({name: getattr(one, name) for name in ("task", "nx", "split")} for one in results)
    cells = [json.dumps([*(rules | one).items()]) for one in own]
    return [
        _Score(path, cell, config.seed, config.protocol, engine, one)
        for cell, one in zip(cells, results, strict=True)
    ]


def _difference(one: _Score, base: _Score) -> tuple[Difference, bool]:
    """Return how much higher a success rate is than another in its cell, and whether episodes were
    paired: they are if both have the same seed, and so the same starts.
    """
    outcomes = one.result.outcomes, base.result.outcomes
    sides = [(own["success"], [own["start"], own["goal"]]) for own in outcomes]
    n = min(len(success) for success, _ in sides)
    drawn = [[rows[:n] for rows in clusters] for _, clusters in sides]
    if one.seed != base.seed or drawn[0] != drawn[1]:
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
    scores, cells = [one for path in paths for one in _scores_in(path)], dict[str, list[_Score]]()
    for one in scores:
        cells.setdefault(one.cell, []).append(one)
    if all(len(own) < 2 for own in cells.values()):
        raise InvalidInput("no two results are of the same task, nx, split, states and engine")
    for own in filter(lambda own: len(own) > 1, cells.values()):
        base, engines = own[0], {one.engine: one.file for one in own if one.engine}
        if len(engines) > 1:
            which = ", ".join(f"{file} {digest}" for digest, file in engines.items())
            raise InvalidInput(one_line(f"engines that do otherwise played these results: {which}"))
        found = [_difference(one, base) for one in own[1:]]
        table = narrow_table(
            ("policy", "success", "difference", "better"),
            title=f"{base.result.task} nx {base.result.nx}, {base.result.split}, protocol"
            f" {' or '.join(sorted({one.protocol or 'none' for one in own}))}, against"
            f" {_name(base, own)}",
            left=("policy",),
        )
        table.add_row(_name(base, own), f"{100 * base.result.success_rate:.1f} %", "", "")
        for one, (gained, _) in zip(own[1:], found, strict=True):
            mean, low, high, better = (100 * part for part in gained)
            table.add_row(
                _name(one, own),
                f"{100 * one.result.success_rate:.1f} %",
                f"{mean:+.1f} ({low:+.1f} to {high:+.1f})",
                f"{better:.0f} %",
            )
        console.print(table)
        paired = sum(is_paired for _, is_paired in found)
        console.print(f"{paired} of {len(found)} paired by episode", highlight=False)


def _name(one: _Score, others: Sequence[_Score]) -> str:
    """Name a policy; where another has that name its file or folder, too."""
    same = [other for other in others if other.result.policy == one.result.policy]
    if len(same) < 2:
        return one_line(one.result.policy)
    files = {other.file for other in same}
    ways = (lambda file: file.stem), (lambda file: file.name), (lambda file: file.parent.name), str
    way = next(way for way in ways if len({*map(way, files)}) == len(files))
    return one_line(f"{one.result.policy}, {way(one.file)}")
