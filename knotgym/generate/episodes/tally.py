"""Totals over the episodes of a run."""

from dataclasses import dataclass

from knotgym.common.tables import Table


@dataclass(frozen=True, kw_only=True)
class Tally:
    """Totals over episodes.

    Attributes:
        played, succeeded, kept: numbers of episodes.
        steps: pulls of the kept episodes.
        planned: pulls simulated for planning.
        failed: episodes that ended because the simulation blew up.
    """

    played: int = 0
    succeeded: int = 0
    kept: int = 0
    steps: int = 0
    planned: int = 0
    failed: int = 0


def tally(episodes: Table, keep_failed: bool = True) -> Tally:
    """Add up episodes; failed ones may be dropped from the set."""
    success, lengths = episodes["success"], episodes["length"]
    kept = success | keep_failed
    return Tally(
        played=episodes.rows,
        succeeded=int(success.sum()),
        kept=int(kept.sum()),
        steps=int(lengths[kept].sum()),
        planned=int(episodes["planned"].sum()),
        failed=int(episodes["failed"].sum()),
    )
