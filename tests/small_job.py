"""Runs made small enough for tests, by settings alone: shorter rounds of the search, smaller waves,
less hill climbing.
"""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import pytest

from knotgym.cli import main as cli
from knotgym.configuration import updated
from knotgym.generate.states.generate_config import GenerateConfig

SETTINGS = Path(__file__).parent / "small.json"
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


def _small(arguments: tuple[object, ...]) -> list[str]:
    words = [str(one) for one in arguments]
    if words[:1] == ["generate"]:
        words[1:1] = ["--settings", str(SETTINGS)]
    return words
