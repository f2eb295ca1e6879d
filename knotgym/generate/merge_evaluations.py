"""Merge the shards of one evaluation, made by `knotgym evaluate --shard i/n` in n files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common.atomic_files import atomic_write, require_output
from knotgym.common.configuration import read_json
from knotgym.common.errors import InvalidInput, one_line
from knotgym.generate.episodes.evaluate import as_text, totals
from knotgym.generate.episodes.results import Result
from knotgym.runs.intervals import cluster_interval
from knotgym.runs.shards import Shard

_OWN = ("success_rate", "interval", "episodes", "shard", "results")  # what differs between shards
_MEANS = ("mean_return", "planned_actions", "planning_seconds")


def merge_evaluations(files: Sequence[Path], out: Path, *, overwrite: bool = False) -> str:
    """Merge all shards of an evaluation, in any order; return a one-line summary.

    The file has the same outcomes, rates and intervals as an evaluation without shards.

    Raises:
        InvalidInput: shards are missing, given twice or of different evaluations, or a file isn't
            a shard of an evaluation.
        Occupied: the output exists.
    """
    require_output(out, folder=False, overwrite=overwrite)
    parts = sorted(map(_read, files), key=lambda part: part[0].number)
    first, *others = [
        {name: value for name, value in content.items() if name not in _OWN}
        for _, content, _ in parts
    ]
    numbers, of = [shard.number for shard, _, _ in parts], parts[0][0].of
    if any(other != first for other in others) or any(shard.of != of for shard, _, _ in parts):
        raise InvalidInput("these are not shards of one evaluation: their settings differ")
    if numbers != list(range(1, of + 1)):
        raise InvalidInput(
            f"all {of} shards are needed, each once; got {', '.join(map(str, numbers))}"
        )
    try:
        rows = zip(*(results for _, _, results in parts), strict=True)
        results = [_joined(row) for row in rows]
        content = {"version": first.pop("version"), **totals(results), **first}
    except InvalidInput:
        raise
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise InvalidInput(f"these results can't be merged: {one_line(error)}") from error
    with atomic_write(out, overwrite=overwrite) as temporary:
        text = as_text({**content, "results": [vars(one) for one in results]})
        temporary.write_text(text, encoding="utf-8")
    return f"{out}: {len(results)} results, merged from {of} shards"


def _read(file: Path) -> tuple[Shard, dict[str, Any], list[Result]]:
    content = read_json(file)
    try:
        shard = Shard(**content["shard"])
        return shard, content, [Result(**row) for row in content["results"]]
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidInput(f"{file} isn't a shard of `knotgym evaluate --shard`") from error


def _joined(parts: Sequence[Result]) -> Result:
    """The result of one setup, from those of all shards in order."""
    first = parts[0]
    setup: dict[str, Any] = {
        name: getattr(first, name) for name in ("policy", "task", "nx", "split", "action")
    }
    if any(getattr(part, name) != value for part in parts for name, value in setup.items()):
        raise InvalidInput("these are not shards of one evaluation: their rows differ")
    outcomes = {name: sum((part.outcomes[name] for part in parts), []) for name in first.outcomes}
    won = np.array(outcomes["success"], dtype=bool)
    episodes = [part.episodes for part in parts]
    if len(won) != sum(episodes):
        raise InvalidInput("a row of a shard has more or fewer outcomes than episodes")
    low, high = cluster_interval(outcomes["success"], outcomes["start"], outcomes["goal"])
    means: dict[str, Any] = {
        name: float(np.average([getattr(part, name) for part in parts], weights=episodes))
        for name in _MEANS
    }
    return Result(
        **setup,
        **means,
        episodes=len(won),
        successes=int(won.sum()),
        success_rate=float(won.mean()),
        low=low,
        high=high,
        steps=float(np.array(outcomes["steps"])[won].mean()) if won.any() else None,
        simulation_failures=sum(part.simulation_failures for part in parts),
        start_states=first.start_states,
        goal_states=first.goal_states,
        outcomes=outcomes,
    )
