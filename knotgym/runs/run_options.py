"""Options of a run that don't change its content: workers, shards, and what is there already.

This module has no slow imports, because the command line reads options first.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, NonNegativeInt

from knotgym.common import InvalidInput, Mark, configuration


@dataclass(frozen=True)
class Shard:
    """Shard `number`, counted from 1, of `of` shards, such as 2/8.

    It computes every eighth of a run's results, from the second. Results don't depend on the shard
    that computes them. A whole run is shard 1 of 1.
    """

    number: int = 1
    of: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.of:
            raise InvalidInput(f"a shard is i/n with i from 1 to n, such as 2/8; got {self}")

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    @classmethod
    def parse(cls, text: Any) -> Any:
        """Parse "2/8", where "" means the whole run; return what isn't text as it is."""
        if not text or not isinstance(text, str):
            return text or cls()
        words = text.split("/")
        if len(words) != 2 or not all(word.isdecimal() and len(word) < 7 for word in words):
            raise InvalidInput(f"a shard is i/n with i from 1 to n, such as 2/8; got {text!r}")
        return cls(*map(int, words))

    @property
    def is_whole(self) -> bool:
        """Whether this is the only shard."""
        return self.of == 1

    def journal(self, out: Path) -> Path:
        """Return the journal that this shard leaves beside the output `out` of the whole run."""
        return out.with_name(f"{out.name}-shard-{self.number}-of-{self.of}.journal")


WHOLE = Shard()


@configuration
class RunOptions:
    """Execution options; they don't change the output, but a shard makes a part of it.

    The output of an earlier run is kept and the run refused, unless the first three say otherwise.

    Attributes:
        resume: finish an interrupted run.
        restart: delete the work of an interrupted run and start again.
        overwrite: replace an existing output once the new one is complete.
        workers: worker processes, 0 for one per core; doesn't change the result.
        scheduler: address of a Dask scheduler, such as tcp://127.0.0.1:8786, whose workers share a
            file system and run the work (needs the extra dask); by default local processes do.
        shard: 2/8 makes the second eighth of the run, and leaves its journal; the same run without
            a shard, where all eight journals lie, makes the output.
        quiet: print results and errors only.
    """

    resume: bool = False
    restart: bool = False
    overwrite: bool = False
    workers: NonNegativeInt = 0
    scheduler: Annotated[str, Mark("typed")] = ""
    shard: Annotated[Shard, BeforeValidator(Shard.parse)] = Shard()
    quiet: bool = False

    def __post_init__(self) -> None:
        if self.resume and self.restart:
            raise InvalidInput("--resume and --restart exclude each other: give only one of them")
        if self.scheduler and self.workers:
            raise InvalidInput(f"--workers {self.workers} is for local processes, not clusters")
