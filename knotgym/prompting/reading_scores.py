"""Scores of Gauss codes read from pictures, by number of crossings and by grade.

exact      share of pictures whose code was read correctly
crossings  share of pictures whose number of crossings was read correctly
edits      mean edit distance to the true code, in visits; a missing code counts as empty
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from knotgym.datasets.image_table import GRADES
from knotgym.topology.gauss import GaussCode


class _Counted(NamedTuple):
    exact: bool
    crossings: bool
    edits: int


def edit_distance(one: GaussCode, other: GaussCode) -> int:
    """Return the Levenshtein distance between two codes, in visits.

    >>> edit_distance(GaussCode.parse("1+,1-"), GaussCode.parse("1+,1-,2-,2+"))
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


class ReadingScores:
    """Scores grouped under "all", "nx 2", "easy", "accepted", "accepted, nx 2" and the like."""

    def __init__(self) -> None:
        self._counted: dict[str, list[_Counted]] = defaultdict(list)

    @classmethod
    def of(cls, transcripts: Iterable[Mapping[str, Any]]) -> ReadingScores:
        """Score transcripts of mode read."""
        scores = cls()
        for one in transcripts:
            found = one.get("read")
            scores.add(
                GaussCode.parse(one["gauss_code"]),
                GaussCode.parse(found) if isinstance(found, str) else None,
                one["grade"],
                one["accepted"],
            )
        return scores

    def add(self, code: GaussCode, read: GaussCode | None, grade: str, accepted: bool) -> bool:
        """Add a picture: its code and the code read, or None; return whether they agree.

        Chirality is ignored.
        """
        one = _Counted(
            read is not None and read.visits == code.visits,
            read is not None and read.nx == code.nx,
            edit_distance(read or GaussCode(), code),
        )
        keys = ["all", f"nx {code.nx}", grade]
        for key in [*keys, *(["accepted", f"accepted, nx {code.nx}"] if accepted else [])]:
            self._counted[key].append(one)
        return one.exact

    def as_json(self) -> dict[str, dict[str, float]]:
        """Return group -> number of pictures and mean of each score."""
        return {
            key: {
                "pictures": len(counted),
                **{
                    name: sum(getattr(one, name) for one in counted) / len(counted)
                    for name in _Counted._fields
                },
            }
            for key, counted in sorted(self._counted.items(), key=_by_kind)
        }

    def rows(self) -> list[tuple[str, str, str, str, str]]:
        """Return the rows of a table with the columns HEAD."""
        return [
            (
                key,
                str(score["pictures"]),
                f"{100 * score['exact']:.1f} %",
                f"{100 * score['crossings']:.1f} %",
                f"{score['edits']:.2f}",
            )
            for key, score in self.as_json().items()
        ]

    def lines(self) -> list[str]:
        """Return the lines of a plain-text table."""
        return [
            f"{group:16} {pictures:>6} {exact:>8} {crossings:>9} {edits:>6}"
            for group, pictures, exact, crossings, edits in (HEAD, *self.rows())
        ]


HEAD = ("", "pictures", "exact", "crossings", "edits")


def _by_kind(item: tuple[str, Any]) -> tuple[int, int, str]:
    """Sort key: all, then by nx, by grade from easy to hard, and accepted ones."""
    key = item[0]
    kind = 0 if key == "all" else 1 if key.startswith("nx") else 2 if key in GRADES else 3
    return kind, GRADES.index(key) if key in GRADES else 0, key
