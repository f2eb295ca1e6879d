"""The identity of a run: everything that determines its output, as JSON.

It is in the journal of a run and in the manifest of its output. A run can only be continued, merged
or recognized as finished if its identity is the same; otherwise the error names the differences.
"""

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np

import knotgym
from knotgym.common import as_json, read_json
from knotgym.rope import RopeConfig

FIELDS = ("config", "source", "versions", "rope")


def identity(config: Any, source: Any = None) -> dict[str, Any]:
    """Return the identity of a run.

    Args:
        config: its configuration; settings that can't change the output are left out.
        source: digests of the files that it reads, as JSON.
    """
    whole = {
        "config": config if isinstance(config, dict) else as_json(config),
        "source": source,
        "versions": versions(),
        "rope": RopeConfig().fingerprint,
    }
    found: dict[str, Any] = json.loads(json.dumps(whole))
    return found


def versions() -> dict[str, str]:
    """Return the versions of everything that could change the output.

    `code` is a digest of this package's modules, to distinguish edits within a version.
    """
    return {
        "knotgym": knotgym.__version__,
        "code": _code_sha256(),
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
    }


def identity_of(out: Path, file: str = "manifest.json") -> dict[str, Any] | None:
    """Return the identity in this file of a folder, or in a JSON file; None if unknown."""
    try:
        content = read_json(out / file if out.is_dir() else out)
        content = content.get("identity", content)
        return {name: content[name] for name in FIELDS}
    except (AttributeError, OSError, ValueError, KeyError, TypeError):
        return None


@cache
def _code_sha256() -> str:
    """Return the SHA-256 of this package's modules, except `cli`, which can't affect the output."""
    root, digest = Path(knotgym.__file__).parent, hashlib.sha256()
    modules = {path.relative_to(root).as_posix(): path for path in root.rglob("*.py")}
    for name in sorted(modules):
        if not name.startswith("cli/"):
            digest.update(f"{name}\0".encode() + modules[name].read_bytes() + b"\0")
    return digest.hexdigest()
