"""Runs made small enough for tests, by settings alone: shorter rounds of play, smaller waves."""

from __future__ import annotations

import fnmatch
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from knotgym.cli import main as cli
from knotgym.common.configuration import updated
from knotgym.generate.states.generate_config import GenerateConfig

SETTINGS = Path(__file__).parent / "small.json"
WANTED = ("--nx", "0,1", "--count", 4)  # what conftest's `curated` folder was asked for
SECONDS = 120  # in which anything that is waited for must have happened
SMALL = updated(GenerateConfig(), json.loads(SETTINGS.read_text(encoding="utf-8")))


def knotgym(*arguments: object) -> int:
    """Type a `knotgym` command, small; its exit status."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with pytest.raises(SystemExit) as ended:
            cli.main(_small(arguments))
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    assert isinstance(ended.value.code, int)
    return ended.value.code


def typed(*arguments: object) -> list[str]:
    """The same as a command line for another process."""
    return [sys.executable, "-m", "knotgym", *_small(arguments)]


def begun(out: Path, *arguments: object, saved: bool) -> subprocess.Popen[str]:
    """A run in another process group, once it holds its folder, or has saved what it made."""
    run = subprocess.Popen(
        typed("generate", *WANTED, *arguments, "--out", out),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    partial, until = out.parent / f".{out.name}.partial", time.monotonic() + SECONDS

    def is_there() -> bool:
        counters = partial / "run.json"
        if saved:
            return counters.is_file() and "wave-" in counters.read_text(encoding="utf-8")
        return (partial / "lock").exists()

    while not is_there() and run.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    assert run.poll() is None and is_there()
    return run


def wait_for_file(run: subprocess.Popen[str], folder: Path, pattern: str) -> None:
    """Wait until a file of that name is anywhere below a folder, or the process has ended."""
    until = time.monotonic() + SECONDS
    while run.poll() is None and time.monotonic() < until:
        # os.walk, for folders are renamed meanwhile and rglob stumbles over that
        if any(fnmatch.filter(names, pattern) for _, _, names in os.walk(folder)):
            return
        time.sleep(0.005)


def _small(arguments: tuple[object, ...]) -> list[str]:
    words = [str(one) for one in arguments]
    if words[:1] == ["generate"]:
        words[1:1] = ["--settings", str(SETTINGS)]
    return words
