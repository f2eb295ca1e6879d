"""Finish the folder of a run: what goes beside its rows, the card, and last the manifest."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from knotgym.common.atomic_files import atomic_write
from knotgym.datasets.cards import image_card, state_card
from knotgym.datasets.gallery import write_gallery
from knotgym.datasets.manifest_check import write_manifest
from knotgym.states.state_file import States


def finish_states(
    folder: Path,
    states: States,
    report: Mapping[str, Any],
    request: Mapping[str, Any],
    machines: Sequence[dict[str, str]] | None = None,
) -> None:
    """Write gallery, card and manifest into a folder that has the states and demonstrations.

    Args:
        report: the run's counts.
        request: what was asked for: configuration, sources, versions.
        machines: made the data; this one by default.
    """
    write_gallery(folder / "gallery.png", states)
    _write_card(folder, state_card.card(states, report, request["config"]))
    facts = {"summary": state_card.summary(states), "splits": states.split.tolist()}
    write_manifest(folder, "knotgym-manifest", request, machines, report=report, **facts)


def finish_images(
    folder: Path,
    shards: Sequence[Path],
    report: Mapping[str, Any],
    request: Mapping[str, Any],
    machines: Sequence[dict[str, str]] | None = None,
) -> None:
    """Write card and manifest into a folder that has its Parquet files.

    Arguments are those of `finish_states`; for `report` see `image_card.card`.
    """
    facts, size = image_card.summary(folder), sum(path.stat().st_size for path in shards)
    _write_card(folder, image_card.card(facts, request["config"], report, size))
    name = "knotgym-images-manifest"
    write_manifest(folder, name, request, machines, report=report, summary=facts)


def _write_card(folder: Path, text: str) -> None:
    with atomic_write(folder / "README.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
