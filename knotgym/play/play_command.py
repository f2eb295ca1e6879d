"""The command `knotgym play`."""

import time
from contextlib import suppress
from pathlib import Path

from knotgym import runs
from knotgym.cli import Given, command
from knotgym.common import MissingExtra
from knotgym.play.page_config import PageConfig


@command({"": PageConfig}, "task.task task.nx policy.policy port")
def play(given: Given, *, record: bool = False, id: str = "", out: Path | None = None) -> None:
    """Pull the rope by hand in a browser.

    Episodes are those that `knotgym evaluate` plays with the same seed, and `knotgym
    dataset show` prints how many of a recording's succeeded.

    Examples:

        knotgym play --task tie --nx 3 --record

    Args:
        record: Write finished and abandoned episodes to a Minari dataset, which later sessions
            continue.
        id: Its id; by default such as knotgym/tie-nx3/human-v0.
        out: Minari root to write to; Minari's own by default.
    """
    config, progress = given.config(PageConfig), given.progress
    MissingExtra.imported("viser", "play", "knotgym play")
    from knotgym.play.page import serve  # needs viser
    from knotgym.states import states_mark

    runs.compile_first(progress, engine=config.task.engine)
    task, dataset = config.task, ""
    if record:
        marks = "" if task.split == type(task).split else task.split, states_mark(task.states)
        name = "-".join(["human", *filter(None, marks)])
        dataset = id or f"knotgym/{task.task}-nx{task.nx}/{name}-v0"
    with serve(config, progress.say, dataset, out) as page, suppress(KeyboardInterrupt):
        # in the block, as who reads it may end it at once
        progress.say(f"open {page.address} in a browser; Ctrl-C ends it")
        progress.end()  # what is left isn't progress, of which it would tell for ever
        while True:
            time.sleep(1)  # a signal that comes just before a sleep waits for its end
