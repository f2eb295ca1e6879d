"""Options of a run that don't change its content, and the errors of a run that can't finish.

This module has no slow imports, because the command line reads options first.
"""

from dataclasses import dataclass

from knotgym.common.errors import InvalidInput
from knotgym.runs.shards import Shard

EXECUTORS = ("local", "dask")


@dataclass(frozen=True, kw_only=True)
class Existing:
    """What to do with the output of an earlier run; by default it is kept and the run refused.

    Attributes:
        resume: finish an interrupted run.
        restart: delete the work of an interrupted run and start again.
        overwrite: replace an existing output once the new one is complete.
    """

    resume: bool = False
    restart: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.resume and self.restart:
            raise InvalidInput(
                "--resume continues an interrupted run and --restart deletes its work: give only"
                " one of them"
            )


REFUSE_EXISTING = Existing()


@dataclass(frozen=True, kw_only=True)
class RunOptions(Existing):
    """Execution options; of these only the shard changes the output.

    Attributes:
        workers: worker processes, 0 for one per core; doesn't change the result.
        executor: what runs the work: local processes, or dask for a Dask cluster whose workers
            share a file system (needs the extra dask).
        scheduler: address of the Dask scheduler, such as tcp://127.0.0.1:8786.
        shard: 2/8 computes the second eighth of the run and leaves NAME-shard-2-of-8.journal beside
            the output; the same command without it merges the eight.
        quiet: print errors only.
    """

    workers: int = 0
    executor: str = "local"
    scheduler: str = ""
    shard: Shard = Shard()
    quiet: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.workers < 0:
            raise InvalidInput(f"workers must be at least 0, got {self.workers}")
        if self.executor not in EXECUTORS:
            raise InvalidInput(f"--executor takes {' or '.join(EXECUTORS)}, got {self.executor!r}")
        if self.executor == "local" and self.scheduler:
            raise InvalidInput(f"--scheduler {self.scheduler} is for --executor dask")
        if self.executor == "dask" and not self.scheduler:
            raise InvalidInput(
                "--executor dask needs the address of a scheduler, such as --scheduler"
                " tcp://127.0.0.1:8786"
            )
        if self.executor == "dask" and self.workers:
            raise InvalidInput(
                f"--workers {self.workers} is for --executor local; a Dask cluster uses all of its"
                " workers"
            )
