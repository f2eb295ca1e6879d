"""Scripts of benchmarks/ and examples/, run in this process as a user types them."""

import os
import runpy
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import cv2

ROOT = Path(__file__).parents[1]


def run_script(script: Path, *words: object) -> None:
    """Type `python SCRIPT WORDS...`; what the script sets for its whole process is put back.

    Raises:
        SystemExit: it ended with another status than 0.
    """
    with _as_it_was(script.parent), mock.patch.object(sys, "argv", [str(script), *map(str, words)]):
        try:
            runpy.run_path(str(script), run_name="__main__")
        except SystemExit as end:
            if end.code:
                raise


@contextmanager
def _as_it_was(folder: Path) -> Iterator[None]:
    """Lend the script's folder to imports, and keep it from pinning this process to one core."""
    threads = cv2.getNumThreads()
    pinned = mock.patch.object(os, "sched_setaffinity", lambda *_: None, create=True)
    with mock.patch.dict(os.environ), mock.patch.object(sys, "path", [str(folder), *sys.path]):
        with pinned:
            yield
    cv2.setNumThreads(threads)
    for neighbour in folder.glob("*.py"):  # another folder may have a module of this name
        if getattr(sys.modules.get(neighbour.stem), "__file__", None) == str(neighbour):
            del sys.modules[neighbour.stem]
