"""How well codes were read off pictures: by crossings and by grade, whoever read them.

exact      the code is the picture's
crossings  it has as many crossings
edits      visits to be put in, taken out or changed until it is the picture's, mean; of no code
           at all as many as the picture's has
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
    """Visits to be put in, taken out or changed (Levenshtein).

    >>> edit_distance(GaussCode.parse("1+,1-"), GaussCode.parse("1+,1-,2-,2+"))
    2
    """
    row = list(range(len(other.visits) + 1))
    for i, visit in enumerate(one.visits, 1):
        above, row[0] = row[0], i
        for j, against in enumerate(other.visits, 1):
            changed = above + (visit != against)
            above, row[j] = row[j], min(changed, row[j] + 1, row[j - 1] + 1)
    return row[-1]


class ReadingScores:
    """What was read, counted under "all", "nx 2", "easy", "accepted" and "accepted, nx 2"."""

    def __init__(self) -> None:
        self._counted: dict[str, list[_Counted]] = defaultdict(list)

    @classmethod
    def of(cls, transcripts: Iterable[Mapping[str, Any]]) -> ReadingScores:
        """Of transcripts of mode read."""
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
        """Count a picture: its code, what was read, or None; whether that is exact."""
        # without chirality on either side
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
        """Key -> pictures, and the share or mean of each score."""
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
        """The table: what, pictures, exact, crossings, edits."""
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
        """The table for a script to print."""
        return [
            f"{what:16} {pictures:>6} {exact:>8} {crossings:>9} {edits:>6}"
            for what, pictures, exact, crossings, edits in (HEAD, *self.rows())
        ]


HEAD = ("", "pictures", "exact", "crossings", "edits")


def _by_kind(item: tuple[str, Any]) -> tuple[int, int, str]:
    """All, then nx, grades as they get harder, accepted."""
    key = item[0]
    kind = 0 if key == "all" else 1 if key.startswith("nx") else 2 if key in GRADES else 3
    return kind, GRADES.index(key) if key in GRADES else 0, key
