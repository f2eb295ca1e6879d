"""The command line: what a user types, turned into a configuration; every mistake is one line and
exit status 2.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from knotgym.cli.dataset_commands import dataset_app
from knotgym.cli.options import EngineOption, SchedulerOption, ShardOption
from knotgym.cli.policy_commands import collect, evaluate
from knotgym.errors import KnotgymError
from knotgym.runs.executors import LostWorkers, scheduler_of
from knotgym.runs.shards import Shard

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Data for spatial reasoning on knots.",
)
app.add_typer(dataset_app, name="dataset")
app.command()(collect)
app.command()(evaluate)

Nx = Annotated[str, typer.Option("--nx", help="Crossings: 3, or 2,3, or 0-4.")]
Seed = Annotated[int, typer.Option(help="Of everything; the same seed gives the same bytes.")]
Workers = Annotated[
    int, typer.Option(help="Processes; 0 for one a core. Does not change the result.")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Say nothing but errors.")]
Resume = Annotated[bool, typer.Option("--resume", help="Finish an interrupted run.")]

# ClickException, be it Click's own or the copy inside typer
_USAGE: Any = typer.BadParameter.__mro__[2]
_FAILED, _MISTAKEN, _INTERRUPTED = 1, 2, 130
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_STOPPED = "interrupted; nothing half-written is left, --resume goes on from the last cycle"


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


@app.command()
def generate(
    nx: Nx = "3",
    count: Annotated[
        int,
        typer.Option(
            help="States for each number of crossings, of as many different codes as there are."
        ),
    ] = 40,
    out: Annotated[
        Path | None, typer.Option(help="Folder to make; knotgym-data/nx3 for --nx 3.")
    ] = None,
    every_code: Annotated[
        int, typer.Option(help="Instead of --count: so many states of every code there is.")
    ] = 0,
    balance: Annotated[
        str,
        typer.Option(
            help='"even" over codes, or "empirical": as often as a random policy meets them.'
        ),
    ] = "even",
    split_by: Annotated[
        str, typer.Option(help='"state", or "code": train and test share no code.')
    ] = "state",
    knot: Annotated[
        str,
        typer.Option(
            help="0_1, 3_1, 4_1, 5_1, or a file with a closed curve, three numbers a line or .npy."
        ),
    ] = "0_1",
    archive: Annotated[
        Path | None, typer.Option(help="Go on from the archive of another run (its archive.h5).")
    ] = None,
    attempts: Annotated[
        int, typer.Option(help="Candidates tried, for each state wanted, before giving up.")
    ] = 100,
    cycles: Annotated[
        int,
        typer.Option(
            help=(
                "Stop after so many rounds of searching and choosing, with what there is; 0: when"
                " all is there."
            )
        ),
    ] = 0,
    seed: Seed = 0,
    workers: Workers = 0,
    engine: EngineOption = "local",
    scheduler: SchedulerOption = "",
    shard: ShardOption = "",
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Make curated states, split into train and test, with the trajectories that reach them."""
    from knotgym.generate.states.curation_run import GenerateConfig
    from knotgym.generate.states.state_recipe import generate as run_job

    cluster, wanted, part = (
        scheduler_of(engine, scheduler, workers),
        numbers(nx),
        Shard.parse(shard),
    )
    config = GenerateConfig(
        nx=wanted,
        count=count,
        every_code=every_code,
        balance=balance,
        split_by=split_by,
        knot=knot,
        seed=seed,
        attempts=attempts,
        cycles=cycles,
        shard=part,
    )
    target = part.folder(out or Path("knotgym-data") / f"nx{nx.replace(' ', '')}")
    run_job(
        config,
        target,
        archive=archive,
        workers=workers,
        resume=resume,
        quiet=quiet,
        console=Console(),
        scheduler=cluster,
    )


