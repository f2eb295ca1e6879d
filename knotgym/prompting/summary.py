"""Summarize the transcripts of a run."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from knotgym.prompting.transcripts import PRICES
from knotgym.runs.intervals import cluster_interval


def summarize(transcripts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Summarize the transcripts of one run, at least one, as JSON-compatible values.

    Counts answers by fault, retries and tokens; gives the cost if prices are known. For episodes it
    adds the success rate with its 95 % interval, and the episodes without any valid answer.
    """
    config = transcripts[0]["config"]
    total = {
        name: sum(one[name] for one in transcripts)
        for name in ("prompt_tokens", "completion_tokens")
    }
    prices = [config.get(name) for name in PRICES]
    cost = (
        None
        if None in prices
        else sum(price * n for price, n in zip(prices, total.values(), strict=True)) / 1e6
    )
    facts: dict[str, Any] = {
        "answers": dict(Counter(_answers(transcripts)).most_common()),
        "retries": dict(sum((Counter(one["retries"]) for one in transcripts), Counter())),
        **total,
        "cost": cost,
    }
    if "actions" not in transcripts[0]:
        return {"pictures": len(transcripts), **facts}
    success, starts, goals = (
        [int(one[name]) for one in transcripts] for name in ("success", "start", "goal")
    )
    return {
        "episodes": len(transcripts),
        "successes": sum(success),
        "success_rate": sum(success) / len(transcripts),
        "interval": list(cluster_interval(success, starts, goals)),
        "without_valid_answer": sum(
            not one["success"] and all(turn["fault"] for turn in one["turns"])
            for one in transcripts
        ),
        **facts,
    }


def _answers(transcripts: Iterable[Mapping[str, Any]]) -> Iterable[str]:
    """Yield "valid" or the fault of each answer."""
    for one in transcripts:
        for turn in one.get("turns", [one]):
            yield turn["fault"] or "valid"
