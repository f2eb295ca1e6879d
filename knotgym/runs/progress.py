"""What a person sees while a job runs: a live table on a terminal, plain lines elsewhere, nothing
when asked to be quiet.
"""

from __future__ import annotations

import time
from collections import Counter

from rich.console import Console
from rich.live import Live
from rich.table import Table

from knotgym.generate.states.curation_run import Job

_EVERY = 10.0  # seconds between plain lines


class Progress:
    """Shows a job after each of its cycles; a context manager."""

    def __init__(self, console: Console, quiet: bool) -> None:
        self._console, self._quiet = console, quiet
        self._live = (
            Live(console=console, transient=True) if console.is_terminal and not quiet else None
        )
        self._began, self._told = time.perf_counter(), 0.0

    def __enter__(self) -> Progress:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def cycle(self, job: Job) -> None:
        """Show where the job stands."""
        if self._quiet:
            return
        accepted = sum(len(candidates) for candidates in job.accepted.values())
        wanted = sum(job.wanted(nx) for nx in job.config.nx)
        actions = job.steps()
        seconds = time.perf_counter() - self._began
        codes = len(
            {
                candidate.code.plain
                for candidates in job.accepted.values()
                for candidate in candidates
            }
        )
        rejected: Counter[str] = sum(job.rejected.values(), Counter())
        left = seconds * (wanted - accepted) / accepted if accepted else float("nan")
        facts = {
            "states accepted": f"{accepted} of {wanted}",
            "distinct codes": f"{codes}",
            "codes the search knows": ", ".join(
                f"nx {nx}: {len(job.archive.codes(nx))} of {job.existing[nx]}"
                for nx in job.config.nx
            ),
            "rejected": (
                ", ".join(f"{reason} {count}" for reason, count in rejected.most_common(4))
                or "none"
            ),
            "steps per second": f"{actions / max(job.seconds, 1e-9):.0f}",
            "time left, about": "?" if left != left else f"{left:.0f} s",
        }
        if self._live:
            table = Table.grid(padding=(0, 2))
            for name, value in facts.items():
                table.add_row(f"[bold]{name}", value)
            self._live.update(table)
        elif seconds - self._told > _EVERY or accepted >= wanted:
            self._told = seconds
            self._console.print(
                f"{seconds:5.0f} s  "
                + "; ".join(f"{name} {value}" for name, value in facts.items()),
                soft_wrap=True,
                highlight=False,
            )
