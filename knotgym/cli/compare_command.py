"""The command `knotgym compare`."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from knotgym.cli.options import Given, command
from knotgym.common import InvalidInput

Files = Annotated[
    list[Path] | None,
    Parameter(name="FILES", help="Files of `knotgym evaluate --record` or --out."),
]


@command({}, "")
def compare(given: Given, files: Files = None, /) -> None:
    """Compare results: differences of success rates with intervals.

    For each task, number of crossings and split, every result is compared with the first one, and
    paired by episode where starts are the same. "better" is the probability that it has the higher
    rate on new states. Entries (--record) are replayed first.

    Examples:

        knotgym compare clone.h5 random.h5
    """
    from knotgym.generate import compare as run
    from knotgym.runs import compile_first

    if not files:
        raise InvalidInput("name files of `knotgym evaluate --record` or --out")
    compile_first(given.progress)
    given.progress.stage("replaying entries")
    run(files, given.progress.console)
