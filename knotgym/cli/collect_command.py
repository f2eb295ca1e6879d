"""The command `knotgym collect`."""

from itertools import product
from pathlib import Path
from typing import Any

from knotgym.cli.options import RUN, Given, command, extra
from knotgym.generate import CollectConfig

MINARI_ROOT = extra("out", Path, help="Minari root to write to; Minari's own by default.")


@command(
    {"": CollectConfig},
    "episodes policy.policy task.split keep_failed=--keep-failed/--drop-failed"
    f" dataset_id=--id form task.states task.observation task.engine {RUN}",
    extra("task", tuple[str, ...], ("tie",)),
    extra("nx", tuple[int, ...], (2,)),
    MINARI_ROOT,
)
def collect(given: Given) -> None:
    """Roll out a policy and write its episodes as a Minari dataset.

    Several tasks or values of --nx make one dataset each; with --id they make a single one, whose
    episodes each draw one of their combinations.

    Examples:

        knotgym collect --task tie --nx 3 --policy expert --episodes 200

        knotgym collect --task tie,convert --nx 2-4 --id knotgym/several-v0

        knotgym collect --task unknot --nx 2-4 --policy mine:act

        knotgym collect --policy pretrained --set labels=expert

    Args:
        task: Tasks, comma-separated: tie, unknot, convert.
        nx: Numbers of crossings: 3, 2,3 or 0-4.
    """
    from knotgym.datasets import loading_lines
    from knotgym.generate import collect as run
    from knotgym.generate import named, require_collectable

    options, out = given.run, given["out"]
    several = [
        given[name] if name in given.typed else given.get(f"task.{name}") for name in ("task", "nx")
    ]
    if given.get("dataset_id"):
        pairs = [tuple(one[0] if len(one) == 1 else one for one in map(_listed, several))]
    else:
        every = [*product(*map(_listed, several))]
        # settings may hold anything, also what can't be hashed; it is refused below
        pairs = [pair for number, pair in enumerate(every) if pair not in every[:number]]
    seen = "" if given.has("task.observation") else "state"
    configs = [
        named(
            given.config(
                CollectConfig,
                {"task.task": task, "task.nx": nx},
                usual={"policy_observation": seen},
            )
        )
        for task, nx in pairs
    ]
    for config in configs:  # refuse any of them before playing the first
        require_collectable(config, out, options)
    for config in configs:
        run(config, out, options, progress=given.progress)
        if options.shard.is_whole:
            given.progress.say_how_to_load(loading_lines(config.dataset_id, out))


def _listed(value: Any) -> tuple[Any, ...]:
    return tuple(value) if isinstance(value, (list, tuple)) else (value,)
