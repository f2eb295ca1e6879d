"""The card (README.md) of a folder of states, and the counts shown in it."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from knotgym.datasets.cards.citation import code_span, filled, plain
from knotgym.states.schema import COLUMNS, RANDOM_WALK, STATE_SPLITS
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
                "unit": states.units[name],
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

    `report` is that of the manifest: existing codes, rejections, actions, growth.
    """
    facts = summary(states)
    keys = ("min", "median", "max")
    quality = [
        (plain(name), plain(spread["unit"]), *(f"{spread[key]:.3g}" for key in keys))
        for name, spread in facts["quality"].items()
    ]
    rejected = [
        (nx, plain(reason), count)
        for nx, reasons in report["rejected"].items()
        for reason, count in most_first(reasons)
    ]
    columns = [
        (code_span(one.name), one.kind, plain(one.unit), one.doc)
        for one in COLUMNS
        if one.name in states.columns()
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
        holds=_holds(report, any(states.source.get("dataset", ()))),
        states=table(_STATES_HEAD, _states_rows(facts["nx"], report["existing_codes"])),
        overlap_columns=OVERLAP_SAYS[0].upper() + OVERLAP_SAYS[1:],
        overlap=table(OVERLAP_HEAD, overlap_rows(facts["nx"])),
        quality=table(("measure", "unit", "min", "median", "max"), quality),
        spread_columns=SPREAD_SAYS[0].upper() + SPREAD_SAYS[1:],
        spread=table(SPREAD_HEAD, spread_rows(facts["nx"])),
        made=_made(report),
        rejected=table(("nx", "reason", "rejected"), rejected),
        growth=_growth_section(report),
        columns=table(("column", "type", "unit", "contents"), columns),
        config=json.dumps(config, indent=1, sort_keys=True),
    )


def _made(report: Mapping[str, Any]) -> str:
    """Say how many candidates were made."""
    if report.get("source") == RANDOM_WALK:
        return (
            f"{report['attempts']} ropes were pulled at random, for {report['actions']} environment"
            " steps in total. A configuration can be rejected for several reasons."
        )
    passed = sum(len(codes) for codes in report["passed_over"].values())
    return (
        f"{report['attempts']} drawings were made, and {report['actions']} actions were simulated"
        " to find action sequences and follow them. A drawing can be rejected for several reasons."
        f" {passed} codes were passed over (`passed_over` in `manifest.json`)."
    )


def _holds(report: Mapping[str, Any], demonstrated: bool) -> str:
    """Say where the states come from, and what else is in the folder."""
    if report.get("source") == RANDOM_WALK:
        return (
            "`states.h5` holds one row per state, as uniform random actions reach them. No state"
            " was relaxed to be easier to read; only over-twisted ones were left out. The actions"
            " of a row are drawn from its random stream. States are stored at rest."
        )
    states = (
        "`states.h5` holds one row a state. Most are drawn from their codes: a row's drawing is"
        " made again from its seed, laid in the simulator, stirred and left to rest by the row's"
        " actions. Those of policy `play` are where an action sequence ended, at rest."
    )
    if not demonstrated:
        return states
    return (
        f"{states} `minari/` holds for each state an action sequence from the start to its Gauss"
        " code (train and test are datasets of their own): `knotgym.loaders.arrays(FOLDER)` loads"
        " those of the train split, and Minari finds all with `MINARI_DATASETS_PATH=FOLDER/minari`;"
        " `archive.h5` holds the action sequences found (`--archive` goes on from it)."
    )


_STATES_HEAD = (
    *("nx", "states", "codes, of all that exist", "with chirality", "train / test"),
    *("codes in both", "crossings c / a", "actions, min / median / max"),
)


def _states_rows(counts: Mapping[str, Any], existing: Mapping[str, int]) -> list[list[object]]:
    """Rows of the table of states, in the order of _STATES_HEAD."""
    rows = []
    for nx, count in counts.items():
        codes = f"{count['codes']} of {existing[nx] or 'very many'}"
        splits = f"{count['train']} / {count['test']}"
        signs = f"{count['positive_crossings']} / {count['negative_crossings']}"
        actions = " / ".join(map(str, count["actions_to_reach"]))
        chiral, both = count["codes_with_chirality"], count["codes_in_both_splits"]
        rows.append([nx, count["states"], codes, chiral, splits, both, signs, actions])
    return rows


