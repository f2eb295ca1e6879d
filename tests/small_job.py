"""The main job, small enough for tests, and commands typed in this or another process."""

import errno
import fnmatch
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from knotgym.cli import main

WANTED = ("--nx", "0,1", "--count", 4)  # what conftest's `curated` folder was asked for
SECONDS = 120  # in which anything that is waited for must have happened


def knotgym(*arguments: object) -> int:
    """Type a `knotgym` command; its exit status."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with pytest.raises(SystemExit) as ended:
            main([str(one) for one in arguments])
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    assert isinstance(ended.value.code, int)
    return ended.value.code


def typed(*arguments: object) -> list[str]:
    """The same as a command line for another process."""
    return [sys.executable, "-m", "knotgym", *map(str, arguments)]


def full_disk(*_: object, **__: object) -> None:
    """Stand for whatever writes to a disk that is full."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def staging_of(out: Path) -> Path:
    """Where a run keeps its work until its output is finished."""
    return out.with_name(f".{out.name}.partial")


def wait_for_file(run: subprocess.Popen[str], folder: Path, pattern: str) -> None:
    """Wait until a file of that name is anywhere below a folder, or the process has ended."""
    until = time.monotonic() + SECONDS
    while run.poll() is None and time.monotonic() < until:
        # os.walk, for folders are renamed meanwhile and rglob stumbles over that
        if any(fnmatch.filter(names, pattern) for _, _, names in os.walk(folder)):
            return
        time.sleep(0.005)
