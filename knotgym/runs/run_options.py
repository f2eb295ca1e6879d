"""How a run is done, as any caller says it, and how it ends when it can't be done.

This module imports nothing heavy: the command line reads options before anything else.
"""

from __future__ import annotations

from dataclasses import dataclass

from knotgym.errors import KnotgymError
from knotgym.runs.shards import Shard


class InvalidRun(KnotgymError, ValueError):
    """A run that cannot be made, or gone on with, as asked."""


class NotEnough(KnotgymError, RuntimeError):
    """What was allowed was spent before everything asked for was there."""


@dataclass(frozen=True, kw_only=True)
class Existing:
    """What is to become of what an earlier run left; by default it is refused, and stays.

    Attributes:
        resume: go on from an interrupted run, and take a finished one of the same request as done.
        restart: throw an interrupted run's work away and begin anew.
        overwrite: replace a finished result, once the new one is whole.
    """

    resume: bool = False
    restart: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.resume and self.restart:
            raise InvalidRun(
                "--resume goes on from an interrupted run, --restart throws it away: give one of"
                " them"
            )


REFUSE_EXISTING = Existing()


@dataclass(frozen=True, kw_only=True)
class RunOptions(Existing):
    """How a run is done. Nothing here but the shard changes a byte of what is made.

    Attributes:
        workers: processes, 0 for one a core; 1 works in this process.
        scheduler: address of a Dask cluster's scheduler, to work there instead.
        shard: of the run.
        quiet: show nothing but errors.
    """

    workers: int = 0
    scheduler: str = ""
    shard: Shard = Shard()
    quiet: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.workers < 0:
            raise InvalidRun(f"workers must be at least 0, got {self.workers}")
