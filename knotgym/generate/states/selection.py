"""Selection of states: of the rows that passed the filter, which are new and still wanted."""

from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np

from knotgym.generate.states.state_rows import Rows, joined, taken
from knotgym.rope.model import Array
from knotgym.states.near_duplicates import NEAR, distances, pairs_within
from knotgym.topology.gauss import GaussCode


class Selection:
    """States kept so far, none near another or one of `apart_from`.

    Attributes:
        rejected: nx -> reason -> number of rejected candidates; `offer` counts near duplicates.
    """

    def __init__(self, apart_from: Sequence[Rows] = ()) -> None:
        self._others = [points for rows in apart_from for points in rows["points"]]
        self.rejected = defaultdict[int, Counter[str]](Counter)
        self._parts: list[Rows] = []
        self._kept: list[tuple[GaussCode, Array]] = []

    def __len__(self) -> int:
        return len(self._parts)

    def offer(self, rows: Rows, row: int, *, lenient: bool = False) -> bool:
        """Keep a row if it is new; return whether it is kept.

        By default it must differ from all kept rows under every symmetry, see
        `states.near_duplicates`. If `lenient`, it must do so only from those that show its code, up
        to chirality; from others with as many crossings only as it lies.
        """
        points = rows["points"][row]
        code = GaussCode.parse(str(rows["gauss_code_chiral"][row]))
        like = [one for shown, one in self._kept if not lenient or code.matches(shown)]
        like += self._others
        near = bool(like) and bool(pairs_within(points[None], np.stack(like)))
        if lenient and not near:
            others = [one for shown, one in self._kept if shown.nx == code.nx]
            near = bool(others) and bool((distances(points, np.stack(others)) < NEAR).any())
        if near:
            self.rejected[code.nx]["near-duplicate"] += 1
            return False
        self._kept.append((code, points))
        self._parts.append(taken(rows, slice(row, row + 1)))
        return True

    def reasons(self, numbers: Sequence[int]) -> dict[str, dict[str, int]]:
        """Return `rejected` for some numbers of crossings, as JSON."""
        return {str(nx): dict(sorted(self.rejected[nx].items())) for nx in numbers}

    def rows(self) -> Rows:
        """Return the kept rows, in the order in which they were offered."""
        return joined(self._parts)
