"""What a run saves to go on from, as JSON with a checksum of itself.

A folder in which a run works may lie on a disk that others write to, or that fails: what was
changed there is told before anything is made of it.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from knotgym.common.atomic_files import atomic_write
from knotgym.common.configuration import UnreadableJson, read_json

_SEAL = "seal"


def write_sealed(path: Path, said: dict[str, Any]) -> None:
    """Write JSON, whole or not at all; `said` has no field `seal`."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps({**said, _SEAL: _digest(said)}), encoding="utf-8")


def read_sealed(path: Path) -> dict[str, Any]:
    """What `write_sealed` wrote.

    Raises:
        OSError: it can't be read.
        UnreadableJson: it isn't what was written.
    """
    said = read_json(path)
    if not isinstance(said, dict) or said.pop(_SEAL, None) != _digest(said):
        raise UnreadableJson(f"{path.name} isn't what was written: its checksum differs")
    return said


def _digest(said: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(said).encode()).hexdigest()
