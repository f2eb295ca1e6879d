"""Options of a run that don't change its content.

This module has no slow imports, because the command line reads options first.
"""

from typing import Annotated, Any

from pydantic import BeforeValidator

from knotgym.common.configuration import Whole, configuration
from knotgym.common.errors import InvalidInput
from knotgym.runs.shards import Shard


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
        scheduler: address of a Dask scheduler, such as tcp://127.0.0.1:8786, whose workers share a
            file system and run the work (needs the extra dask); by default local processes do.
        shard: 2/8 makes the second eighth of the run, and leaves its journal; the same run without
            a shard, where all eight journals lie, makes the output.
        quiet: print errors only.
    """

    workers: Whole = 0
    scheduler: str = ""
    shard: Annotated[Shard, BeforeValidator(_shard)] = Shard()
    quiet: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scheduler and self.workers:
            raise InvalidInput(
                f"--workers {self.workers} is for local processes; a Dask cluster uses all of its"
                " workers"
            )
