"""The manifest of a folder that a run made: read back, and its checksums compared."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from knotgym.atomic_files import sha256


def read_manifest(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """The manifest, which has `files` and `config`, empty if it can't be read; and that fault."""
    try:
        manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
        checked = {"files": dict(manifest["files"]), "config": dict(manifest["config"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        return {}, [f"manifest.json can't be read: {error}"]
    return {**manifest, **checked}, []


def listed_faults(folder: Path, manifest: Mapping[str, Any]) -> Iterator[str]:
    """Files that the manifest lists and that are missing or of another checksum."""
    for name, digest in manifest.get("files", {}).items():
        if not (folder / name).is_file():
            yield f"{name} is missing"
        elif sha256(folder / name) != digest:
            yield f"{name} is not the file the manifest lists (SHA-256 differs)"
