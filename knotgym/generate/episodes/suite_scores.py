"""What files of `knotgym evaluate --out` say, as rows and as tables beside the published scores."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from knotgym.configuration import read_json
from knotgym.datasets.cards.state_card import table
from knotgym.errors import KnotgymError, one_line

TASKS, CROSSINGS = ("unknot", "tie", "convert"), (2, 3, 4)
# per cent on the train split, learners after a million steps; arXiv 2505.18028
PUBLISHED = {
    "random": (11.1, 8.4, 6.7, 35.9, 2.5, 1.4, 36.8, 9.2, 2.9),
    "DreamerV3": (93.3, 93.4, 89.3, 83.2, 16.1, 4.1, 71.5, 15.3, 5.4),
    "PPO": (65.7, 63.3, 37.0, 41.3, 3.3, 1.3, 47.7, 6.3, 4.7),
    "TD-MPC2": (71.3, 55.4, 50.3, 39.2, 4.6, 1.7, 40.8, 8.7, 3.8),
}
_KEY = ("policy", "states", "split", "task", "nx")


class InvalidScores(KnotgymError, ValueError):
    """Files that aren't evaluations, or that tell of one set-up twice."""


def read_scores(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """One row for each set-up of each evaluation, sorted: policy, states, split, task, nx,
    episodes, successes, success_rate, interval, steps, planned_actions, planning_seconds, seed,
    version; and `training`, where a learner's script says how it was trained.

    Raises:
        InvalidScores: a file can't be read, or two tell of the same.
    """
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for path in paths:
        try:
            rows = list(_rows(read_json(path)))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InvalidScores(
                f"{path} isn't a file of `knotgym evaluate --out`: {one_line(error)}"
            ) from error
        for row in rows:
            key = tuple(row[name] for name in _KEY)
            if key in found:
                raise InvalidScores(f"{path} tells once more of {', '.join(map(str, key))}")
            found[key] = row
    return [found[key] for key in sorted(found, key=str)]


def score_tables(rows: Sequence[Mapping[str, Any]], heading: str = "##") -> list[str]:
    """Lines of Markdown: for each set of states and split a table, learners by set-ups."""
    setups = [(task, nx) for task in TASKS for nx in CROSSINGS]
    head = ("policy", *(f"{task} {nx}" for task, nx in setups))
    lines: list[str] = []
    for states, split in dict.fromkeys((row["states"], row["split"]) for row in rows):
        own = [row for row in rows if (row["states"], row["split"]) == (states, split)]
        body: list[Sequence[object]] = []
        for policy in dict.fromkeys(row["policy"] for row in own):
            cells = {(row["task"], row["nx"]): row for row in own if row["policy"] == policy}
            told = [_cell(cells[setup]) if setup in cells else "" for setup in setups]
            body.append((policy, *told))
        body += [(f"*{policy}, published*", *told) for policy, told in PUBLISHED.items()]
        lines += ["", f"{heading} States {states}, {split} split", "", *table(head, body)]
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
            "seed": told["settings"]["seed"],
            "version": told["version"],
        }
        _cell(row)  # numbers where numbers belong
        yield {**row, "training": told["training"]} if "training" in told else row


def _cell(row: Mapping[str, Any]) -> str:
    low, high = row["interval"]
    rate = 100 * row["success_rate"]
    return f"**{rate:.1f}** ({100 * low:.0f} to {100 * high:.0f}, of {row['episodes']})"
