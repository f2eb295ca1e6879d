"""Options of a run that don't change its content.

This module has no slow imports, because the command line reads options first.
"""

from typing import Annotated, Any

from pydantic import BeforeValidator

from knotgym.common.configuration import Whole, choice, configuration
from knotgym.common.errors import InvalidInput
from knotgym.runs.shards import Shard

EXECUTORS = ("local", "dask")


def _shard(value: Any) -> Any:
    return Shard.parse(value) if isinstance(value, str) else value


@configuration
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


@configuration
class RunOptions(Existing):
    """Execution options; they don't change the output, but a shard makes a part of it.

    Attributes:
        workers: worker processes, 0 for one per core; doesn't change the result.
        executor: what runs the work: local processes, or dask for a Dask cluster whose workers
            share a file system (needs the extra dask).
        scheduler: address of the Dask scheduler, such as tcp://127.0.0.1:8786.
        shard: 2/8 makes the second eighth of the run, and leaves its journal; the same run without
            a shard, where all eight journals lie, makes the output.
        quiet: print errors only.
    """

    workers: Whole = 0
    executor: Annotated[str, choice(*EXECUTORS)] = "local"
    scheduler: str = ""
    shard: Annotated[Shard, BeforeValidator(_shard)] = Shard()
    quiet: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.executor == "local" and self.scheduler:
            raise InvalidInput("a scheduler is for Dask: --set run.executor=dask")
        if self.executor == "dask" and not self.scheduler:
            raise InvalidInput(
                "Dask needs the address of a scheduler, such as --set"
                " run.scheduler=tcp://127.0.0.1:8786"
            )
        if self.executor == "dask" and self.workers:
            raise InvalidInput(
                f"--workers {self.workers} is for local processes; a Dask cluster uses all of its"
                " workers"
            )
