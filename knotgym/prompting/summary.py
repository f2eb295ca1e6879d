"""Summaries of the transcripts of a run, and scores of the Gauss codes read from pictures."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from knotgym.datasets import GRADES
from knotgym.prompting.transcripts import TOKENS
from knotgym.runs import cluster_interval
from knotgym.topology import GaussCode

HEAD = ("", "pictures", "exact", "crossings", "edits")


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


def reading_scores(transcripts: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Score transcripts of mode read, by number of crossings and by grade; chirality is ignored.

    The scores are `exact` and `crossings`, the shares of pictures whose code, or number of
    crossings, was read correctly; and `edits`, the mean edit distance to the true code, in visits,
    where a missing code counts as empty.

    Returns:
        Group -> number of pictures and mean of each score. Groups are "all", "nx 2" and the like,
        the grades, "accepted", and "accepted, nx 2" and the like.
    """
    groups: dict[str, list[tuple[bool, bool, int]]] = {}
    for one in transcripts:
        code, found = GaussCode.parse(one["gauss_code"]), one.get("read")
        read = GaussCode.parse(found) if isinstance(found, str) else None
        edits = _edit_distance(read or GaussCode(), code)
        scores = read is not None and read.matches(code), read is not None and read.nx == code.nx
        keys = ["all", f"nx {code.nx}", str(one["grade"])]
        keys += ["accepted", f"accepted, nx {code.nx}"] if one["accepted"] else []
        for key in keys:
            groups.setdefault(key, []).append((*scores, edits))
    return {
        key: {
            "pictures": len(rows),
            **dict(zip(HEAD[2:], np.mean(rows, axis=0).tolist(), strict=True)),
        }
        for key, rows in sorted(groups.items(), key=lambda item: _by_kind(item[0]))
    }


def score_rows(scores: Mapping[str, Mapping[str, float]]) -> list[tuple[str, ...]]:
    """Return the rows of a table with the columns HEAD."""
    return [
        (key, f"{one['pictures']:.0f}")
        + tuple(f"{100 * one[name]:.1f} %" for name in ("exact", "crossings"))
        + (f"{one['edits']:.2f}",)
        for key, one in scores.items()
    ]


def _edit_distance(one: GaussCode, other: GaussCode) -> int:
    """Return the Levenshtein distance between two codes, in visits.

    >>> _edit_distance(GaussCode.parse("1+,1-"), GaussCode.parse("1+,1-,2-,2+"))
    2
    """
    # row[j] is the distance of the first i visits of `one` from the first j of `other`; `above` is
    # the value that row[j - 1] had for i - 1
    row = list(range(len(other.visits) + 1))
    for i, visit in enumerate(one.visits, 1):
        above, row[0] = row[0], i
        for j, against in enumerate(other.visits, 1):
            changed = above + (visit != against)
            above, row[j] = row[j], min(changed, row[j] + 1, row[j - 1] + 1)
    return row[-1]


def _by_kind(key: str) -> tuple[int, int, str]:
    """Sort key: all, then by nx, by grade from easy to hard, and accepted ones."""
    kind = 0 if key == "all" else 1 if key.startswith("nx") else 2 if key in GRADES else 3
    return kind, GRADES.index(key) if key in GRADES else 0, key
