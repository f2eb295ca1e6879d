"""Where Minari keeps its datasets."""

from __future__ import annotations

import os
from pathlib import Path


def minari_root() -> Path:
    """The folder under which a dataset's id is found: MINARI_DATASETS_PATH, else the default."""
    return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")
