"""Selection of states: of the rows that passed the filter, which are new and still wanted."""

from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Table
from knotgym.generate.states.state_rows import joined
from knotgym.rope import Array
from knotgym.states import NEAR, Spectra, distances, pairs_within
from knotgym.topology import GaussCode


class Selection:
    """States kept so far, none near another or one of `apart_from`, points (n, beads, 3) each.

    Attributes:
        rejected: nx -> reason -> number of rejected candidates; `offer` counts near duplicates.
    """

    def __init__(self, apart_from: Sequence[NDArray[np.float64]] = ()) -> None:
        others = [points for part in apart_from for points in part]
        self.rejected = defaultdict[int, Counter[str]](Counter)
        self._parts: list[Table] = []
        # those of others have no code: none may be near them
        self._known: list[tuple[GaussCode | None, Array]] = [(None, one) for one in others]
        self._invariants = list(Spectra.of(np.stack(others)).invariants) if others else []

    def __len__(self) -> int:
        return len(self._parts)

    def offer(self, rows: Table, row: int, *, lenient: bool = False) -> bool:
        """Keep a row if it is new; return whether it is kept.

        Args:
            rows: candidates.
            row: which of them.
            lenient: by default it must differ from all kept rows under every symmetry, see
                `states.near_duplicates`; if lenient, only from those that show its code, up to
                chirality, and from others with as many crossings only as it lies.
        """
        points = rows["points"][row]
        code = GaussCode.parse(str(rows["gauss_code_chiral"][row]))
        own = Spectra.of(points[None]).invariants[0]
        close: list[tuple[GaussCode | None, Array]] = []
        if self._known:
            # no symmetry brings two closer than their invariants; the margin is for rounding
            bounds = np.linalg.norm(np.array(self._invariants) - own, axis=1)
            close = [self._known[k] for k in np.flatnonzero(bounds < NEAR + 1e-9)]
        like = [one for shown, one in close if not lenient or shown is None or code.matches(shown)]
        near = bool(like) and bool(pairs_within(points[None], np.stack(like)))
        if lenient and not near:
            others = [one for shown, one in close if shown is not None and shown.nx == code.nx]
            near = bool(others) and bool((distances(points, np.stack(others)) < NEAR).any())
        if near:
            self.rejected[code.nx]["near-duplicate"] += 1
            return False
        self._known.append((code, points))
        self._invariants.append(own)
        self._parts.append(rows.take(slice(row, row + 1)))
        return True

    def reasons(self, numbers: Sequence[int]) -> dict[str, dict[str, int]]:
        """Return `rejected` for some numbers of crossings, as JSON."""
        return {str(nx): dict(sorted(self.rejected[nx].items())) for nx in numbers}

    def rows(self) -> Table:
        """Return the kept rows, in the order in which they were offered."""
        return joined(self._parts)
