"""The command `knotgym evaluate`."""

from pathlib import Path

from knotgym.cli.options import RUN, Given, command, extra, field_help
from knotgym.control import PolicyConfig
from knotgym.generate import EvaluateConfig


@command(
    {"": EvaluateConfig, "policy": PolicyConfig},
    f"tasks=--task nx splits=--split episodes task.states task.engine {RUN}",
    extra(
        "policy", list[str], ("random",), f"{field_help(PolicyConfig, 'policy')} May be repeated."
    ),
    extra("out", Path),
    extra("video", Path),
    lines=False,
)
def evaluate(given: Given) -> None:
    """Measure the success rates of policies, with 95 % confidence intervals.

    Every combination of policy, task, split and number of crossings is one row.

    Examples:

        knotgym evaluate --task tie --nx 3 --policy random --episodes 256

        knotgym evaluate --policy random --policy mine:act --task tie --nx 2-4

    Args:
        out: JSON file to write.
        video: Film of the first episodes of each setup: .gif, or with the extra video .mp4 or
            .webm.
    """
    from knotgym.generate import evaluate

    more = {}
    if "policy" in given.typed or given.has("policy"):
        more["policies"] = [
            given.config(PolicyConfig, {"policy": name}, section="policy")
            for name in given["policy"]
        ]
    config = given.config(EvaluateConfig, more)
    evaluate(config, given.run, out=given["out"], video=given["video"], progress=given.progress)
