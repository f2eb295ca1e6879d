"""Scores of Gauss codes read from pictures, by number of crossings and by grade.

exact      share of pictures whose code was read correctly
crossings  share of pictures whose number of crossings was read correctly
edits      mean edit distance to the true code, in visits; a missing code counts as empty
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from knotgym.datasets.image_table import GRADES
from knotgym.topology.gauss import GaussCode

HEAD = ("", "pictures", "exact", "crossings", "edits")


def reading_scores(transcripts: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Score transcripts of mode read; chirality is ignored.

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
