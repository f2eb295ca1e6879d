"""What a person sees while a run goes on: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from rich.console import Console
from rich.live import Live
from rich.table import Table

_LIVE_EVERY, _LINE_EVERY = 0.5, 10.0  # seconds between two looks


@dataclass(frozen=True)
class Status:
    """Where a run stands.

    Attributes:
        done, total: of what is counted, such as states or episodes.
        counted: its name in the plural.
        facts: name -> value of whatever else is worth knowing.
    """

    done: int
    total: int
    counted: str
    facts: dict[str, str] = field(default_factory=dict)


class Progress:
    """Shows where a run stands, now and then; a context manager that clears up behind it."""

    def __init__(self, console: Console, quiet: bool) -> None:
        self._console, self._quiet = console, quiet
        live = console.is_terminal and not quiet
        self._live = Live(console=console, transient=True) if live else None
        self._began = self._told = time.perf_counter()
        self._done_before: int | None = None

    def __enter__(self) -> Progress:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def show(self, status_of: Callable[[], Status], last: bool = False) -> None:
        """Show the status, which is only asked for when it is time for another look."""
        now = time.perf_counter()
        if self._done_before is None:  # what an earlier sitting did says nothing of the speed
            self._done_before = status_of().done
        soon = now - self._told < (_LIVE_EVERY if self._live else _LINE_EVERY)
        if self._quiet or (soon and not last):
            return
        self._told = now
        status, seconds = status_of(), now - self._began
        done = status.done - self._done_before
        left = f"{seconds * (status.total - status.done) / done:.0f} s" if done else "?"
        facts = {
            status.counted: f"{status.done} of {status.total}",
            **status.facts,
            "time left, about": left,
        }
        if self._live:
            table = Table.grid(padding=(0, 2))
            for name, value in facts.items():
                table.add_row(f"[bold]{name}", value)
            self._live.update(table)
        else:
            line = "; ".join(f"{name} {value}" for name, value in facts.items())
            self._console.print(f"{seconds:5.0f} s  {line}", soft_wrap=True, highlight=False)
