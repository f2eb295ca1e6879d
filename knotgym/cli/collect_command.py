"""The command `knotgym collect`."""

from itertools import product
from pathlib import Path

from knotgym.cli.options import RUN, Given, Listed, Numbers, command, numbers
from knotgym.generate import CollectConfig


@command(
    {"": CollectConfig},
    "episodes policy.policy task.split keep_failed=--keep-failed/--drop-failed"
    f" dataset_id=--id form task.states task.observation task.engine {RUN}",
)
def collect(
    given: Given, *, task: Listed = None, nx: Numbers = None, out: Path | None = None
) -> None:
    """Roll out a policy and write its episodes as a Minari dataset.

    Several tasks or values of --nx make one dataset each; with --id they make a single one, whose
    episodes each draw one of their combinations.

    Examples:

        knotgym collect --task tie --nx 3 --policy expert --episodes 200

        knotgym collect --task tie,convert --nx 2-4 --id knotgym/several-v0

        knotgym collect --task unknot --nx 2-4 --policy mine:act

        knotgym collect --policy pretrained --set labels=expert

    Args:
        task: Tasks, comma-separated: tie, unknot, convert; tie by default.
        nx: Numbers of crossings: 3, 2,3 or 0-4; 2 by default.
        out: Minari root to write to; Minari's own by default.
    """
    from knotgym.datasets import loading_lines
    from knotgym.generate import collect as run
    from knotgym.generate import require_collectable

    options = given.run
    several = [
        given.get("task.task") if task is None else [one.strip() for one in task.split(",")],
        given.get("task.nx") if nx is None else numbers(nx),
    ]
    several = [[*one] if isinstance(one, (list, tuple)) else [one] for one in several]
    if given.get("dataset_id"):
        pairs = [tuple(one[0] if len(one) == 1 else one for one in several)]
    else:
        every = [*product(*several)]
        # settings may hold anything, also what can't be hashed; it is refused below
        pairs = [pair for number, pair in enumerate(every) if pair not in every[:number]]
    usual = {"policy_observation": "" if given.has("task.observation") else "state"}
    configs = [
        given.config(CollectConfig, {"task.task": one, "task.nx": of}, usual=usual)
        for one, of in pairs
    ]
    # refuse any of them before playing the first
    configs = [require_collectable(config, out, options) for config in configs]
    for config in configs:
        run(config, out, options, progress=given.progress)
        if options.shard.is_whole:
            given.progress.say_how_to_load(loading_lines(config.dataset_id, out))
