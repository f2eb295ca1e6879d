"""The card of a perception table: what its folder holds, in prose and numbers."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import knotgym
from knotgym.datasets.cards.citation import TO_CITE, plain
from knotgym.datasets.cards.state_card import table
from knotgym.datasets.image_table import GRADES, file_stem, read_table
from knotgym.datasets.splits import IMAGE_SPLITS

_TEXT = ("gauss_code", "gauss_code_chiral", "split", "grade")
_COUNTED = (*_TEXT, "nx", "accepted")

_COUNTS_HEAD = (
    "pictures",
    "codes",
    "with chirality",
    "fewest / most of a code",
    *IMAGE_SPLITS,
    "accepted",
    *GRADES,
)

_ROWS = """\
`image`: PNG, lossless. `gauss_code`, `gauss_code_chiral`: "1+,1-,2+,2-", "1+a,1-a,2+c,2-c", the \
walk from the white base bead towards red. `nx`: crossings. `knot`: type. `points`: 300 float64, \
bead by bead, metres. `crossings`: pixel x (right), y (down) of each, the places of the over and \
the under strand along the rope (beads, 2.25 is a quarter from bead 2 to bead 3), its sign; in \
order of first visit. `quality`: the measures of the configuration in the published 128 x 128 \
picture, whatever the row's own. `accepted`: it keeps to all limits of curated states. `grade`: \
how hard it is to read, by its worst measure in units of the limit for accepted states: easy from \
1.5, medium from 1, hard from 0.5, extreme below. `appearance`: how it was drawn. `source`: the \
walk in `walks.h5`, steps taken, rounds of opening up, and the symmetry applied then.

With colours "single" a picture shows the base bead and not the direction of the walk: the code of \
the reversed walk fits it too."""


def summary(path: str | Path) -> dict[str, Any]:
    """Counts of a perception table, JSON-able.

    By nx and by split: codes, grades, accepted pictures; and the spread of the measures.
    """
    rows = read_table(path, columns=[*_COUNTED, "quality", "appearance"])
    columns = {name: np.array(rows[name].to_pylist()) for name in _COUNTED}

    def counts_where(chosen: np.ndarray) -> dict[str, Any]:
        return _counts({name: column[chosen] for name, column in columns.items()})

    present = set(columns["split"].tolist())
    quality = rows["quality"].to_pylist()
    looks = rows["appearance"].to_pylist()
    sizes = Counter(look["size"] for look in looks)
    return {
        "pictures": len(rows),
        "nx": {
            str(nx): counts_where(columns["nx"] == nx) for nx in sorted(set(columns["nx"].tolist()))
        },
        "splits": {
            split: counts_where(columns["split"] == split)
            for split in IMAGE_SPLITS
            if split in present
        },
        "quality": {
            name: _spread([measures[name] for measures in quality])
            for name in (quality[0] if quality else ())
        },
        "sizes": {str(size): count for size, count in sorted(sizes.items())},
        "colours": dict(sorted(Counter(look["colours"] for look in looks).items())),
    }


def card(
    facts: Mapping[str, Any], config: Mapping[str, Any], report: Mapping[str, Any], size: int
) -> str:
    """The card as Markdown, with the YAML head that Hugging Face reads.

    Args:
        facts: the table's `summary`.
        config: the whole configuration.
        report: of the run: walks, frames, and the frames not taken by reason.
        size: of all files of the table, bytes.
    """
    paths = [(file_stem(split), f"data/{file_stem(split)}-*.parquet") for split in facts["splits"]]
    not_taken = plain(json.dumps({**report["dropped"], **report["refused"]}))
    lines = [
        "---",
        "license: cc-by-4.0",
        "tags: [knot-theory, gauss-code, mujoco, perception]",
        "task_categories: [image-to-text]",
        "configs:",
        "- config_name: default",
        "  data_files:",
        *(f"  - split: {split}\n    path: {path}" for split, path in paths),
        "---",
        "",
        f"# Pictures of ropes with {', '.join(facts['nx'])} crossings, and their Gauss codes",
        "",
        f"{facts['pictures']} pictures of a closed rope, {size / facts['pictures']:.0f} bytes each"
        f" with all labels, made by `knotgym images` {knotgym.__version__} (MuJoCo"
        f" {mujoco.__version__}) with seed {config['seed']}. `load_dataset(FOLDER)` of Hugging"
        " Face's datasets and `knotgym.loaders.images(FOLDER)` read them; `knotgym dataset verify"
        " FOLDER` recomputes every label, measure and picture and makes every walk again.",
        "",
        "## What a row holds",
        "",
        _ROWS,
        "",
        "## Splits",
        "",
        _about_splits(config),
        "",
        *table(("nx", *_COUNTS_HEAD), _counts_rows(facts["nx"])),
        "",
        *table(("split", *_COUNTS_HEAD), _counts_rows(facts["splits"])),
        "",
        "## Quality",
        "",
        *table(
            ("measure", "5 %", "median", "95 %"),
            [
                (plain(name), *(f"{value:.3g}" for value in spread))
                for name, spread in facts["quality"].items()
            ],
        ),
        "",
        *TO_CITE,
        "## How to make it again",
        "",
        f"{report['walks']} walks met {report['frames']} frames. Not taken: {not_taken}.",
        "",
        "```json",
        json.dumps(config, indent=1, sort_keys=True),
        "```",
        "",
    ]
    return "\n".join(lines)


def _about_splits(config: Mapping[str, Any]) -> str:
    return (
        "train and test differ in configuration: everything made from one state, its"
        " near-duplicates and their mirror images, reversals and renumberings stays in one split"
        " (walks from the plain loop are each on their own), and no two rows anywhere are"
        " near-duplicates. test-code shows codes that no other split but test-nx shows, a share of"
        f" {config['code_share']:g} of the codes with at least 2 crossings. test-nx shows more"
        f" crossings than training, {', '.join(map(str, config['test_nx'])) or 'none'}."
    )


def _counts(columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    codes = Counter(columns["gauss_code"].tolist())
    return {
        "pictures": len(columns["nx"]),
        "codes": len(codes),
        "codes_with_chirality": len(set(columns["gauss_code_chiral"].tolist())),
        "of_a_code": [min(codes.values()), max(codes.values())],
        "split": {split: int((columns["split"] == split).sum()) for split in IMAGE_SPLITS},
        "accepted": int(columns["accepted"].sum()),
        "grade": {grade: int((columns["grade"] == grade).sum()) for grade in GRADES},
    }


def _counts_rows(counts: Mapping[str, Mapping[str, Any]]) -> list[list[object]]:
    """A row of the card's table for each nx, or each split, in the order of _COUNTS_HEAD."""
    return [
        [
            name,
            count["pictures"],
            count["codes"],
            count["codes_with_chirality"],
            " / ".join(map(str, count["of_a_code"])),
            *count["split"].values(),
            count["accepted"],
            *count["grade"].values(),
        ]
        for name, count in counts.items()
    ]


def _spread(values: list[float]) -> list[float]:
    return [float(np.quantile(values, share)) for share in (0.05, 0.5, 0.95)]
