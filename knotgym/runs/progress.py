"""What a command shows: progress, a live line on a terminal, else plain lines on standard error;
and tables of results.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import timedelta
from functools import partial

from rich import box
from rich.console import Console
from rich.progress import Progress as Bars
from rich.progress import TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from knotgym.common import Counts

_LIVE_EVERY, _LINE_EVERY = 0.5, 10.0  # seconds between updates
_NONE: Mapping[str, object] = {}
_console = partial(Console, emoji=False, markup=False)  # names of others are shown as they are
_COMPILING = "compiling, once"  # what is counted, beside the stage that compiles first
_WORTH_SAYING = 5.0  # CPU seconds of a command
_ESTIMATED = 600.0  # seconds of the past by which the time left is estimated


class Progress:
    """Shows the progress of a run; a context manager that removes the live line at its end.

    While it is entered, it shows what `common.Counts` counts. If there is no terminal, plain lines
    are printed on standard error: with `lines` from the first moment, else after ten seconds.
    Whatever takes longer than that is named every ten seconds, even if nothing is done meanwhile; a
    stage with an estimate when that is over, and every thirty.
    `clock` returns seconds.
    """

    def __init__(
        self,
        quiet: bool = False,
        *,
        lines: bool = True,
        console: Console | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        # Keep the stream of now: `sys.stdout` is redirected while pyknotid runs, to hide its
        # output, and the live line must not follow.
        self.console = console or _console(file=sys.stdout)
        shown = self.console
        if not shown.is_terminal and console is None and sys.stderr.isatty():
            shown = _console(file=sys.stderr)  # output is piped, but a person is watching
        live = shown.is_terminal and not quiet
        self._bars = Bars(
            TextColumn("{task.description}", style="bold", markup=False),
            TextColumn("{task.fields[facts]}", markup=False),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=shown,
            refresh_per_second=1 / _LIVE_EVERY,
            speed_estimate_period=_ESTIMATED,
            transient=True,
            get_time=clock,
            disable=not live,
        )
        self._bars.add_task("loading libraries", total=None, facts="")
        self._task = self._bars.tasks[0]
        self._clock, self._began, self._used = clock, clock(), time.process_time()
        self._done: Callable[[], float] | None = None  # how many items of the stage are done by now
        self._facts: Mapping[str, object] = _NONE
        self._ends: float | None = None  # when the stage is over, about
        self._stage = threading.RLock()  # held while the stage is changed or read
        self._counted = False  # whether a count was printed
        self._told = self._began  # when anything was printed last
        self._over, self.quiet, plain = threading.Event(), quiet, not quiet and not live
        self._lines, self._waits = plain and lines, plain and not lines
        self._printed = console or _console(file=sys.stderr)

    def __enter__(self) -> Progress:
        self._bars.start()
        Counts.listeners.append(self.stage)
        if not self.quiet:
            threading.Thread(target=self._repeat, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Show nothing of stages any more; a second call does nothing."""
        if not self._over.is_set():
            self._over.set()
            self._bars.stop()
            Counts.listeners.remove(self.stage)

    def _repeat(self) -> None:
        """Keep the live line true, or print the stage when nothing was printed for ten seconds."""
        while not self._over.wait(min(_LIVE_EVERY, _LINE_EVERY)):
            if not (self._lines or self._waits):
                self._recount()
            elif (silent := self._clock() - self._told) >= _LINE_EVERY:
                is_over = self._ends is None or self._told < self._ends <= self._clock()
                if self._done or is_over or silent >= 3 * _LINE_EVERY:
                    self._tell(self._line())

    def _recount(self) -> None:
        """Read how far the stage is by now."""
        with self._stage:
            if self._done is not None:
                done = self._done()
                words = [f"{int(done)} of {self._task.total:.0f}"]
                words += [f"{fact} {value}" for fact, value in self._facts.items()]
                if Counts.compiling.value:
                    words.append(_COMPILING)
                elif self._ends and not done:
                    words.append(f"workers start, {self._wait()}")
                self._bars.update(self._task.id, completed=done, facts="; ".join(words))
            else:
                facts = _COMPILING * bool(Counts.compiling.value)
                self._bars.update(self._task.id, facts=self._wait() if self._ends else facts)

    def _wait(self) -> str:
        """Say how long the stage, or what comes before its first item, still takes."""
        left = (self._ends or 0.0) - self._clock()
        return f"about {left:.0f} s left" if left >= 1 else "it takes longer than usual"

    def _line(self) -> str:
        """Return the stage, how far it is, and the time left."""
        self._recount()
        task, facts = self._task, self._task.fields["facts"]
        if not facts:
            return task.description
        left = task.time_remaining
        more = f"; time left {timedelta(seconds=round(left))}" if left else ""
        return f"{task.description}: {facts}{more}"

    def say(self, *lines: str) -> None:
        """Print permanent lines."""
        for line in lines if not self.quiet else ():
            self.console.print(line, soft_wrap=True, highlight=False, markup=False)

    def say_seconds(self) -> None:
        """Print the CPU time so far, with that of workers, which `time` leaves out."""
        total = time.process_time() + Counts.worker_seconds
        if total - self._used >= _WORTH_SAYING and not self.quiet:
            line = f"{total:.0f} CPU seconds{', workers included' * bool(Counts.worker_seconds)}"
            self._printed.print(line, soft_wrap=True, highlight=False, markup=False)

    def _tell(self, line: str) -> None:
        self._told = self._clock()
        line = f"{self._clock() - self._began:5.0f} s  {line}"
        self._printed.print(line, soft_wrap=True, highlight=False, markup=False)

    def stage(
        self,
        name: str,
        done: Counts.Done = 0,
        total: int = 0,
        facts: Mapping[str, object] = _NONE,
        lasts: float = 0.0,
    ) -> None:
        """Set the current stage and how far it is; plain lines show stages until the first count.

        Args:
            name: name of the stage.
            done, total: how many items are done, or what returns how many are done by now, and how
                many there are; all take about as long.
            facts: other values to show, by name.
            lasts: about how many seconds the stage takes, which are counted down; with a total,
                how long workers take to start before the first item.
        """
        with self._stage:
            if name != self._task.description:
                self._bars.reset(self._task.id, description=name, facts="")
                self._ends = self._clock() + lasts if lasts else None
                self._done = None
                is_told = self._lines and not self._counted or self._waits and lasts >= _LINE_EVERY
                if is_told and not total:
                    self._tell(self._line())
            self._done = (done if callable(done) else lambda: done) if total else None
            self._facts = facts
            if not total:
                return
            self._bars.update(self._task.id, total=total)
            self._recount()
            now, is_over = self._clock(), self._task.completed == total
        is_due = now - self._told >= _LINE_EVERY
        if (self._waits and is_due) or (self._lines and (is_due or is_over or not self._counted)):
            self._counted = True
            self._tell(self._line())


def narrow_table(
    columns: Iterable[str], title: str | None = None, left: Sequence[str] = ()
) -> Table:
    """Make a table for terminals of 80 columns, which output to a pipe has too.

    It has no vertical rules, and only the first column may wrap.
    """
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for index, column in enumerate(columns):
        table.add_column(column, no_wrap=index > 0, overflow="fold")
        table.columns[-1].justify = "left" if column in left else "right"
    return table
