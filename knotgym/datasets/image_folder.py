"""Files beside the Parquet files of a perception table: walks, card and manifest."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from knotgym.common.atomic_files import atomic_write
from knotgym.datasets.cards.image_card import card, summary
from knotgym.datasets.image_table import read_table
from knotgym.datasets.manifest_check import write_manifest
from knotgym.datasets.walks_file import WalksMade, walks_of, write_walks
from knotgym.rope.model import Array


def finish(
    folder: Path,
    shards: Sequence[Path],
    request: Mapping[str, Any],
    report: Mapping[str, Any],
    states: Array,
    walks: Sequence[WalksMade],
) -> None:
    """Write walks, card and manifest into a folder that has its Parquet files; the manifest is
    last.

    `request` and `report` are the run's, see `image_card.card`; `states` are float64 (n, nstate),
    those that walks start from. Only the walks that a row comes from are written.
    """
    used = {walk for path in shards for walk in _walks_used(path)}
    write_walks(folder / "walks.h5", walks_of(states, walks, used, request["config"]["engine"]))
    write_card_and_manifest(folder, shards, request, report)


def write_card_and_manifest(
    folder: Path,
    shards: Sequence[Path],
    request: Mapping[str, Any],
    report: Mapping[str, Any],
    machines: Sequence[dict[str, str]] | None = None,
    edit_card: Callable[[str], str] = str,
) -> None:
    """Write card and manifest into a folder that has everything else; see `finish`.

    `machines` describes where it was made; None for this machine. `edit_card` changes the card.
    """
    facts = summary(folder)
    text = card(facts, request["config"], report, sum(path.stat().st_size for path in shards))
    with atomic_write(folder / "README.md") as temporary:
        temporary.write_text(edit_card(text), encoding="utf-8")
    write_manifest(
        folder, "knotgym-images-manifest", request, machines, report=report, summary=facts
    )


def _walks_used(path: Path) -> list[int]:
    return [source["walk"] for source in read_table(path, columns=["source"])["source"].to_pylist()]
