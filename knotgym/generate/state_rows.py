"""The filter that every state passes, wherever it comes from, and the rows of those that pass.

A state keeps the limits of its source (legible, not over-twisted), survives reset noise, has the
same Gauss code for two independent labellers, and its knot is certified. Rows are tables without
pictures and splits; units of work return their columns, so a journal keeps them as they are. Of the
rows that passed, a `Selection` keeps those that are new.
"""

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

import knotgym
from knotgym.common import Array, Table
from knotgym.quality import Limits, Quality, measure, noise_survival
from knotgym.rendering import PictureConfig, draw
from knotgym.rope import RopeConfig
from knotgym.runs import Result
from knotgym.states import NEAR, STATES, RopeAtRest, Spectra, States
from knotgym.topology import UNKNOT, GaussCode, Knot, find_crossings, pyknotid_code

ROWS = STATES.without("image", "split")
_NO_SIZES = ROWS.sized(nq=0, beads=0, actions=0)
_NO_ROWS = Table(_NO_SIZES, _NO_SIZES.empty(0))
_REPORT = "report"


class Judgement(NamedTuple):
    """What a configuration shows, its quality, and why it can't be a state; [] if it can."""

    code: GaussCode
    quality: Quality
    faults: list[str]


def judge(
    points: ArrayLike, limits: Sequence[Limits], *, code: GaussCode | None = None
) -> Judgement:
    """Judge a configuration at rest, from cheap to costly checks; the first to fail ends it.

    Args:
        points: float64 (beads, 3), metres.
        limits: all must be kept.
        code: that it must show, with chirality; None for any code of the unknot.
    """
    p = np.asarray(points, dtype=np.float64)
    crossings = find_crossings(p)
    shown = crossings.code

    def _judged(quality: Quality) -> Judgement:
        missed = [fault for limit in limits for fault in limit.faults(quality, crossings.nx)]
        return Judgement(shown, quality, list(dict.fromkeys(missed)))

    judgement = _judged(measure(p, crossings, quick=True))
    if code is not None and shown != code:
        judgement.faults.append("code lost at rest")
    if not judgement.faults:
        judgement = _judged(measure(p, crossings))
    if not judgement.faults:
        judgement = _judged(replace(judgement.quality, noise_survival=noise_survival(p)))
    if not judgement.faults and pyknotid_code(p) != shown:
        judgement.faults.append("labellers disagree")
    if not judgement.faults and code is None and not Knot(UNKNOT).is_shown_by(shown):
        judgement.faults.append(f"not certified as {UNKNOT}")
    return judgement


def row_of(judgement: Judgement, points: Array, qpos: Array, **source: Any) -> dict[str, Any]:
    """Return one row: a configuration at rest, what follows from it, and its provenance.

    Args:
        judgement: of the configuration.
        points: float64 (beads, 3), metres.
        qpos: float64 (nq,).
        source: columns of provenance, by their names in `source`.
    """
    rope = RopeAtRest(points, code=judgement.code, quality=judgement.quality)
    given = {f"source/{name}": value for name, value in source.items()}
    return {"qpos": qpos, "points": points, **ROWS.derive(rope), **given}


def stacked(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return single rows as a table; their actions may differ in number."""
    made = [Table(ROWS, {name: np.array([value]) for name, value in row.items()}) for row in rows]
    return joined(made)


def with_report(rows: Sequence[Mapping[str, Any]], report: Any) -> Result:
    """Return the result of a unit of work: columns, and a report as JSON beside them."""
    return {**stacked(rows), _REPORT: np.array(json.dumps(report))}


def report_of(result: Result) -> tuple[Table, Any]:
    """Return the rows and the report of a result."""
    columns = {name: column for name, column in result.items() if name != _REPORT}
    return Table(ROWS, columns), json.loads(str(result[_REPORT]))


def joined(parts: Iterable[Table]) -> Table:
    """Append the rows of all parts, with the optional columns that all of them have."""
    return Table.joined([part for part in parts if part.rows] or [_NO_ROWS])


def states_of(
    rows: Table, split: NDArray[np.str_], engine: str, config: Mapping[str, Any]
) -> States:
    """Return rows as states of a file, with their pictures.

    Args:
        rows: at least one.
        split: str (n,).
        engine: that their provenance is replayed with.
        config: the generating configuration, as JSON.
    """
    points = rows["points"]
    columns = {**rows, "split": split, "image": draw(points, PictureConfig.of(points.shape[1]))}
    versions = {"knotgym": knotgym.__version__, "mujoco": mujoco.__version__}
    rope = RopeConfig.of(points.shape[1]).fingerprint
    return States.of(columns, {**versions, "rope": rope, "engine": engine, "config": config})


class Selection:
    """States kept so far, none near another or one of `apart_from`, points (n, beads, 3) each.

    Attributes:
        rejected: nx -> reason -> number of rejected candidates; `offer` counts near duplicates.
    """

    def __init__(self, apart_from: Sequence[NDArray[np.float64]] = ()) -> None:
        self.rejected = defaultdict[int, Counter[str]](Counter)
        self._parts: list[Table] = []
        # those of others have no code: none may be near them
        self._known: list[tuple[GaussCode | None, Spectra]] = [
            (None, Spectra.of(points[None])) for part in apart_from for points in part
        ]

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
        spectra, near = Spectra.of(points[None]), False
        known = np.array([other.invariants[0] for _, other in self._known])
        off = known.reshape(-1, spectra.invariants.size) - spectra.invariants
        # no symmetry brings two closer than their invariants; the margin is for rounding
        for k in np.flatnonzero(np.linalg.norm(off, axis=1) < NEAR + 1e-9):
            shown, other = self._known[k]
            if not lenient or shown is None or code.matches(shown):
                near |= spectra.pair_distances(other)[0] < NEAR
            elif shown.nx == code.nx:
                near |= spectra.turned_distances(other)[0, 0] < NEAR
        if near:
            self.rejected[code.nx]["near-duplicate"] += 1
            return False
        self._known.append((code, spectra))
        self._parts.append(rows.take(slice(row, row + 1)))
        return True

    def reasons(self, numbers: Sequence[int]) -> dict[str, dict[str, int]]:
        """Return `rejected` for some numbers of crossings, as JSON."""
        return {str(nx): dict(sorted(self.rejected[nx].items())) for nx in numbers}

    def rows(self) -> Table:
        """Return the kept rows, in the order in which they were offered."""
        return joined(self._parts)
