"""The command `knotgym play`."""

from __future__ import annotations

import importlib.util
import time
from pathlib import Path
from typing import Annotated

import typer

from knotgym.cli.options import (
    HorizonOption,
    QuietOption,
    SeedOption,
    StatesOption,
    TowLimitOption,
    option,
)
from knotgym.runs.progress import Progress

_PAGE, _RECORD = "The page", "Recording"


def play(
    dataset: Annotated[
        str | None,
        typer.Argument(help="A dataset to watch, by path or id; without one, you pull the rope."),
    ] = None,
    task: Annotated[str, typer.Option(help="Task: tie, unknot or convert.")] = "tie",
    nx: Annotated[int, typer.Option(help="Number of crossings.")] = 2,
    split: Annotated[str, typer.Option(help="Split of the states: train or test.")] = "train",
    engine: Annotated[str, typer.Option(help="Engine: mujoco or chain.")] = "chain",
    policy: Annotated[
        str, typer.Option(help="Policy that gives hints and can take over, as in evaluate.")
    ] = "expert",
    compared: Annotated[
        str, typer.Option("--compare", help="Policy whose next pulls are shown beside it.")
    ] = "scripted",
    states: StatesOption = None,
    horizon: HorizonOption = 50,
    tow_limit: TowLimitOption = None,
    seed: SeedOption = 0,
    record: Annotated[
        bool,
        option(
            "--record",
            help="Write finished and abandoned episodes to a Minari dataset, and continue it in"
            " later sessions.",
            group=_RECORD,
        ),
    ] = False,
    dataset_id: Annotated[
        str,
        option("--id", help="Its id; by default such as knotgym/tie-nx3/human-v0.", group=_RECORD),
    ] = "",
    player: Annotated[
        str, option("--player", help="Who plays, in a few words; stored.", group=_RECORD)
    ] = "",
    out: Annotated[
        Path | None,
        option("--out", help="Minari root to write to; Minari's own by default.", group=_RECORD),
    ] = None,
    host: Annotated[
        str,
        option(
            "--host",
            help="Where to serve; any host but the loopback asks for a token.",
            group=_PAGE,
        ),
    ] = "127.0.0.1",
    port: Annotated[int, option("--port", help="Port of the page.", group=_PAGE)] = 8080,
    quiet: QuietOption = False,
) -> None:
    """Pull the rope by hand in a browser, or watch a dataset's episodes.

    Episodes are those that `knotgym evaluate` plays with the same seed, so that a recording is
    scored by `knotgym evaluate --policy recorded:DATASET`.
    """
    with Progress(quiet) as progress:
        progress.stage("loading the simulator")
        from contextlib import ExitStack

        from knotgym.common.errors import install_command
        from knotgym.envs.tasks import TaskConfig
        from knotgym.play.page import Page, PlayConfig, PlayError
        from knotgym.play.recorder import Recorder
        from knotgym.play.watch import WatchPage
        from knotgym.runs.progress import compile_first

        if importlib.util.find_spec("viser") is None:
            raise PlayError(f"the page needs viser; install it: {install_command('play')}")
        played = TaskConfig(
            task=task,
            nx=nx,
            split=split,
            states=None if states is None else str(states),
            observation="state",
            horizon=horizon,
            tow_limit=tow_limit,
            engine=engine,
        )
        config = PlayConfig(
            task=played, seed=seed, policy=policy, compared=compared, host=host, port=port
        )
        compile_first(progress)
        with ExitStack() as stack:
            recorder = None
            if dataset is None and record:
                default = "" if split == "train" else f"-{split}"
                wanted = dataset_id or f"knotgym/{task}-nx{nx}/human{default}-v0"
                recorder = stack.enter_context(Recorder(played, seed, wanted, player, out))
                progress.say(f"episodes are recorded in {recorder.folder}")
                if recorder.recovered:
                    progress.say(f"stored {recorder.recovered} episodes of an interrupted session")
            page = stack.enter_context(
                Page(config, recorder) if dataset is None else WatchPage(config, dataset)
            )
            progress.say(f"open {page.address} in a browser; Ctrl-C ends it")
            if page.token:
                progress.say(f"token: {page.token}")
            while True:
                time.sleep(3600)
