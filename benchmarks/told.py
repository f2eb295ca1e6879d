"""What file_readers.py and checkpoint_readers.py say of a file."""

from __future__ import annotations

import hashlib

Told = tuple[list[str], dict[str, str]]  # faults, and digests by name of all that is taken


def digest(what: str | bytes) -> str:
    """SHA-256, hexadecimal."""
    return hashlib.sha256(what if isinstance(what, bytes) else what.encode()).hexdigest()
