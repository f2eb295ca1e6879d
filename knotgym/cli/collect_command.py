"""The command `knotgym collect`."""

from pathlib import Path

from knotgym.cli.options import RUN, Given, command, extra
from knotgym.common.errors import InvalidInput
from knotgym.generate.episodes.collect_config import CollectConfig

MINARI_ROOT = extra("out", Path, help="Minari root to write to; Minari's own by default.")


@command(
    {"": CollectConfig},
    "task.task episodes policy.policy task.split keep_failed=--keep-failed/--drop-failed"
    f" dataset_id=--id task.states task.observation task.engine {RUN}",
    extra("nx", tuple[int, ...], (2,)),
    MINARI_ROOT,
)
def collect(given: Given) -> None:
    """Roll out a policy and write its episodes as a Minari dataset.

    Several values of --nx make one dataset each.

    Examples:

        knotgym collect --task tie --nx 3 --policy expert --episodes 200

        knotgym collect --task unknot --nx 2-4 --policy mine:act

        knotgym collect --policy pretrained --set labels=expert

    Args:
        nx: Numbers of crossings: 3, 2,3 or 0-4.
    """
    from knotgym.datasets.minari_form import loading_lines
    from knotgym.generate.episodes.collect import collect as run
    from knotgym.generate.episodes.collect import named, require_collectable

    options, out = given.run, given["out"]
    crossings = given["nx"] if "nx" in given.typed else [given.get("task.nx")]
    if given.get("dataset_id") and len(crossings) > 1:
        raise InvalidInput(
            f"--id names one dataset, but --nx makes {len(crossings)}: leave out --id or give a"
            " single --nx"
        )
    seen = "" if given.has("task.observation") else "state"
    configs = [
        named(given.config(CollectConfig, {"task.nx": nx}, usual={"seen": seen}))
        for nx in crossings
    ]
    for config in configs:  # refuse any of them before playing the first
        require_collectable(config, out, options)
    for config in configs:
        run(config, out, options, progress=given.progress)
        if options.shard.is_whole:
            given.progress.say_how_to_load(loading_lines(config.dataset_id, out))
