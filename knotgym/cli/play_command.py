"""The command `knotgym play`."""

import importlib.util
import time
from contextlib import ExitStack, suppress
from functools import partial

from knotgym.cli.collect_command import MINARI_ROOT
from knotgym.cli.options import Given, command, extra
from knotgym.common import MissingExtra, install_command
from knotgym.play import PageConfig


@command(
    {"": PageConfig},
    "task.task task.nx policy port",
    extra("record", bool),
    extra("id", str),
    MINARI_ROOT,
)
def play(given: Given) -> None:
    """Pull the rope by hand in a browser.

    Episodes are those that `knotgym evaluate` plays with the same seed, so that a recording is
    scored by `knotgym evaluate --policy recorded:DATASET`.

    Examples:

        knotgym play --task tie --nx 3 --record

    Args:
        record: Write finished and abandoned episodes to a Minari dataset, which later sessions
            continue.
        id: Its id; by default such as knotgym/tie-nx3/human-v0.
    """
    if importlib.util.find_spec("viser") is None:
        raise MissingExtra("viser", install_command("play"), "knotgym play")
    from knotgym.play import HandTab, Page, Recorder
    from knotgym.runs import compile_first

    config, progress = given.config(PageConfig), given.progress
    compile_first(progress, config.task.engine)
    with ExitStack() as stack:
        recorder = None
        if given["record"]:
            task = config.task
            mark = "" if task.split == "train" else f"-{task.split}"
            wanted = given["id"] or f"knotgym/{task.task}-nx{task.nx}/human{mark}-v0"
            recorder = stack.enter_context(
                Recorder(task, config.seed, wanted, config.player, given["out"])
            )
            progress.say(f"episodes are recorded in {recorder.folder}")
            if recorder.recovered:
                progress.say(f"stored {recorder.recovered} episodes of an interrupted session")
        tab = partial(HandTab, config=config, recorder=recorder)
        page = stack.enter_context(Page(config, tab))
        progress.say(f"open {page.address} in a browser; Ctrl-C ends it")
        with suppress(KeyboardInterrupt):
            while True:
                time.sleep(3600)
