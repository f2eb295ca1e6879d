"""The card (README.md) of a perception table, and the tables of facts shown in it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import knotgym
from knotgym.datasets.cards.citation import filled, plain, write_text
from knotgym.datasets.cards.croissant import write_croissant
from knotgym.datasets.cards.fact_tables import CardTable, counted, measured
from knotgym.datasets.image_table import GRADES, file_stem, marks_base, read_table, shards
from knotgym.datasets.manifest import write_manifest
from knotgym.quality import UNITS
from knotgym.rendering import APPEARANCES
from knotgym.states import IMAGE_SPLITS

_COUNTED = ("gauss_code", "gauss_code_chiral", "split", "grade", "nx", "accepted")
_SPLITS = {name: ("split", name) for name in IMAGE_SPLITS}
_GRADES = {name: ("grade", name) for name in GRADES} | {"accepted": ("accepted", True)}


# what test-code holds out
_MARKED = "Codes are compared as they are read from the base bead; another base is another code."
_UNMARKED = (
    "Some pictures mark neither base nor direction and fit every code of their diagram. So codes"
    " are compared up to base, direction, mirror images and switched crossings (`canonical_code`)."
)


def image_card_tables(path: Path) -> dict[str, CardTable]:
    """Return the tables of facts about a perception table by name."""
    rows = read_table(path, columns=[*_COUNTED, "quality"])
    quality = rows["quality"].combine_chunks()
    measures = {
        field.name: (UNITS.get(field.name, ""), quality.field(field.name).to_numpy())
        for field in quality.type
    }
    columns = {name: np.array(rows[name].to_pylist()) for name in _COUNTED}
    counts = [counted("splits", columns, _SPLITS), counted("grades", columns, _GRADES)]
    return {one.title: one for one in (*counts, measured(measures))}


def finish_images(folder: Path, report: Mapping[str, Any], request: Mapping[str, Any]) -> None:
    """Write card, Croissant and manifest into a folder that has its Parquet files.

    Args:
        folder: holds the Parquet files.
        report: numbers of ropes and frames, and of frames not used, by reason.
        request: what was asked for: configuration, sources, versions.
    """
    config = request["config"]
    write_text(folder / "README.md", _card(folder, report, config))
    appearance = config["appearance"]["name"]
    nx = ", ".join(map(str, config["nx"]))
    write_croissant(
        folder,
        f"knotgym-pictures-{appearance}",
        f"Pictures of a closed rope with {nx} crossings and their Gauss codes; made by knotgym.",
        appearance,
    )
    write_manifest(folder, "knotgym-images-manifest", request, report)


def _card(folder: Path, report: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the card as Markdown, with the YAML front matter that Hugging Face reads."""
    name = config["appearance"]["name"]
    rows, files = read_table(folder, columns=["nx", "split", "appearance"]), shards(folder)
    splits = [name for name in IMAGE_SPLITS if name in set(rows["split"].to_pylist())]
    paths = [(file_stem(split), f"data/{file_stem(split)}-*.parquet") for split in splits]
    return filled(
        "image_card.md",
        data_files=[f"  - split: {split}\n    path: {path}" for split, path in paths],
        crossings=", ".join(map(str, sorted(set(rows["nx"].to_pylist())))),
        pictures=len(rows),
        bytes=f"{sum(file.stat().st_size for file in files) / len(rows):.0f}",
        version=knotgym.__version__,
        mujoco=mujoco.__version__,
        engine=config["engine"],
        appearance=f"`{name}`, {APPEARANCES[name].says}",
        seed=config["seed"],
        pulls=config["pulls"],
        policies=" and ".join(config["policies"]),
        code_share=f"{config['code_share']:g}",
        held=_MARKED if marks_base(rows) else _UNMARKED,
        test_nx=", ".join(map(str, config["test_nx"] or ())) or "none",
        **{name: one.markdown() for name, one in image_card_tables(folder).items()},
        ropes=report["ropes"],
        frames=report["frames"],
        not_used=plain(json.dumps({**report["dropped"], **report["refused"]})),
        config=json.dumps(config, indent=1, sort_keys=True),
    )
