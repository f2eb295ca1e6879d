"""What a command shows: progress, a live table on a terminal, else plain lines on standard error;
and tables of results.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

_LIVE_EVERY, _LINE_EVERY = 0.5, 10.0  # seconds between updates


class Status(NamedTuple):
    """How far a stage of a run is.

    Attributes:
        done, total: how many items are done, and how many there are; all take about as long.
        counted: name of the items, in the plural.
        facts: other values to show, by name.
    """

    done: int
    total: int
    counted: str
    facts: Mapping[str, str] = {}


class Progress:
    """Shows the progress of a run; a context manager that removes the live table at its end.

    If there is no terminal, plain lines are printed on standard error from time to time: with
    `lines` from the first moment, else after ten seconds. `clock` returns seconds.
    """

    def __init__(
        self,
        quiet: bool = False,
        *,
        lines: bool = True,
        console: Console | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._clock, self._began = clock, clock()
        self._shown: float | None = None  # when a status was shown last
        self._done: int | None = None  # of the first status
        # The first status with more done, and its time: what comes before it, such as compiling and
        # starting workers, would make the time left many times too long.
        self._first: tuple[float, Status] | None = None
        self._status: Status | None = None
        self._stage, self._count = "starting", ""
        # Keep the stream of now: `sys.stdout` is redirected while pyknotid runs, to hide its
        # output, and the live table must not follow.
        self.console = console or Console(file=sys.stdout)
        shown = self.console
        if not shown.is_terminal and console is None and sys.stderr.isatty():
            shown = Console(file=sys.stderr)  # output is piped, but a person is watching
        live = shown.is_terminal and not quiet
        self._live = (
            Live(
                get_renderable=self._table,
                console=shown,
                transient=True,
                refresh_per_second=1 / _LIVE_EVERY,
            )
            if live
            else None
        )
        self._lines, self._quiet = lines and not quiet and not live, quiet
        self._printed = console or Console(file=sys.stderr)

    def __enter__(self) -> Progress:
        if self._live:
            self._live.start(refresh=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def say(self, text: str) -> None:
        """Print a permanent line."""
        if not self._quiet:
            self.console.print(text, soft_wrap=True, highlight=False, markup=False)

    def _tell(self, line: str) -> None:
        self._printed.print(line, soft_wrap=True, highlight=False, markup=False)

    def say_how_to_load(self, lines: Sequence[str]) -> None:
        """Print the lines of code that load the output."""
        for line in ("to load it:", *(f"    {line}" for line in lines)):
            self.say(line)

    def stage(self, name: str, done: int = 0, total: int = 0) -> None:
        """Set the current stage and its count; plain lines show stages until the first status."""
        if name != self._stage:
            self._done = self._first = None
            if self._lines and self._shown is None:
                self._tell(f"{self._clock() - self._began:5.0f} s  {name}")
        self._stage, self._count = name, f" {done} of {total}" if total else ""

    def show(self, status_of: Callable[[], Status], last: bool = False) -> None:
        """Show a status; `status_of` is only called if an update is due."""
        now, every = self._clock(), _LIVE_EVERY if self._live else _LINE_EVERY
        if self._quiet or (self._shown is not None and now - self._shown < every and not last):
            return
        self._shown, self._status = now, status_of()
        if self._done is None:
            self._done = self._status.done
        elif self._first is None and self._status.done > self._done:
            self._first = now, self._status
        if self._lines or (not self._live and now - self._began >= _LINE_EVERY):
            line = "; ".join(f"{name} {value}" for name, value in self._facts().items())
            self._tell(f"{now - self._began:5.0f} s  {line}")

    def _facts(self) -> dict[str, str]:
        """Return the values to show now, by name."""
        if self._status is None:
            return {}
        done, total, counted, other = self._status
        facts = {counted: f"{done} of {total}", **other}
        since, first = self._first or (0.0, self._status)
        if first.done < done < total:
            left = (self._clock() - since) * (total - done) / (done - first.done)
            facts["time left, about"] = _duration(left)
        return facts

    def _table(self) -> Table:
        table = Table.grid(padding=(0, 2))
        since = f"{self._count} {self._clock() - self._began:.0f} s".strip()
        for name, value in {self._stage: since, **self._facts()}.items():
            table.add_row(Text(name, "bold"), Text(value))
        return table


def narrow_table(
    columns: Iterable[str], title: str | None = None, left: Sequence[str] = ()
) -> Table:
    """Make a table for terminals of 80 columns, which output to a pipe has too.

    It has no vertical rules, and only the first column may wrap.
    """
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for index, column in enumerate(columns):
        table.add_column(
            column,
            justify="left" if column in left else "right",
            no_wrap=index > 0,
            overflow="fold",
        )
    return table


def _duration(seconds: float) -> str:
    """Format a duration with one unit.

    >>> [_duration(one) for one in (50, 5000, 8e4, 8e6, 8e8)]
    ['50 s', '83 minutes', '22 hours', '93 days', '25 years']
    """
    for unit, size in (("years", 31_557_600), ("days", 86_400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
