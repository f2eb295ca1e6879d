"""The commands `knotgym collect` and `knotgym evaluate`."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import typer

from knotgym.cli.options import (
    ACTING,
    ENVIRONMENT,
    EXECUTION,
    EXISTING,
    RUN,
    TASK,
    Given,
    Option,
    command,
    numbers,
    option,
    options_of,
    run_options,
    words,
)

_ACTING = "policy.noise policy.planner.budget policy.shares"


def _playing(config: Any, acting: Any, **observation: Any) -> list[Option]:
    """Return the options of the environment and the policy."""
    return [
        *options_of(config, TASK, ENVIRONMENT, observation=observation),
        *options_of(acting, _ACTING, ACTING),
    ]


def _collect_options() -> list[Option]:
    from knotgym.generate.episodes.collect import CollectConfig

    config = CollectConfig()
    repeated = {"kind": list[str], "read": None, "default": None}
    return [
        *options_of(
            config,
            "task.task task.nx",
            nx={
                "kind": str,
                "default": "2",
                "read": numbers,
                "help": "Numbers of crossings: 3, 2,3 or 0-4.",
            },
        ),
        *options_of(config, "policy.policy", ACTING),
        *options_of(
            config,
            "episodes task.split keep_failed attempts labels",
            keep_failed={"names": "--keep-failed/--drop-failed"},
            labels={"show_default": "none"},
        ),
        MINARI_ROOT,
        *options_of(config, "dataset_id", dataset_id={"names": "--id", "default": ""}),
        *_playing(
            config,
            config,
            default=None,
            show_default="both is stored, policies get state",
            help="Observation to store, also the input of your functions and .pt models: pixels,"
            " state, both or symbolic. A .zip or .onnx model gets what it was trained on.",
        ),
        *options_of(
            config,
            "author author_email code_permalink",
            "Metadata",
            author=repeated,
            author_email=repeated,
        ),
        *options_of(config, "seed", RUN),
        *run_options(f"{EXECUTION} shard {EXISTING}"),
    ]


MINARI_ROOT = option("--out", Path, "Minari root to write to; Minari's own by default.")


@command(_collect_options)
def collect(given: Given) -> None:
    """Roll out a policy and write its episodes as a Minari dataset.

    Several values of --nx make one dataset each.

    Examples:

        knotgym collect --task tie --nx 3 --policy expert --episodes 200

        knotgym collect --task unknot --nx 2-4 --policy mine:act

        knotgym collect --task tie --policy pretrained --labels expert --budget 2000
    """
    from knotgym.datasets.minari_dataset import loading_lines
    from knotgym.generate.episodes.collect import CollectConfig, distinct_id, require_collectable
    from knotgym.generate.episodes.collect import collect as run

    options, out = given.run, given["out"]
    crossings = given["task.nx"] if "task.nx" in given.typed else [None]
    if given["dataset_id"] and len(crossings) > 1:
        raise typer.BadParameter(
            f"--id names one dataset, but --nx {given.text('task.nx')} makes {len(crossings)}:"
            " leave out --id or give a single --nx"
        )
    seen = "" if "task.observation" in given.typed else "state"
    is_named = given["dataset_id"] or "dataset_id" in given.settings
    configs = []
    for nx in crossings:
        more = {} if nx is None else {"task.nx": nx}
        config = given.config(CollectConfig, more, usual={"seen": seen})
        configs.append(config if is_named else replace(config, dataset_id=distinct_id(config)))
    for config in configs:  # refuse any of them before playing the first
        require_collectable(config, out, options)
    for config in configs:
        run(config, out, options, progress=given.progress)
        if options.shard.is_whole:
            given.progress.say_how_to_load(loading_lines(config.dataset_id, out))


def _evaluate_options() -> list[Option]:
    from knotgym.control.policies import PolicyConfig
    from knotgym.generate.episodes.evaluate import EvaluateConfig

    config, acting = EvaluateConfig(), SimpleNamespace(policy=PolicyConfig())
    policy = {"kind": list[str], "default": None}
    (policies,) = options_of(acting, "policy.policy", ACTING, policy=policy)
    return [
        *options_of(config, "tasks nx", tasks={"names": "--task", "read": words}),
        replace(policies, help=f"{policies.help} May be repeated."),
        *options_of(config, "episodes splits", splits={"names": "--split", "read": words}),
        Option(path="out", names="--out", kind=Path, help="JSON file to write."),
        option(
            "--video",
            Path,
            "Film of the first episodes of each setup: .gif, or with the extra video .mp4 or"
            " .webm.",
        ),
        *options_of(config, "filmed", filmed={"default": 2}),
        *_playing(
            config,
            acting,
            help="Input of your functions and .pt models: pixels, state, both or symbolic. A .zip"
            " or .onnx model gets what it was trained on.",
        ),
        *options_of(config, "seed", RUN),
        *run_options(f"{EXECUTION} shard {EXISTING}"),
    ]


@command(_evaluate_options, lines=False)
def evaluate(given: Given) -> None:
    """Measure the success rates of policies, with 95 % confidence intervals.

    Every combination of policy, task, split and number of crossings is one row.

    Examples:

        knotgym evaluate --task tie --nx 3 --policy random --episodes 256

        knotgym evaluate --policy random --policy mine:act --task tie,unknot --nx 2-4
    """
    from knotgym.control.policies import PolicyConfig
    from knotgym.generate.episodes.evaluate import EvaluateConfig, run

    more: dict[str, Any] = {}
    if any(path.startswith("policy.") for path in given.typed):
        more["policies"] = [
            given.config(PolicyConfig, {"policy": name}, under="policy.")
            for name in given["policy.policy"] or ["random"]
        ]
    config = given.config(EvaluateConfig, more, usual={"filmed": given["filmed"]})
    if given["video"] is None:
        config = replace(config, filmed=0)
    run(config, given.run, out=given["out"], video=given["video"], progress=given.progress)
