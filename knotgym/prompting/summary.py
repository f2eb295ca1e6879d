"""Summarize the transcripts of a run."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from knotgym.prompting.transcripts import TOKENS
from knotgym.runs.intervals import cluster_interval


def summarize(transcripts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Summarize the transcripts of one run, at least one, as JSON-compatible values.

    Counts answers by fault, answers cut off by the server's limit, retries and tokens, which are
    None if a server didn't state them. For episodes it adds the success rate with its 95 %
    interval, and the episodes without any valid answer.
    """
    turns = list(_turns(transcripts))
    facts: dict[str, Any] = {
        "answers": dict(Counter(turn["fault"] or "valid" for turn in turns).most_common()),
        "truncated": sum(turn["finish"] == "length" for turn in turns),
        "retries": dict(sum((Counter(turn["retries"]) for turn in turns), Counter())),
        **{name: total(transcripts, name) for name in TOKENS},
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


def total(replies: Iterable[Mapping[str, Any]], name: str) -> int | None:
    """Add up the numbers of tokens of replies; None if one is unknown."""
    counts = [one[name] for one in replies]
    return None if None in counts else sum(counts)


def _turns(transcripts: Iterable[Mapping[str, Any]]) -> Iterable[Mapping[str, Any]]:
    """Yield the requests: the turns of episodes, or the transcripts of pictures themselves."""
    for one in transcripts:
        yield from one.get("turns", [one])
