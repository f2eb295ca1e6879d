"""The command `knotgym suite`."""

from collections.abc import Sequence
from pathlib import Path

from knotgym.cli.options import RUN, Given, Listed, command
from knotgym.common import InvalidInput
from knotgym.generate import SUITE, SuiteConfig


@command(
    {"": SuiteConfig},
    f"tasks=--task nx policies=--policy splits=--split states size recorded {RUN}",
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

        knotgym suite --recorded --task tie --nx 2

        knotgym suite --task tie --nx 3 --policy expert,random --resume

    Args:
        out: Minari root to write to; Minari's own by default.
        episodes: Episodes per dataset: 100 for all, or expert=3000,random=100 by policy; by default
            as many as the benchmark has.
    """
    from knotgym.generate import make_suite

    policies = given.get("policies") or SUITE["policies"]
    more = {} if episodes is None else {"episodes": _sizes(episodes, policies)}
    make_suite(given.config(SuiteConfig, more), out, given.run, progress=given.progress)


def _sizes(text: str, policies: Sequence[str]) -> dict[str, int]:
    """Read "100", for every policy, or "expert=3000,random=100".

    >>> _sizes("100", ("random", "expert"))
    {'random': 100, 'expert': 100}
    """
    pairs = [word.strip().partition("=") for word in text.split(",")]
    if len(pairs) == 1 and not pairs[0][1]:
        pairs = [(policy, "=", pairs[0][0]) for policy in policies]
    if not all(name and count.isdecimal() and len(count) < 10 for name, _, count in pairs):
        raise InvalidInput(
            f"--episodes takes a number, or one per policy (expert=3000,random=100); got {text!r}"
        )
    return {name: int(count) for name, _, count in pairs}
