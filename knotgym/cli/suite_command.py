"""The command `knotgym suite`."""

from pathlib import Path
from typing import Any

import typer

from knotgym.cli.options import (
    ENVIRONMENT,
    EXECUTION,
    EXISTING,
    Given,
    Option,
    command,
    option,
    options_of,
    run_options,
    words,
)
from knotgym.cli.policy_commands import MINARI_ROOT


def _options() -> list[Option]:
    from knotgym.generate.episodes.suite import SuiteConfig

    config, listed = SuiteConfig(), {"read": words}
    return [
        *options_of(config, "tasks", tasks={**listed, "names": "--task"}),
        *options_of(config, "nx policies", policies=listed),
        *options_of(
            config,
            "splits states",
            ENVIRONMENT,
            splits={**listed, "names": "--split"},
            states=listed,
        ),
        option(
            "--episodes",
            str,
            "Episodes per dataset: 100 for all, or expert=3000,random=100 by policy; others"
            " keep their default.",
            default="",
            show_default="by nx",
        ),
        *options_of(config, "engine observation", ENVIRONMENT),
        MINARI_ROOT,
        option(
            "--scores",
            list[Path],
            "Results of `knotgym evaluate --out` to add to the card's table, besides those in"
            " the folder `evaluations` next to the card; may be repeated.",
        ),
        *options_of(config, "seed recorded"),
        *run_options(f"{EXECUTION} {EXISTING}"),
    ]


@command(_options)
def suite(given: Given) -> None:
    """Make the fixed benchmark of offline datasets, or a part of it.

    It has episodes of four policies for each of nine setups, on two sets of states and two splits,
    and one card for all. The expected time is printed first. With --recorded, datasets are rebuilt
    from the pulls that are included, which takes minutes; if this machine gets other episodes, the
    exit status is 1. With --resume, finished datasets are kept and the others are made.

    Examples:

        knotgym suite --recorded --task tie --nx 2

        knotgym suite --task tie --nx 3 --states readable --policies expert,random --resume
    """
    from knotgym.generate.episodes.suite import SuiteConfig, make_suite

    more: dict[str, Any] = {}
    if given["episodes"]:
        more["episodes"] = _sizes(given["episodes"], given["policies"])
    config, scores = given.config(SuiteConfig, more), given["scores"] or ()
    make_suite(config, given["out"], given.run, scores=tuple(scores), progress=given.progress)


def _sizes(text: str, policies: tuple[str, ...]) -> dict[str, int]:
    """Read "100", for every policy, or "expert=3000,random=100".

    >>> _sizes("100", ("random", "expert"))
    {'random': 100, 'expert': 100}
    """
    pairs = [word.partition("=") for word in words(text)]
    if len(pairs) == 1 and not pairs[0][1]:
        pairs = [(policy, "=", pairs[0][0]) for policy in policies]
    if not all(name and count.isdecimal() and len(count) < 10 for name, _, count in pairs):
        raise typer.BadParameter(
            f"--episodes takes a number, or one per policy (expert=3000,random=100); got {text!r}"
        )
    return {name: int(count) for name, _, count in pairs}
