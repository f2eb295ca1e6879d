"""JSON files with a checksum of their content, for checkpoints.

A staging folder may be on a disk that fails or that other users can write to. The checksum detects
a changed file before it is used.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

from knotgym.common.atomic_files import atomic_write
from knotgym.common.configuration import read_json
from knotgym.common.errors import InvalidFile

_SEAL = "seal"


def write_sealed(path: Path, content: dict[str, Any]) -> None:
    """Write JSON atomically with its checksum; `content` must not have a field `seal`."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps({**content, _SEAL: _digest(content)}), encoding="utf-8")


def read_sealed(path: Path) -> dict[str, Any]:
    """Read a file of `write_sealed` and return its content without the checksum.

    Raises:
        InvalidFile: it was changed since it was written.
    """
    content = read_json(path)
    if not isinstance(content, dict) or content.pop(_SEAL, None) != _digest(content):
        raise InvalidFile(f"{path.name} isn't what was written: its checksum differs")
    return content


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()
