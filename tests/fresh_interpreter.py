"""Fresh interpreters: what a statement imports, asked once of each, and whole programs."""

import functools
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


def python(*words: object, **more: Any) -> "subprocess.CompletedProcess[str]":
    """Run `python WORDS...` and keep what it prints; `more` as `subprocess.run` takes it."""
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, **more)


@functools.cache
def modules_after(statement: str) -> frozenset[str]:
    """The modules that a fresh interpreter holds after a statement."""
    code = f"import sys\n{statement}\nprint(*sys.modules)"
    return frozenset(python("-c", code, cwd=ROOT, check=True).stdout.split())
