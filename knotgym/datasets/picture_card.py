"""The card of a table of pictures, and what else tells of it: tables of facts, and Croissant."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.datasets.card_texts import (
    TABLES,
    CardTable,
    counted,
    filled_card,
    measured,
    plain,
    write_text,
)
from knotgym.datasets.croissant import write_croissant
from knotgym.datasets.image_table import file_stem, marks_base, measures_of, read_table, shards
from knotgym.datasets.manifest import write_manifest
from knotgym.quality import GRADES
from knotgym.rendering import APPEARANCES
from knotgym.states import IMAGE_SPLITS

_COUNTED = ("gauss_code", "gauss_code_chiral", "split", "grade", "nx", "accepted")
_SPLITS = {name: ("split", name) for name in IMAGE_SPLITS}
_GRADES = {name: ("grade", name) for name in GRADES} | {"accepted": ("accepted", True)}


def finish_pictures(folder: Path, report: Mapping[str, Any], request: Mapping[str, Any]) -> None:
    """Write card, Croissant and manifest into a folder that has Parquet files.

    Args:
        report: the run's counts: ropes, frames, and frames not used, by reason.
        request: what was asked for: configuration, sources, versions.
    """
    config = request["config"]
    write_text(folder / "README.md", _picture_card(folder, report, config))
    appearance, nx = config["appearance"]["name"], ", ".join(map(str, config["nx"]))
    about = f"Pictures of a closed rope with {nx} crossings and their Gauss codes; made by knotgym."
    write_croissant(folder, f"knotgym-pictures-{appearance}", about, appearance)
    write_manifest(folder, "knotgym-images-manifest", request, report)


def picture_tables(path: Path) -> dict[str, CardTable]:
    """Return the tables of facts about a perception table by name."""
    rows = read_table(path, columns=[*_COUNTED, "quality"])
    columns = {name: np.array(rows[name].to_pylist()) for name in _COUNTED}
    counts = [counted("splits", columns, _SPLITS), counted("grades", columns, _GRADES)]
    return {table.title: table for table in (*counts, measured(measures_of(rows)))}


def _picture_card(folder: Path, report: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the card as Markdown, with the YAML front matter that Hugging Face reads."""
    name = config["appearance"]["name"]
    rows, files = read_table(folder, columns=["nx", "split", "appearance"]), shards(folder)
    splits = [name for name in IMAGE_SPLITS if name in set(rows["split"].to_pylist())]
    paths = [(file_stem(split), f"data/{file_stem(split)}-*.parquet") for split in splits]
    return filled_card(
        "image_card.md",
        picture_tables(folder),
        config,
        data_files=[f"  - split: {split}\n    path: {path}" for split, path in paths],
        crossings=", ".join(map(str, sorted(set(rows["nx"].to_pylist())))),
        pictures=len(rows),
        bytes=f"{sum(file.stat().st_size for file in files) / len(rows):.0f}",
        engine=config["engine"],
        appearance=f"`{name}`, {APPEARANCES[name].says}",
        pulls=config["pulls"],
        policies=" and ".join(config["policies"]),
        code_share=f"{config['code_share']:g}",
        held=TABLES["held"]["marked" if marks_base(rows) else "unmarked"],
        test_nx=", ".join(map(str, config["test_nx"] or ())) or "none",
        ropes=report["ropes"],
        frames=report["frames"],
        not_used=plain(json.dumps({**report["dropped"], **report["refused"]})),
    )
