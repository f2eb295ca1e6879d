"""The card (README.md) of a folder of states, and the counts shown in it."""

import json
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from knotgym.datasets.cards.citation import code_span, filled, plain
from knotgym.datasets.cards.fact_tables import state_tables, table
from knotgym.quality.limits import UNITS
from knotgym.states.schema import DRAWING, PLAY, RANDOM_WALK
from knotgym.states.split_names import STATE_SPLITS
from knotgym.states.splits import overlap
from knotgym.states.spread import spread_of
from knotgym.states.state_file import States
from knotgym.topology.gauss import GaussCode


def summary(states: States) -> dict[str, Any]:
    """Count the states of a file by nx, with their spread and the range of each quality measure, as
    JSON.
    """
    sources = Counter(states.source.get("policy", np.array([])).tolist())
    return {
        "states": len(states),
        "sources": dict(sorted(sources.items())),
        "nx": {str(nx): _counts(states, nx) for nx in sorted(set(states.nx.tolist()))},
        "quality": {
            name: {
                "unit": UNITS[name],
                "min": float(values.min()),
                "median": float(np.median(values)),
                "max": float(values.max()),
            }
            for name, values in states.quality.items()
            if len(values)
        },
    }


def card(states: States, report: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Write the card as Markdown, with the YAML front matter that Hugging Face reads.

    `report` is that of the manifest: source, existing codes, rejections, demonstrations.
    """
    facts = summary(states)
    tables = {name: one.markdown() for name, one in state_tables(facts, report).items()}
    columns = [
        (code_span(one.name), one.dtype, plain(one.unit), one.doc)
        for one in states.table.schema.columns
    ]
    return filled(
        "state_card.md",
        crossings=", ".join(facts["nx"]),
        count=len(states),
        knot=plain(report["knot"]),
        version=report["version"],
        mujoco=report["mujoco"],
        engine=states.engine,
        seed=config["seed"],
        holds=_holds(report),
        made=_made(report),
        **{name: tables.get(name, "") for name in ("states", "overlap", "quality", "spread")},
        rejected=tables.get("rejected", ""),
        columns=table(("column", "type", "unit", "contents"), columns),
        config=json.dumps(config, indent=1, sort_keys=True),
    )


def _made(report: Mapping[str, Any]) -> str:
    """Say how many candidates were made, and which codes have no state or no demonstration."""
    if report.get("source") in (PLAY, RANDOM_WALK):
        says = f"Frames of {report['attempts']} ropes were examined."
    else:
        passed = sum(len(codes) for codes in report["passed_over"].values())
        says = (
            f"{report['attempts']} drawings were made; {passed} codes were passed over"
            " (`passed_over` in `manifest.json`)."
        )
    lacking = report.get("undemonstrated", [])
    if lacking:
        named = ", ".join(code_span(code or "loop") for code in lacking)
        says += f"\n\nThe expert reached no goal of these codes: {named}."
    return says


_SOURCES = {
    DRAWING: (
        "They are drawn from their codes: a row's drawing is made again from its seed, laid in the"
        " simulator, stirred and left to rest by the row's actions."
    ),
    PLAY: (
        "They are frames of ropes that random and scripted policies pulled, those that are"
        " readable, not over-twisted and new. A row's actions lead from its start to its state. All"
        " frames of a rope are in one split."
    ),
    RANDOM_WALK: (
        "They are states as uniform random actions reach them, not selected to be easier to read;"
        " only over-twisted ones were left out. The actions of a row are drawn from its random"
        " stream. All frames of a rope are in one split."
    ),
}


def _holds(report: Mapping[str, Any]) -> str:
    """Say where the states come from, and what else is in the folder."""
    states = f"`states.h5` holds one row a state, at rest. {_SOURCES.get(report['source'], '')}"
    if not report.get("demonstrations"):
        return states
    return (
        f"{states} `minari/` holds demonstrations: {report['demonstrations']} episodes of the"
        " expert, each of which ends in the Gauss code of a state, its goal (train and test are"
        " datasets of their own). `knotgym.loaders.arrays(FOLDER)` loads those of the train split,"
        " and Minari finds all with `MINARI_DATASETS_PATH=FOLDER/minari`."
    )


def _counts(states: States, nx: int) -> dict[str, Any]:
    rows = np.flatnonzero(states.nx == nx)
    split = states.split[rows]
    codes = {name: set(states.gauss_code[rows[split == name]].tolist()) for name in STATE_SPLITS}
    shown = [GaussCode.parse(text) for text in states.gauss_code_chiral[rows]]
    signs = [sign for code in shown for sign in code.signs]
    actions: list[int] = []
    if "steps" in states.source:
        steps = states.source["steps"][rows]
        actions = [int(steps.min()), int(np.median(steps)), int(steps.max())]
    return {
        "states": len(rows),
        "codes": len(set(states.gauss_code[rows].tolist())),
        "codes_with_chirality": len(set(states.gauss_code_chiral[rows].tolist())),
        **{name: int((split == name).sum()) for name in STATE_SPLITS},
        "codes_in_both_splits": len(codes["train"] & codes["test"]),
        "positive_crossings": signs.count(1),
        "negative_crossings": signs.count(-1),
        "actions_to_reach": actions,
        "overlap": overlap(states, nx),
        "spread": spread_of(states.points[rows]),
    }
