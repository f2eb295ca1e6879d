"""The card (README.md) of a folder of states, and the tables of facts shown in it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.datasets.cards.citation import code_span, filled, plain, write_text
from knotgym.datasets.cards.fact_tables import CardTable, counted, measured
from knotgym.datasets.gallery import state_tiles, write_gallery
from knotgym.datasets.manifest import write_manifest
from knotgym.states import STATE_SPLITS, States, overlap, source_of, spread_of
from knotgym.topology import GaussCode


def state_card_tables(states: States, report: Mapping[str, Any]) -> dict[str, CardTable]:
    """Return the tables of facts about states by name.

    `report` is that of the manifest; {} for states without one.
    """
    numbers = sorted(set(states.nx.tolist()))
    existing = report.get("existing_codes", {})
    rejected = [
        (nx, reason, count)
        for nx, reasons in report.get("rejected", {}).items()
        for reason, count in sorted(reasons.items(), key=lambda item: (-item[1], item[0]))
    ]
    found = counted("states", states.table, {name: ("split", name) for name in STATE_SPLITS})
    listed = (
        found._replace(
            head=(*found.head, "of", "c / a"),
            rows=[
                (*row, *_more(states, nx, existing))
                for nx, row in zip(numbers, found.rows, strict=True)
            ],
            says=f"{found.says}; of: existing codes; c / a: positive and negative crossings",
        ),
        CardTable(
            "train and test",
            ("nx", "test states", "code in train", "diagram in train", "nearest, mm"),
            [_overlap(states, nx) for nx in numbers],
            "code in train: test states whose code (without chirality) some train state has;"
            " diagram in train: test states whose code some train state has up to symmetry (another"
            " base bead, the other direction, mirrored or switched); nearest: the smallest distance"
            " from a test state to a train state of any nx, root mean square over the beads,"
            " minimized over those symmetries and rotations about z",
        ),
        CardTable(
            "spread",
            ("nx", "apart", "shapes", "gyration", "height", "visits", "bare"),
            [_spread(states, nx) for nx in numbers],
            "apart: mm, median / min distance of two states (root mean square over the beads, after"
            " the best rotation about z); shapes: the same, minimized over base bead and direction"
            " too; gyration: mm, min / max radius of gyration; height: mm, min / max from the"
            " lowest to the highest bead; visits: beads, mean distance along the rope between"
            " crossings of two states, 25 for random positions; bare: beads, longest stretch where"
            " no state has a crossing",
        ),
        measured(states.measures),
        CardTable(
            "rejected",
            ("nx", "reason", "rejected"),
            rejected,
            f"{report.get('attempts')} drawings or ropes were tried; one can have several reasons",
            left=("reason",),
        ),
    )
    return {one.title: one for one in listed}


def finish_states(
    folder: Path, states: States, report: Mapping[str, Any], request: Mapping[str, Any]
) -> None:
    """Write gallery, card and manifest into a folder that has the states and demonstrations.

    Args:
        report: the run's counts: source, existing codes, rejections, demonstrations.
        request: what was asked for: configuration, sources, versions.
    """
    write_gallery(folder / "gallery.png", state_tiles(states))
    write_text(folder / "README.md", _card(states, report, request["config"]))
    write_manifest(folder, "knotgym-manifest", request, report)


def _card(states: States, report: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the card as Markdown, with the YAML front matter that Hugging Face reads."""
    found = {name: one.markdown() for name, one in state_card_tables(states, report).items()}
    return filled(
        "state_card.md",
        crossings=", ".join(map(str, sorted(set(states.nx.tolist())))),
        count=len(states),
        knot=plain(report["knot"]),
        version=report["version"],
        mujoco=report["mujoco"],
        engine=states.engine,
        seed=config["seed"],
        source=plain(report["source"]),
        sources="\n".join(
            f"- `{name}`: {source_of(name).doc}"
            for name in np.unique(states.source["policy"]).tolist()
        ),
        passed=sum(map(len, report.get("passed_over", {}).values())),
        demonstrations=report.get("demonstrations", 0),
        lacking=_lacking(report),
        **{name.replace(" ", "_"): text for name, text in found.items()},
        columns=states.table.schema.page(),
        config=json.dumps(config, indent=1, sort_keys=True),
    )


def _lacking(report: Mapping[str, Any]) -> str:
    """Say which codes have no demonstration."""
    found = ", ".join(code_span(code or "loop") for code in report.get("undemonstrated", []))
    return found and f"The expert reached no goal of these codes: {found}."


def _more(states: States, nx: int, existing: Mapping[str, Any]) -> tuple[object, ...]:
    codes = states.gauss_code_chiral[states.nx == nx].tolist()
    signs = [sign for code in codes for sign in GaussCode.parse(code).signs]
    return existing.get(str(nx), "?") or "many", f"{signs.count(1)} / {signs.count(-1)}"


def _overlap(states: States, nx: int) -> tuple[object, ...]:
    found = overlap(states, nx)
    near = "-" if found["nearest"] is None else f"{1000 * found['nearest']:.1f}"
    return nx, found["test_states"], found["code_in_train"], found["diagram_in_train"], near


def _spread(states: States, nx: int) -> tuple[object, ...]:
    found = spread_of(states.points[states.nx == nx])
    lengths = (found[name] or () for name in ("distance", "shape", "gyration", "height"))
    beads = (found[name] for name in ("visits", "bare"))
    return (
        nx,
        *(" / ".join(f"{round(1000 * one, 1):.3g}" for one in pair) or "-" for pair in lengths),
        *("-" if one is None else f"{one:.1f}" for one in beads),
    )
