"""Progress: a live table on a terminal, plain lines elsewhere."""

import io
import sys
import time
from contextlib import redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numba.core import event
from pytest_types import Capture, Patch
from rich.console import Console

from knotgym.common import Counts
from knotgym.rope import warn_of_compilation
from knotgym.runs.executors import InProcess, compile_first, executor
from knotgym.runs.progress import Progress
from knotgym.runs.runner import Call, Recipe, compute


def ends_three(number: int) -> dict[str, Any]:
    for _ in range(3):
        Counts.end_item()
    time.sleep(1)
    return {"number": np.array(number)}


def test_a_first_run_says_that_it_compiles(tmp_path: Path, monkeypatch: Patch) -> None:
    kernel = SimpleNamespace(
        __module__="k", __name__="k", stats=SimpleNamespace(cache_path=tmp_path)
    )  # nothing compiled there
    monkeypatch.setattr("knotgym.topology.scan", kernel)
    monkeypatch.setattr("knotgym.runs.progress._LINE_EVERY", 0.05)
    written, compiled = io.StringIO(), InProcess.submit

    def submit(pool: InProcess, *call: Any) -> Any:
        time.sleep(0.3)  # longer than any line is waited for
        return compiled(pool, *call)

    monkeypatch.setattr(InProcess, "submit", submit)
    with Progress(console=Console(file=written, width=200)) as progress:
        compile_first(progress)
    lines = [line[9:] for line in written.getvalue().splitlines()]
    assert lines[0] == "compiling, once: about 30 s left"
    assert all(line.startswith("compiling, once: about") for line in lines)


def test_what_compiles_later_than_the_engine_is_named_while_it_does() -> None:
    written = io.StringIO()
    with Progress(console=Console(file=written, width=200)) as progress:
        with event.trigger_event("numba:compile"):
            progress.stage("playing", 1, 2)
        progress.stage("playing", 2, 2)
    told = [line[9:] for line in written.getvalue().splitlines()]
    assert told == ["playing: 1 of 2; compiling, once", "playing: 2 of 2"]


def test_a_first_environment_says_once_that_it_compiles(
    tmp_path: Path, monkeypatch: Patch, caplog: pytest.LogCaptureFixture
) -> None:
    stats = SimpleNamespace(cache_path=tmp_path / "k")
    kernel = SimpleNamespace(__module__="k", __name__="k", stats=stats)
    monkeypatch.setattr("knotgym.topology.scan", kernel)
    monkeypatch.setattr("knotgym.rope.engines._warned", set())
    for _ in range(2):
        warn_of_compilation("mujoco")
        monkeypatch.setattr("knotgym.rope.engines._warned", set())  # as in a worker process
    assert [one.getMessage() for one in caplog.records] == ["compiling, once, about 30 s"]


def test_a_terminal_is_told_while_printed_words_go_elsewhere(monkeypatch: Patch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    # as pyknotid's words do, while it is imported
    with Progress() as progress, redirect_stdout(io.StringIO()) as kept:
        progress.say("told")
    assert "told" in terminal.getvalue() and not kept.getvalue()
    # while output is piped, a person who watches is told on standard error
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    monkeypatch.setattr(sys, "stderr", watched := Terminal())
    with Progress() as progress:
        progress.stage("playing", 1, 2)
    assert "\x1b" in watched.getvalue()  # a live line


def shown(*done: int) -> str:
    """What plain lines say of a run of ten things, looked at every 20 s."""
    written, now = io.StringIO(), [0.0]
    progress = Progress(console=Console(file=written, width=200), clock=lambda: now[0])
    with progress:
        for count in done:
            now[0] += 20
            progress.stage("playing", count, 10)
    return written.getvalue()


@pytest.mark.parametrize("workers", [1, 2])
def test_items_count_when_they_end_not_when_calls_return(workers: int, monkeypatch: Patch) -> None:
    monkeypatch.setattr("knotgym.runs.progress._LINE_EVERY", 0.05)
    monkeypatch.syspath_prepend(Path(__file__).parents[2])  # workers import this module
    written = io.StringIO()

    def recipe() -> Recipe[None]:
        yield [Call(f"episodes {number}", ends_three, (number,), items=4) for number in range(2)]

    with Progress(console=Console(file=written, width=200)) as progress, executor(workers) as pool:
        compute(recipe(), pool=pool, progress=progress)
    told = [line[9:].partition(";")[0] for line in written.getvalue().splitlines()]
    assert f"episodes: {3 if workers == 1 else 6} of 8" in told and "episodes: 8 of 8" in told
    assert told == sorted(told)


def test_what_is_counted_anywhere_is_shown_while_a_command_runs() -> None:
    written = io.StringIO()
    with Progress(console=Console(file=written, width=200)):
        assert [*Counts.over("ab", "drawing", 2)] == ["a", "b"]
    Counts.tell("drawing", 1, 2)  # nobody listens
    told = [line[9:] for line in written.getvalue().splitlines()]
    assert told == ["drawing: 0 of 2", "drawing: 2 of 2"]


def test_the_time_left_leaves_out_what_came_before_the_first_item() -> None:
    assert "time left" not in shown(0, 0)
    assert "time left" not in shown(*[0] * 9, 1)  # compiling, starting workers
    assert shown(*[0] * 9, 1, 9).endswith("; time left 0:00:03\n")


def test_a_long_run_whose_output_is_a_result_tells_on_standard_error(capfd: Capture) -> None:
    now = [0.0]
    progress = Progress(lines=False, clock=lambda: now[0])
    for done, now[0] in enumerate((1.0, 5.0, 12.0, 13.0)):
        progress.stage("playing", done, 4)
    assert capfd.readouterr() == ("", "   12 s  playing: 2 of 4; time left 0:00:14\n")
