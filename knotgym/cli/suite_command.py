"""The command `knotgym suite`."""

from collections.abc import Sequence

from knotgym.cli.collect_command import MINARI_ROOT
from knotgym.cli.options import RUN, Given, command, extra
from knotgym.common import InvalidInput
from knotgym.generate import POLICIES, SuiteConfig


@command(
    {"": SuiteConfig},
    f"tasks=--task nx policies=--policy splits=--split states size recorded {RUN}",
    MINARI_ROOT,
    extra("episodes", tuple[str, ...]),
)
def suite(given: Given) -> None:
    """Make the fixed benchmark of offline datasets, or a part of it.

    It has episodes of four policies for each of nine setups, on two sets of states and two splits,
    and one card for all. With --recorded, datasets are rebuilt from the pulls that are included,
    which takes minutes; if this machine gets other episodes, the exit status is 1. With --resume,
    finished datasets are kept and the others are made. With --states bench it has tiers of a
    --size of six policies instead, from hundreds of starts, in the chain engine.

    Examples:

        knotgym suite --states bench --size 100k --task tie --nx 2-5

        knotgym suite --recorded --task tie --nx 2

        knotgym suite --task tie --nx 3 --policy expert,random --resume

    Args:
        episodes: Episodes per dataset: 100 for all, or expert=3000,random=100 by policy; by default
            as many as the benchmark has.
    """
    from knotgym.generate import make_suite

    words, policies = given["episodes"], given.get("policies") or POLICIES
    more = {"episodes": _sizes(words, policies)} if words else {}
    make_suite(given.config(SuiteConfig, more), given["out"], given.run, progress=given.progress)


def _sizes(words: Sequence[str], policies: Sequence[str]) -> dict[str, int]:
    """Read "100", for every policy, or "expert=3000,random=100".

    >>> _sizes(["100"], ("random", "expert"))
    {'random': 100, 'expert': 100}
    """
    pairs = [word.partition("=") for word in words]
    if len(pairs) == 1 and not pairs[0][1]:
        pairs = [(policy, "=", pairs[0][0]) for policy in policies]
    if not all(name and count.isdecimal() and len(count) < 10 for name, _, count in pairs):
        raise InvalidInput(
            "--episodes takes a number, or one per policy (expert=3000,random=100); got"
            f" {','.join(words)!r}"
        )
    return {name: int(count) for name, _, count in pairs}
