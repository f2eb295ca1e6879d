"""The card of a folder of states, and what else tells of them: tables of facts and a gallery."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common import Counts
from knotgym.datasets.card_texts import (
    TABLES,
    CardTable,
    code_span,
    counted,
    filled_card,
    measured,
    plain,
    write_text,
)
from knotgym.datasets.manifest import write_manifest
from knotgym.datasets.png import Tile, contact_sheet, sample
from knotgym.rendering import draw_diagram
from knotgym.states import SOURCES, SPLITS, STATE_SPLITS, Spectra, States
from knotgym.topology import GaussCode

MOST_STATES = 400  # in a gallery
_SPLITS = {name: ("split", name) for name, split in SPLITS.items() if split.of_states}


def finish(
    folder: Path, report: Mapping[str, Any], request: Mapping[str, Any], states: States
) -> None:
    """Write gallery, card and manifest into a folder that has states and demonstrations.

    Args:
        report: the run's counts: source, existing codes, rejections, demonstrations.
        request: what was asked for: configuration, sources, versions.
        states: those in the folder.
    """
    write_gallery(folder / "gallery.png", states)
    write_text(folder / "README.md", _state_card(states, report, request["config"]))
    write_manifest(folder, "knotgym-manifest", request, report)


def state_tables(states: States, report: Mapping[str, Any]) -> dict[str, CardTable]:
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
    count, more, rows = counted("states", states.table, _SPLITS), TABLES["states"], []
    for nx, row in zip(numbers, count.rows, strict=True):
        codes = map(GaussCode.parse, states.gauss_code_chiral[states.nx == nx].tolist())
        signs = Counter(sign for code in codes for sign in code.signs)
        rows.append((*row, existing.get(str(nx), "?") or "many", f"{signs[1]} / {signs[-1]}"))
    head, says = (*count.head, *more["head"]), f"{count.says}; {more['says']}"
    listed = (
        CardTable("states", head, rows, says),
        CardTable.of("train and test", [_overlap(states, nx) for nx in numbers]),
        measured(states.measures),
        CardTable.of("rejected", rejected, attempts=report.get("attempts")),
    )
    return {table.title: table for table in listed}


def _state_card(states: States, report: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the card as Markdown, with the YAML front matter that Hugging Face reads."""
    lacking = ", ".join(code_span(code or "loop") for code in report.get("undemonstrated", []))
    return filled_card(
        "state_card.md",
        state_tables(states, report),
        config,
        crossings=", ".join(map(str, sorted(set(states.nx.tolist())))),
        count=len(states),
        knot=plain(report["knot"]),
        engine=states.engine,
        source=plain(report["source"]),
        sources="\n".join(
            f"- `{name}`: {SOURCES[name].doc}"
            for name in np.unique(states.source["policy"]).tolist()
        ),
        passed=sum(map(len, report.get("passed_over", {}).values())),
        demonstrations=report.get("demonstrations", 0),
        lacking=lacking and f"The expert reached no goal of these codes: {lacking}.",
        columns=states.table.schema.page(),
    )


def _overlap(states: States, nx: int) -> tuple[object, ...]:
    train, test = (states.rows(nx, split) for split in STATE_SPLITS)
    known, asked = (
        (states.gauss_code[rows].tolist(), states.diagrams(rows)) for rows in (train, test)
    )
    every, near = np.flatnonzero([SPLITS[split].trains for split in states.split]), "-"
    if len(test) and len(every):
        apart, _ = Spectra.of(states.points[test]).nearest(Spectra.of(states.points[every]))
        near = f"{1000 * apart.min():.1f}"
    pairs = zip(asked, known, strict=True)
    shared = [sum(form in {*seen} for form in forms) for forms, seen in pairs]
    return nx, len(test), *shared, near


def write_gallery(path: Path, states: States) -> None:
    """Write the contact sheet of states as a PNG."""
    path.write_bytes(contact_sheet(state_tiles(states)))


def state_tiles(states: States) -> list[Tile]:
    """Return the knot diagrams of states, sorted by crossings, code and split.

    Of more than MOST_STATES they are a sample, even over crossings and splits.
    """
    kinds = [*zip(states.nx.tolist(), states.split.tolist(), strict=True)]
    order = sorted(
        sample(kinds, MOST_STATES),
        key=lambda i: (states.nx[i], states.gauss_code[i], not SPLITS[states.split[i]].trains),
    )
    captions = (
        (states.gauss_code_chiral[i] or "loop", f"nx {states.nx[i]}  {states.split[i]}  row {i}")
        for i in order
    )
    told = Counts.over(order, "drawing diagrams")
    return [
        Tile(draw_diagram(states.points[i]), words) for i, words in zip(told, captions, strict=True)
    ]
