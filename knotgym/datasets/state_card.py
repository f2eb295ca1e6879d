"""The dataset card: what a folder of curated states holds, in prose and numbers."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from knotgym.datasets.states import States


def summary(states: States) -> dict[str, Any]:
    """Counts of a state file: by nx, code, chirality and split, and the spread of every quality
    measure; JSON-able.
    """
    out: dict[str, Any] = {"states": len(states), "nx": {}}
    for nx in sorted(set(states.nx.tolist())):
        rows = np.flatnonzero(states.nx == nx)
        split = Counter(states.split[rows].tolist())
        letters = Counter("".join(_letters(text) for text in states.gauss_code_chiral[rows]))
        steps = states.source["steps"][rows] if "steps" in states.source else None
        out["nx"][str(nx)] = {
            "states": len(rows),
            "codes": len(set(states.gauss_code[rows].tolist())),
            "codes_with_chirality": len(set(states.gauss_code_chiral[rows].tolist())),
            "train": split["train"],
            "test": split["test"],
            "codes_in_both_splits": len(
                _codes(states, rows, "train") & _codes(states, rows, "test")
            ),
            "positive_crossings": letters["c"],
            "negative_crossings": letters["a"],
            "actions_to_reach": (
                [] if steps is None else [int(steps.min()), int(np.median(steps)), int(steps.max())]
            ),
        }
    out["quality"] = {
        name: {
            "unit": states.units[name],
            "min": float(values.min()),
            "median": float(np.median(values)),
            "max": float(values.max()),
        }
        for name, values in states.quality.items()
        if len(values)
    }
    return out


def card(states: States, report: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """The card as Markdown, with the YAML head that Hugging Face reads.

    Args:
        states: of the folder.
        report: of the job: existing codes, rejections, actions; see `generate.output`.
        config: the whole configuration.
    """
    facts = summary(states)
    rows = [
        _row(
            nx,
            one["states"],
            f"{one['codes']} of {report['existing_codes'][nx]}",
            one["codes_with_chirality"],
            f"{one['train']} / {one['test']}",
            one["codes_in_both_splits"],
            f"{one['positive_crossings']} / {one['negative_crossings']}",
            " / ".join(map(str, one["actions_to_reach"])),
        )
        for nx, one in facts["nx"].items()
    ]
    quality = [
        _row(name, one["unit"], *(f"{one[key]:.3g}" for key in ("min", "median", "max")))
        for name, one in facts["quality"].items()
    ]
    rejected = [
        _row(nx, reason, count)
        for nx, reasons in report["rejected"].items()
        for reason, count in most_first(reasons)
    ]
    return "\n".join(
        [
            "---",
            "license: mit",
            "tags: [knot-theory, gauss-code, mujoco, offline-reinforcement-learning]",
            "---",
            "",
            f"# Rope states with {', '.join(facts['nx'])} crossings",
            "",
            (
                f"{len(states)} configurations of a closed rope in MuJoCo (knot type"
                f" {report['knot']}), each labelled with its Gauss code, made by `knotgym generate`"
                f" {report['version']} (MuJoCo {report['mujoco']}) with seed {config['seed']}."
                " `states.h5` holds one row a state, `minari/` the trajectories that lead from the"
                " start to each of them, `archive.h5` what the search found (`--archive` goes on"
                " from it), `gallery.png` shows all states, `manifest.json` lists checksums,"
                " configuration and counts. `knotgym dataset verify` recomputes every label and"
                " replays every trajectory."
            ),
            "",
            "## States",
            "",
            _row(
                "nx",
                "states",
                "codes, of those there are",
                "with chirality",
                "train / test",
                "codes in both",
                "crossings c / a",
                "actions, min / median / max",
            ),
            _row(*["---"] * 8),
            *rows,
            "",
            "## Quality",
            "",
            "| measure | unit | min | median | max |",
            "| --- | --- | --- | --- | --- |",
            *quality,
            "",
            "## Rejected",
            "",
            (
                f"{report['attempts']} instances were made, in {report['actions']} environment"
                " steps with the search. One can be rejected for several reasons."
            ),
            "",
            "| nx | reason | instances |",
            "| --- | --- | --- |",
            *rejected,
            "",
            *_grown(report),
            "## How to make it again",
            "",
            "```json",
            json.dumps(config, indent=1, sort_keys=True),
            "```",
            "",
        ]
    )


def _grown(report: Mapping[str, Any]) -> list[str]:
    found = growth(report)
    if not found:
        return []
    head = ["steps", *(f"nx {nx}: known / accepted" for nx in found[-1]["known"])]
    rows = [
        _row(one["steps"], *(f"{one['known'][nx]} / {one['accepted'][nx]}" for nx in one["known"]))
        for one in found
    ]
    said = "Codes known to the search, and states accepted, by environment steps."
    return ["## Growth", "", said, "", _row(*head), _row(*["---"] * len(head)), *rows, ""]


def growth(report: Mapping[str, Any], rows: int = 12) -> list[dict[str, Any]]:
    """So many rows of a job's growth, each at about the same multiple of the steps of the one
    before, the last among them.
    """
    found: list[dict[str, Any]] = report.get("growth", [])
    if len(found) <= rows:
        return found
    steps = np.array([one["steps"] for one in found])
    wanted = np.geomspace(steps[0], steps[-1], rows)
    return [found[k] for k in sorted({int(np.argmin(np.abs(steps - one))) for one in wanted})]


def most_first(counts: Mapping[str, int]) -> list[tuple[str, int]]:
    """Counts in falling order, then by name."""
    return sorted(counts.items(), key=lambda one: (-one[1], one[0]))


def _row(*cells: object) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def _letters(text: str) -> str:
    """One letter a crossing."""
    return "".join(sorted(letter for letter in text if letter in "ac"))[::2]


def _codes(states: States, rows: Any, split: str) -> set[str]:
    return {str(states.gauss_code[row]) for row in rows if states.split[row] == split}
