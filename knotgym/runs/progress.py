"""What a person sees while something goes on: on a terminal a few lines that tick twice a second,
whatever the work is at; elsewhere plain lines, if the work is a long run.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

_LIVE_EVERY, _LINE_EVERY = 0.5, 10.0  # seconds between two looks
_LONG = 3600.0  # seconds: a run that would take longer says so before it begins


@dataclass(frozen=True)
class Status:
    """Where a run stands.

    Attributes:
        done, total: of what is counted, such as states or episodes; `total` is what was asked
            for, and what was made beyond it belongs in `facts`.
        counted: its name in the plural.
        facts: name -> value of whatever else is worth knowing.
        even: each takes about as long as another, so that the time left can be told.
        share: of the work that is done, in [0, 1], where things take unlike times; then the time
            left is told by it.
    """

    done: int
    total: int
    counted: str
    facts: dict[str, str] = field(default_factory=dict)
    even: bool = False
    share: float | None = None

    @property
    def part(self) -> float | None:
        """The share of the work that is done, None if that can't be told."""
        if self.share is None and self.even and self.total:
            return self.done / self.total
        return self.share


class Progress:
    """Shows where a run stands; a context manager that clears up behind it.

    Args:
        quiet: show nothing.
        lines: write plain lines now and then where there is no terminal.
        console: standard output by default.
        clock: seconds.
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
        self._told: float | None = None
        self._first: tuple[float, Status] | None = None  # the first status, and when
        self._status: Status | None = None
        self._stage, self._count = "starting", ""
        # the file itself: what goes on may send `sys.stdout` elsewhere for a while, as pyknotid's
        # words are, and would send the ticks along
        self.console = console or Console(file=sys.stdout)
        shown = self.console
        if not shown.is_terminal and console is None and sys.stderr.isatty():
            shown = Console(file=sys.stderr)  # the output goes into a pipe, the person looks on
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

    def __enter__(self) -> Progress:
        if self._live:
            self._live.start(refresh=True)
        if self._lines:  # what follows may import for seconds
            self.say("    0 s  starting")
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def say(self, text: str) -> None:
        """Print a line that stays."""
        if not self._quiet:
            self.console.print(text, soft_wrap=True, highlight=False, markup=False)

    def say_how_to_load(self, lines: Sequence[str]) -> None:
        """Print the lines of code that load what was made."""
        for line in ("to load it:", *(f"    {line}" for line in lines)):
            self.say(line)

    def stage(self, name: str, done: int = 0, total: int = 0) -> None:
        """Say what is being done now, and how much of it is; in plain lines until a status is."""
        if self._lines and self._told is None and name != self._stage:
            self.say(f"{self._clock() - self._began:5.0f} s  {name}")
        self._stage, self._count = name, f" {done} of {total}" if total else ""

    def show(self, status_of: Callable[[], Status], last: bool = False) -> None:
        """Show the status, which is only asked for when it is time for another look."""
        now, every = self._clock(), _LIVE_EVERY if self._live else _LINE_EVERY
        if self._quiet or (self._told is not None and now - self._told < every and not last):
            return
        self._told, self._status = now, status_of()
        self._first = self._first or (now, self._status)
        if self._lines:
            line = "; ".join(f"{name} {value}" for name, value in self._facts().items())
            self.console.print(
                f"{now - self._began:5.0f} s  {line}", soft_wrap=True, highlight=False
            )

    def _facts(self) -> dict[str, str]:
        """What is to be told now, name -> value."""
        status = self._status
        if status is None or self._first is None:
            return {}
        since, first = self._first
        counted, beyond = min(status.done, status.total), max(0, status.done - status.total)
        facts = {status.counted: f"{counted} of {status.total}"}
        facts |= {"beyond what was asked for": f"{beyond}"} if beyond else {}
        facts |= status.facts
        if status.part is not None and first.part is not None:
            done = status.part - first.part  # work of an earlier run says nothing of the speed
            if 0 < done and status.part < 1:
                left = (self._clock() - since) * (1 - status.part) / done
                facts["time left, about"] = duration(left)
        return facts

    def _table(self) -> Table:
        table = Table.grid(padding=(0, 2))
        since = f"{self._count} {self._clock() - self._began:.0f} s".strip()
        for name, value in {self._stage: since, **self._facts()}.items():
            table.add_row(Text(name, "bold"), Text(value))
        return table


def duration(seconds: float) -> str:
    """A time as people say it.

    >>> [duration(one) for one in (50, 5000, 8e4, 8e6, 8e8)]
    ['50 s', '83 minutes', '22 hours', '93 days', '25 years']
    """
    for unit, size in (("years", 31_557_600), ("days", 86_400), ("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def tell_if_long(progress: Progress, core_seconds: float, workers: int) -> None:
    """Say before a run begins how long it would take, if that is more than an hour.

    Args:
        progress: where to.
        core_seconds: an estimate for one core of the machine of docs/validation.md.
        workers: processes, 0 for one a core.
    """
    from knotgym.runs.executors import cores

    count = workers or cores()
    if core_seconds / count > _LONG:
        progress.say(
            f"this would take about {duration(core_seconds / count)} with {count} workers; Ctrl-C"
            " stops it"
        )


def compile_first(progress: Progress) -> None:
    """Have the labeller compiled, which takes a while the first time, before others wait for it."""
    from knotgym.topology.crossing_kernel import is_compiled

    if not is_compiled():
        from knotgym.rope.model import Rope
        from knotgym.topology.crossings import label

        progress.stage("compiling, in the first run only")
        label(Rope().loop())
    progress.stage("starting")
