"""Finish the folder of a run: what goes beside its rows, the card, and last the manifest."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from knotgym.datasets.cards import image_card, state_card
from knotgym.datasets.cards.citation import write_text
from knotgym.datasets.exports.croissant import croissant
from knotgym.datasets.gallery import state_tiles, write_gallery
from knotgym.datasets.manifest import write_manifest
from knotgym.states.state_file import States

_OF_PHOTOS = {
    "rai:dataLimitations": "One simulated rope, photographed by a renderer: no pictures of real"
    " rope. Light, cloth, wood and clutter are drawn by formulas. Up to 6 crossings.",
    "rai:dataBiases": "Views in which a person couldn't decide every crossing are left out: strands"
    " that run along each other, crossings below 30 degrees, eyes of a few pixels, ropes of the"
    " background's colour. Tangled ropes are left out more often than loose ones.",
    "rai:dataAnnotationProtocol": "Codes, crossings, masks and the rope's axis are computed from"
    " the vertices in the axes of the camera; two labellers agree on every code, and `knotgym"
    " dataset verify` computes every row and picture again.",
}


def finish_states(
    folder: Path, states: States, report: Mapping[str, Any], request: Mapping[str, Any]
) -> None:
    """Write gallery, card and manifest into a folder that has the states and demonstrations.

    Args:
        report: the run's counts.
        request: what was asked for: configuration, sources, versions.
    """
    write_gallery(folder / "gallery.png", state_tiles(states))
    write_text(folder / "README.md", state_card.card(states, report, request["config"]))
    write_manifest(folder, "knotgym-manifest", request, report)


def finish_images(folder: Path, report: Mapping[str, Any], request: Mapping[str, Any]) -> None:
    """Write card, Croissant and manifest into a folder that has its Parquet files.

    Arguments are those of `finish_states`; for `report` see `image_card.card`.
    """
    config = request["config"]
    write_text(folder / "README.md", image_card.card(folder, report, config))
    photos = config["appearance"]["style"] == "photo"
    nx = ", ".join(map(str, config["nx"]))
    described = croissant(
        folder,
        f"knotgym-{'photos' if photos else 'pictures'}",
        f"Pictures of a closed rope with {nx} crossings and their Gauss codes; made by knotgym.",
        _OF_PHOTOS if photos else None,
    )
    write_text(folder / "croissant.json", json.dumps(described, indent=1))
    write_manifest(folder, "knotgym-images-manifest", request, report)
