"""Options of a run that don't change its content, and the errors of a run that can't finish.

This module has no slow imports, because the command line reads options first.
"""

from dataclasses import dataclass

from knotgym.common.errors import KnotgymError
from knotgym.runs.shards import Shard


class InvalidRun(KnotgymError, ValueError):
    """A run can't be started or resumed as requested."""


class NotEnough(KnotgymError, RuntimeError):
    """The budget was used up before everything requested was made."""


@dataclass(frozen=True, kw_only=True)
class Existing:
    """What to do with the output of an earlier run; by default it is kept and the run refused.

    Attributes:
        resume: continue an interrupted run; a finished run of the same request counts as done.
        restart: delete the work of an interrupted run and start again.
        overwrite: replace a finished result once the new one is complete.
    """

    resume: bool = False
    restart: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.resume and self.restart:
            raise InvalidRun(
                "--resume continues an interrupted run and --restart deletes its work: give only"
                " one of them"
            )


REFUSE_EXISTING = Existing()


@dataclass(frozen=True, kw_only=True)
class RunOptions(Existing):
    """Execution options; of these only the shard changes the output.

    Attributes:
        workers: number of processes, 0 for one per core; 1 uses this process.
        scheduler: address of a Dask scheduler, whose cluster is used instead; "" for none.
        shard: which part of the run to make.
        quiet: print errors only.
    """

    workers: int = 0
    scheduler: str = ""
    shard: Shard = Shard()
    quiet: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.workers < 0:
            raise InvalidRun(f"workers must be at least 0, got {self.workers}")