def _growth_section(report: Mapping[str, Any]) -> list[str]:
    """Lines of the section on growth, which drawn and random-walk states don't have."""
    rows = growth(report)
    if not rows:
        return []
    return [
        "## Growth",
        "",
        "Codes with an action sequence, and states accepted, by simulated actions.",
        "",
        *table(
            ("steps", *(f"nx {nx}: known / accepted" for nx in rows[-1]["known"])),
            [(row["steps"], *known_and_accepted(row)) for row in rows],
        ),
    ]


SPREAD_HEAD = ("nx", "apart", "shapes", "gyration", "height", "visits", "bare")
SPREAD_SAYS = (
    "apart: mm, median / min distance of two states (root mean square over the beads, after the"
    " best rotation about z); shapes: the same, minimized over base bead and direction too;"
    " gyration: mm, min / max radius of gyration; height: mm, min / max from the lowest to the"
    " highest bead; visits: beads, mean"
    " distance along the rope between crossings of two states, 25 for random positions; bare:"
    " beads, longest stretch where no state has a crossing"
)


OVERLAP_HEAD = ("nx", "test states", "code in train", "diagram in train", "nearest, mm")
OVERLAP_SAYS = (
    "code in train: test states whose code (without chirality) some train state has; diagram in"
    " train: test states whose code some train state has up to symmetry (another base bead, the"
    " other direction, mirrored or switched); nearest: the smallest distance from a test state to a"
    " train state of any nx, root mean square over the beads, minimized over those symmetries and"
    " rotations about z"
)


def overlap_rows(counts: Mapping[str, Any]) -> list[list[str]]:
    """Overlap of train and test for each nx of a summary, in the order of OVERLAP_HEAD."""
    rows = []
    for nx, count in counts.items():
        found = count["overlap"]
        near = "-" if found["nearest"] is None else f"{1000 * found['nearest']:.1f}"
        shared = [str(found[name]) for name in ("test_states", "code_in_train", "diagram_in_train")]
        rows.append([nx, *shared, near])
    return rows


def spread_rows(counts: Mapping[str, Any]) -> list[list[str]]:
    """Spread of the states for each nx of a summary, in the order of SPREAD_HEAD."""

    def millimetres(values: Sequence[float] | None) -> str:
        return " / ".join(f"{round(1000 * value, 1):.3g}" for value in values or ()) or "-"

    rows = []
    for nx, count in counts.items():
        found = count["spread"]
        lengths = (millimetres(found[name]) for name in ("distance", "shape", "gyration", "height"))
        beads = (
            "-" if found[name] is None else f"{found[name]:.1f}" for name in ("visits", "bare")
        )
        rows.append([nx, *lengths, *beads])
    return rows


def growth(report: Mapping[str, Any], rows: int = 12) -> list[dict[str, Any]]:
    """Thin a run's growth to `rows` rows, geometrically spaced in steps; the last one is kept."""
    every: list[dict[str, Any]] = report.get("growth", [])
    if len(every) <= rows:
        return every
    steps = np.array([row["steps"] for row in every])
    wanted = np.geomspace(steps[0], steps[-1], rows)
    return [every[k] for k in sorted({int(np.argmin(np.abs(steps - at))) for at in wanted})]


def known_and_accepted(row: Mapping[str, Any]) -> list[str]:
    """Format codes known and states accepted for each nx of a row of `growth`."""
    return [f"{row['known'][nx]} / {row['accepted'][nx]}" for nx in row["known"]]


def most_first(counts: Mapping[str, int]) -> list[tuple[str, int]]:
    """Sort counts in decreasing order, then by name."""
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))


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
        "spread": spread_of(states.points[rows]).as_json(),
    }


def table_row(*cells: object) -> str:
    """Format one row of a Markdown table.

    >>> table_row("nx", 3)
    '| nx | 3 |'
    """
    return "| " + " | ".join(map(str, cells)) + " |"


def table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> list[str]:
    """Format a Markdown table; return its lines."""
    return [table_row(*one) for one in (head, ["---"] * len(head), *rows)]
