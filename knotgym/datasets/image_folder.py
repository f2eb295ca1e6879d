"""Files beside the Parquet files of a perception table: walks, card and manifest."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from knotgym.common.atomic_files import atomic_write, sha256
from knotgym.datasets.cards.image_card import card, summary
from knotgym.datasets.image_table import read_table
from knotgym.datasets.machine import machine
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
    """Write walks, card and manifest into a folder that has its Parquet files.

    Args:
        folder: the output folder; the manifest is written last.
        shards: its Parquet files.
        request: `config` and `source` of the run.
        report: report of the run, see `image_card.card`.
        states: float64 (n, nstate), simulator states that the walks start from.
        walks: all walks of the run; only those that a row comes from are written.
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
) -> None:
    """Write card and manifest into a folder that has everything else; see `finish`.

    `machines` describes where it was made; None for this machine.
    """
    facts = summary(folder)
    text = card(facts, request["config"], report, sum(path.stat().st_size for path in shards))
    with atomic_write(folder / "README.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    manifest = {
        "format": "knotgym-images-manifest",
        "format_version": 1,
        **request,
        "machines": machines or [machine()],
        "report": report,
        "summary": facts,
        "files": {
            str(path.relative_to(folder)): sha256(path)
            for path in sorted(folder.rglob("*"))
            if path.is_file() and path.name != "manifest.json"
        },
    }
    with atomic_write(folder / "manifest.json") as temporary:
        temporary.write_text(json.dumps(manifest, indent=1, sort_keys=True), encoding="utf-8")


def _walks_used(path: Path) -> list[int]:
    return [source["walk"] for source in read_table(path, columns=["source"])["source"].to_pylist()]
