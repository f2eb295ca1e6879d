"""Finish the folder of a run: what goes beside its rows, the card, and last the manifest."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from knotgym.datasets.cards import image_card, state_card
from knotgym.datasets.cards.citation import write_text
from knotgym.datasets.gallery import state_tiles, write_gallery
from knotgym.datasets.manifest import write_manifest
from knotgym.states.state_file import States


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
    """Write card and manifest into a folder that has its Parquet files.

    Arguments are those of `finish_states`; for `report` see `image_card.card`.
    """
    write_text(folder / "README.md", image_card.card(folder, report, request["config"]))
    write_manifest(folder, "knotgym-images-manifest", request, report)
