"""What files of `knotgym evaluate --out` say, as rows and as tables beside the published scores."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any

from knotgym.configuration import as_json, read_json
from knotgym.datasets.cards.citation import plain
from knotgym.datasets.cards.state_card import table
from knotgym.errors import KnotgymError, one_line
from knotgym.runs.intervals import wilson
from knotgym.tasks import TaskConfig

TASKS, CROSSINGS = ("unknot", "tie", "convert"), (2, 3, 4)
# per cent on the train split, learners after a million steps; arXiv 2505.18028
PUBLISHED = {
    "random": (11.1, 8.4, 6.7, 35.9, 2.5, 1.4, 36.8, 9.2, 2.9),
    "DreamerV3": (93.3, 93.4, 89.3, 83.2, 16.1, 4.1, 71.5, 15.3, 5.4),
    "PPO": (65.7, 63.3, 37.0, 41.3, 3.3, 1.3, 47.7, 6.3, 4.7),
    "TD-MPC2": (71.3, 55.4, 50.3, 39.2, 4.6, 1.7, 40.8, 8.7, 3.8),
}
_KEY = ("policy", "states", "split", "task", "nx")


# what else may differ between files whose episodes are counted together
_OWN = ("episodes", "successes", "success_rate", "interval", "steps", "seeds", "training")
_SUM = "weights_sha256"  # in what a file says of training
_MEANS = ("planned_actions", "planning_seconds")
# rules that a file doesn't name are of later versions, whose defaults are what there was before
_PLAIN = as_json(TaskConfig(task="tie"))


class InvalidScores(KnotgymError, ValueError):
    """Files that aren't evaluations, or that tell of the same episodes twice."""


def read_scores(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """One row for each set-up of each evaluation, sorted: policy, states, split, task, nx,
    episodes, successes, success_rate, interval, steps, planned_actions, planning_seconds, seeds,
    rules, version; and `training`, what a file says of how a learner was trained. Files of one
    set-up with different seeds are counted together.

    Raises:
        InvalidScores: a file can't be read, or two tell of the same episodes, or of one set-up with
            different rules or weights.
    """
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for path in paths:
        try:
            rows = list(_rows(read_json(path)))
        except (OSError, ArithmeticError, KeyError, ValueError, TypeError, AttributeError) as error:
            raise InvalidScores(
                f"{path} isn't a file of `knotgym evaluate --out`: {one_line(error)}"
            ) from error
        for row in rows:
            key = tuple(row[name] for name in _KEY)
            if key in found:
                before = found[key]
                if set(before["seeds"]) & set(row["seeds"]):
                    raise InvalidScores(f"{path} tells once more of {', '.join(map(str, key))}")
                weights = {before["training"].get(_SUM, ""), row["training"].get(_SUM, "")} - {""}
                if _same(row) != _same(before) or len(weights) > 1:
                    raise InvalidScores(
                        f"{path} tells of {', '.join(map(str, key))} by other rules, another"
                        " version or other weights than a file before it"
                    )
                row = _together(before, row)
            found[key] = row
    return [found[key] for key in sorted(found, key=str)]


def score_tables(rows: Sequence[Mapping[str, Any]], heading: str = "##") -> list[str]:
    """Lines of Markdown: for each set of states and split a table, learners by set-ups."""
    setups = [(task, nx) for task in TASKS for nx in CROSSINGS]
    head = ("policy", *(f"{task} {nx}" for task, nx in setups), "trained for, s")
    lines: list[str] = []
    for states, split in dict.fromkeys((row["states"], row["split"]) for row in rows):
        own = [row for row in rows if (row["states"], row["split"]) == (states, split)]
        body: list[Sequence[object]] = []
        for policy in dict.fromkeys(row["policy"] for row in own):
            cells = {(row["task"], row["nx"]): row for row in own if row["policy"] == policy}
            told = [_cell(cells[setup]) if setup in cells else "" for setup in setups]
            trained = {row["training"].get("seconds") for row in cells.values()} - {None}
            body.append((plain(policy), *told, "; ".join(map(_seconds, sorted(trained)))))
        body += [(f"*{policy}, published*", *told, "") for policy, told in PUBLISHED.items()]
        lines += [
            "",
            f"{heading} States {plain(states)}, {plain(split)} split",
            "",
            *table(head, body),
        ]
    return lines


def _rows(told: Mapping[str, Any]) -> Iterable[dict[str, Any]]:
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
            "seeds": [told["settings"]["seed"]],
            "rules": {
                name: rule
                for name, rule in {**_PLAIN, **told["settings"]["task"]}.items()
                if name not in ("task", "nx", "split", "states")
            },
            "version": told["version"],
        }
        _cell(row)  # numbers where numbers belong
        for name, kind in {**dict.fromkeys(_KEY, str), "nx": int}.items():
            if type(row[name]) is not kind or not str(row[name]).isprintable():
                raise InvalidScores(f"{name} is {row[name]!r}")
        learned = told.get("learners", {}).get(one["policy"], {})
        training = dict(told.get("training", learned))
        if not isinstance(training.get("seconds"), Real | None):
            raise InvalidScores(f"seconds is {training['seconds']!r}")
        _seconds(training.get("seconds") or 0)
        yield {**row, "training": training}


def _same(row: Mapping[str, Any]) -> dict[str, Any]:
    """What must be the same in rows that are counted together."""
    return {name: value for name, value in row.items() if name not in (*_OWN, *_MEANS)}


def _together(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """One row of the episodes of two."""
    episodes, successes = (one[name] + other[name] for name in ("episodes", "successes"))
    steps = sum((row["steps"] or 0) * row["successes"] for row in (one, other))
    return {
        **one,
        "episodes": episodes,
        "successes": successes,
        "success_rate": successes / episodes,
        "interval": list(wilson(successes, episodes)),
        "steps": steps / successes if successes else None,
        "training": one["training"] or other["training"],
        "seeds": sorted([*one["seeds"], *other["seeds"]]),
        **{
            name: sum(row[name] * row["episodes"] for row in (one, other)) / episodes
            for name in _MEANS
        },
    }


def _cell(row: Mapping[str, Any]) -> str:
    low, high = row["interval"]
    rate = 100 * row["success_rate"]
    return f"**{rate:.1f}** ({100 * low:.0f} to {100 * high:.0f}, of {row['episodes']})"


def _seconds(value: float) -> str:
    return f"{value:,.0f}"
