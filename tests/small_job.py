"""The main job made small enough for tests: shorter rounds of the search, smaller waves, less
opening up.

As a script it is the `knotgym` command with that change: python tests/small_job.py generate --nx 1
...
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from knotgym.cli import main as cli
from knotgym.control.planner import PlannerConfig
from knotgym.generate.states import curation_run as job
from knotgym.generate.states import state_recipe as main_job
from knotgym.generate.states.candidates import CandidateConfig
from knotgym.generate.states.curation_run import GenerateConfig
from knotgym.generate.states.hill_climb import HillClimbConfig
from knotgym.generate.states.search import SearchConfig

INSTANCE = CandidateConfig(hill_climb=HillClimbConfig(steps=6, tries=4), loop_walk_steps=4)
WAVE = 8
AIM = PlannerConfig(budget=400)

_search_config, _generate = job.search_config, main_job.generate


def small_search(config: GenerateConfig) -> SearchConfig:
    """The search of a job, in rounds of 8 slots of 8 pulls."""
    return replace(_search_config(config), batch_size=8, steps=8)


@contextmanager
def small() -> Iterator[None]:
    """Let every job begun in here be small."""

    def generate(config: GenerateConfig, *arguments: Any, **keywords: Any) -> None:
        _generate(
            replace(config, wave=WAVE, candidate=INSTANCE, planner=AIM), *arguments, **keywords
        )

    with (
        mock.patch.object(job, "search_config", small_search),
        mock.patch.object(main_job, "generate", generate),
    ):
        yield


def knotgym(*arguments: object) -> int:
    """Type a `knotgym` command, small; its exit status."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with small(), pytest.raises(SystemExit) as ended:
            cli.main([str(one) for one in arguments])
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    assert isinstance(ended.value.code, int)
    return ended.value.code


def typed(*arguments: object) -> list[str]:
    """The same as a command line for another process."""
    return [sys.executable, str(Path(__file__)), *map(str, arguments)]


if __name__ == "__main__":
    with small():
        cli.main()
