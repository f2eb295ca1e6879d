"""Totals over the episodes of a run."""

from __future__ import annotations

from dataclasses import asdict, astuple, dataclass


@dataclass(frozen=True, kw_only=True)
class Tally:
    """Totals over episodes.

    Attributes:
        played, succeeded, kept: numbers of episodes.
        steps: actions of the kept episodes.
        successful_steps: actions of the successful episodes.
        planned_actions: actions simulated for planning.
        planning_seconds: time for planning; the only value that differs between identical runs.
        simulation_failures: episodes that ended because the simulation diverged.
    """

    played: int = 0
    succeeded: int = 0
    kept: int = 0
    steps: int = 0
    successful_steps: int = 0
    planned_actions: int = 0
    planning_seconds: float = 0.0
    simulation_failures: int = 0

    def __add__(self, other: Tally) -> Tally:
        pairs = zip(astuple(self), astuple(other), strict=True)
        return Tally(**dict(zip(asdict(self), map(sum, pairs), strict=True)))
