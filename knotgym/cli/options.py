"""Options that several commands share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from knotgym.configuration import Config, InvalidConfig, updated
from knotgym.runs.executors import scheduler_of
from knotgym.runs.run_options import RunOptions
from knotgym.runs.shards import Shard
from knotgym.topology.gauss import GaussCode

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
NxOption = Annotated[str, typer.Option("--nx", help="Crossings: 3, or 2,3, or 0-4.")]
SeedOption = Annotated[int, typer.Option(help="Of everything; the same seed gives the same bytes.")]
WorkersOption = Annotated[
    int, typer.Option(help="Processes; 0 for one a core. Does not change the result.")
]
QuietOption = Annotated[bool, typer.Option("--quiet", help="Say nothing but errors.")]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Finish an interrupted run.")]

# ClickException, be it Click's own or the copy inside typer
SettingsOption = Annotated[
    Path | None,
    typer.Option(
        "--settings",
        help="JSON file of further settings, named as `config` in manifest.json names them.",
    ),
]


def numbers(text: str) -> tuple[int, ...]:
    """Read "3", "2,3" or "0-4".

    >>> numbers("0-2,4")
    (0, 1, 2, 4)
    """
    out: list[int] = []
    for word in text.split(","):
        low, dash, high = word.strip().partition("-")
        if (
            not low.isdecimal()
            or (dash and not high.isdecimal())
            or len(word.strip()) > 5
            or (dash and int(high) < int(low))
        ):
            raise typer.BadParameter(
                f"--nx takes numbers of crossings such as 3, 2,3 or 0-4, got {text!r}"
            )
        out += range(int(low), int(high if dash else low) + 1)
    return tuple(dict.fromkeys(out))


def code_list(path: Path | None) -> list[GaussCode]:
    """The Gauss codes in a file, one a line; none of no file.

    Raises:
        InvalidGaussCode: a line is none.
    """
    if path is None:
        return []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise typer.BadParameter(f"--codes {path} can't be read: {error}") from error
    found = [GaussCode.parse(line) for line in lines if line.strip()]
    if not found:
        raise typer.BadParameter(f"--codes {path} holds no code")
    return found


def run_options(
    engine: str, scheduler: str, workers: int, shard: str, resume: bool, quiet: bool
) -> RunOptions:
    """What the options of a run say together."""
    return RunOptions(
        workers=workers,
        scheduler=scheduler_of(engine, scheduler, workers),
        shard=Shard.parse(shard),
        resume=resume,
        quiet=quiet,
    )


def with_settings(config: Config, path: Path | None) -> Config:
    """A configuration changed by a --settings file.

    Raises:
        InvalidConfig: the file can't be read as JSON, or names what isn't there.
    """
    if path is None:
        return config
    try:
        changes = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidConfig(f"--settings {path} can't be read as JSON: {error}") from error
    return updated(config, changes)
