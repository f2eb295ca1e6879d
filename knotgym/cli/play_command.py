"""The command `knotgym play`."""

import importlib.util
import time
from contextlib import suppress

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
    from knotgym.play import serve
    from knotgym.runs import compile_first

    config, progress = given.config(PageConfig), given.progress
    compile_first(progress, config.task.engine)
    task, dataset = config.task, ""
    if given["record"]:
        mark = "" if task.split == "train" else f"-{task.split}"
        dataset = given["id"] or f"knotgym/{task.task}-nx{task.nx}/human{mark}-v0"
    with serve(config, progress.say, dataset, given["out"]), suppress(KeyboardInterrupt):
        progress.__exit__()  # what is left isn't progress, of which it would tell for ever
        while True:
            time.sleep(3600)
