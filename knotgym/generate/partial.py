"""Runs that can be killed and resumed: one process at a time works in a hidden folder beside what it makes."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from knotgym.generate.main_job import _locked


@contextmanager
def held(out: Path, resume: bool) -> Iterator[Path]:
    """Hold the folder `.NAME.partial` beside `out`, emptied unless an earlier run's work is to be resumed.

    The lock goes with the process, however it ends; the folder stays until the caller removes it.

    Raises:
        Occupied: another process holds it.
    """
    partial = out.parent / f".{out.name}.partial"
    with _locked(partial):
        for path in [] if resume else partial.iterdir():
            if path.name != "lock":
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        yield partial
