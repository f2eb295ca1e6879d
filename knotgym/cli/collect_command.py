"""The commands `knotgym collect` and `knotgym suite`, which make datasets of episodes."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path

from knotgym import datasets, generate
from knotgym.cli.options import RUN, Given, Listed, Numbers, command, numbers
from knotgym.common import InvalidInput
from knotgym.generate import CollectConfig, SuiteConfig


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

    options = given.run
    tasks = given.get("task.task") if task is None else [name.strip() for name in task.split(",")]
    both = tasks, given.get("task.nx") if nx is None else numbers(nx)
    several = [[*values] if isinstance(values, (list, tuple)) else [values] for values in both]
    if given.get("dataset_id"):
        pairs = [tuple(values[0] if len(values) == 1 else values for values in several)]
    else:
        every = [*product(*several)]
        # settings may hold anything, also what can't be hashed; it is refused below
        pairs = [pair for number, pair in enumerate(every) if pair not in every[:number]]
    usual = {"policy_observation": "" if given.has("task.observation") else "state"}
    named = ({"task.task": task, "task.nx": of} for task, of in pairs)
    configs = [given.config(CollectConfig, setup, usual=usual) for setup in named]
    # refuse any of them before playing the first
    configs = [generate.require_collectable(config, out, options) for config in configs]
    for config in configs:
        generate.collect(config, out, options, progress=given.progress)
        if options.shard.is_whole:
            lines = datasets.loading_lines(config.dataset_id, out)
            given.progress.say("to load it:", *(f"    {line}" for line in lines))


@command(
    {"": SuiteConfig},
    f"tasks=--task nx policies=--policy splits=--split states size recorded verify {RUN}",
)
def suite(given: Given, *, out: Path | None = None, episodes: Listed = None) -> None:
    """Make the fixed benchmark of offline datasets, or a part of it.

    It has episodes of four policies for each of nine setups, on two sets of states and two splits,
    and one card for all. With --recorded, datasets are rebuilt from the pulls that are included,
    which takes minutes; if this machine gets other episodes, the exit status is 1. With --resume,
    finished datasets are kept and the others are made. With --states bench it has tiers of a
    --size of six policies instead, from hundreds of starts, in the chain engine.

    Examples:

        knotgym suite --states bench --size 100k --task tie --nx 2-5

        knotgym suite --states bench --size 100k --task tie --nx 2-5 --verify

        knotgym suite --recorded --task tie --nx 2

        knotgym suite --task tie --nx 3 --policy expert,random --resume

    Args:
        out: Minari root to write to; Minari's own by default.
        episodes: Episodes per dataset: 100 for all, or expert=3000,random=100 by policy; by default
            as many as the benchmark has.
    """

    policies = given.get("policies") or SuiteConfig.SUITE["policies"]
    more = {} if episodes is None else {"episodes": _sizes(episodes, policies)}
    suited = given.config(SuiteConfig, more)
    generate.make_suite(suited, out, given.run, progress=given.progress)


def _sizes(text: str, policies: Sequence[str]) -> dict[str, int]:
    """Read "100", for every policy, or "expert=3000,random=100".

    >>> _sizes("100", ("random", "expert"))
    {'random': 100, 'expert': 100}
    """
    pairs = [word.strip().partition("=") for word in text.split(",")]
    if len(pairs) == 1 and not pairs[0][1]:
        pairs = [(policy, "=", pairs[0][0]) for policy in policies]
    if not all(name and count.isdecimal() and len(count) < 10 for name, _, count in pairs):
        such = "a number, or one per policy (expert=3000,random=100)"
        raise InvalidInput(f"--episodes takes {such}; got {text!r}")
    return {name: int(count) for name, _, count in pairs}