@app.command()
def images(
    nx: Nx = "0-4",
    count: Annotated[
        int, typer.Option(help="Pictures in all, evenly over the numbers of crossings.")
    ] = 20_000,
    out: Annotated[
        Path | None, typer.Option(help="Folder to make; knotgym-data/images-nx0-4 for --nx 0-4.")
    ] = None,
    archive: Annotated[
        Path | None, typer.Option(help="Set out from the archive of a run (its archive.h5).")
    ] = None,
    states: Annotated[
        Path | None,
        typer.Option(help="Set out from a states.h5; without either, from the states that ship."),
    ] = None,
    test_nx: Annotated[
        str, typer.Option(help="Crossings that only split test-nx shows; the largest, or none.")
    ] = "largest",
    test_share: Annotated[float, typer.Option(help="Share of split test.")] = 0.15,
    code_share: Annotated[
        float, typer.Option(help="Share of split test-code, and of codes that only it shows.")
    ] = 0.15,
    vary: Annotated[
        str, typer.Option(help="Of colours,width,background,turn,zoom,noise,blur; all, or none.")
    ] = "none",
    size: Annotated[
        str,
        typer.Option(help="Pixels of a side, 64 to 512; several, such as 64,128, are drawn from."),
    ] = "128",
    seed: Seed = 0,
    workers: Workers = 0,
    engine: EngineOption = "local",
    scheduler: SchedulerOption = "",
    shard: ShardOption = "",
    resume: Resume = False,
    quiet: Quiet = False,
) -> None:
    """Make a perception dataset: pictures with Gauss code, crossings, coordinates and
    difficulty.
    """
    from knotgym.generate.images.image_recipe import ImagesConfig, make
    from knotgym.rendering.appearance import VARIED, AppearanceConfig

    cluster, wanted, part, sizes = (
        scheduler_of(engine, scheduler, workers),
        numbers(nx),
        Shard.parse(shard),
        size.split(","),
    )
    if not all(one.strip().isdecimal() for one in sizes):
        raise typer.BadParameter(f"--size takes pixels such as 128 or 64,128, got {size!r}")
    varied = (
        {"all": VARIED, "none": ()}.get(vary)
        if vary in ("all", "none")
        else tuple(word.strip() for word in vary.split(","))
    )
    config = ImagesConfig(
        nx=wanted,
        count=count,
        test_nx=(
            {"largest": None, "none": ()}[test_nx]
            if test_nx in ("largest", "none")
            else numbers(test_nx)
        ),
        test_share=test_share,
        code_share=code_share,
        seed=seed,
        appearance=AppearanceConfig(vary=varied or (), sizes=tuple(map(int, sizes))),
        shard=part,
    )
    target = part.folder(out or Path("knotgym-data") / f"images-nx{nx.replace(' ', '')}")
    make(
        config,
        target,
        archive=archive,
        states=states,
        workers=workers,
        resume=resume,
        quiet=quiet,
        console=Console(),
        scheduler=cluster,
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run `knotgym`; exits with 0 only when everything asked for was done."""
    _run(app, arguments)


def main_generate(arguments: Sequence[str] | None = None) -> None:
    """Run `knotgym-generate`, the same as `knotgym generate`."""
    _run(app, ["generate", *(sys.argv[1:] if arguments is None else arguments)])


def _run(command: typer.Typer, arguments: Sequence[str] | None) -> None:
    from knotgym.generate.states.curation_run import NotEnough

    for number in _SIGNALS:
        signal.signal(number, _interrupt)
    try:
        result = command(args=arguments, standalone_mode=False)
        status = result if isinstance(result, int) else 0
        if status == _INTERRUPTED:  # what typer makes of a KeyboardInterrupt
            _say(_STOPPED, status)
    except (NotEnough, LostWorkers) as error:
        status = _say(str(error), _FAILED)
    except _USAGE as error:
        # the help was shown, if empty
        status = _say(error.format_message(), _MISTAKEN) if error.format_message() else _MISTAKEN
    except (KnotgymError, ValueError, FileNotFoundError) as error:
        status = _say(str(error), _MISTAKEN)
    except BrokenExecutor:
        status = _say(
            "a worker died, perhaps for want of memory; --resume goes on from the last cycle",
            _FAILED,
        )
    except OSError as error:
        status = _say(_trouble(error), _FAILED)
    except (KeyboardInterrupt, typer.Abort):
        status = _say(_STOPPED, _INTERRUPTED)
    sys.exit(status)


def _interrupt(number: int, frame: object) -> None:
    for one in _SIGNALS:
        signal.signal(one, _end)
    sys.unraisablehook = _unraisable
    raise KeyboardInterrupt


def _unraisable(error: sys.UnraisableHookArgs) -> None:
    """After an interruption: silence of what was half made and is taken down; but the interruption
    itself is never swallowed.
    """
    if issubclass(error.exc_type, KeyboardInterrupt):
        _end(0, None)


def _end(number: int, frame: object) -> None:
    """Asked to stop again while clearing up: leave at once. What is half-written has no final name,
    and workers end with their parent.
    """
    shown = "\x1b[?25h" if sys.stderr.isatty() else ""  # a live table had hidden the cursor
    os.write(2, f"{shown}knotgym: {_STOPPED}\n".encode())
    os._exit(_INTERRUPTED)


def _trouble(error: OSError) -> str:
    """What the system says, without what a library adds to it."""
    said = os.strerror(error.errno) if error.errno else str(error)
    return f"{said} {error.filename or ''}"


def _say(text: str, status: int) -> int:
    """One line on standard error."""
    if status == _INTERRUPTED:
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)  # it is the last
    print(f"knotgym: {' '.join(text.split())}", file=sys.stderr)
    return status
