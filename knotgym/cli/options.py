"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

EngineOption = Annotated[
    str,
    typer.Option(
        help="local, or dask: the workers of a Dask cluster, on a file system that all of them see."
    ),
]
ShardOption = Annotated[
    str,
    typer.Option(
        help=(
            "2/8: make the second eighth of the run, in NAME-shard-2-of-8; `knotgym dataset merge`"
            " puts all eight together."
        )
    ),
]
SchedulerOption = Annotated[
    str, typer.Option(help="Address of the cluster's scheduler, such as tcp://127.0.0.1:8786.")
]
