"""Rows of a state file while a run makes them: tables without pictures and splits.

Units of work return their columns, so a journal keeps them as they are.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common import Table
from knotgym.common import joined as appended
from knotgym.generate.states.state_filter import Judgement
from knotgym.rendering import draw_many, picture_of
from knotgym.rope import Array, rope_of
from knotgym.runs import Result
from knotgym.states import STATES, RopeAtRest, States

ROWS = STATES.without("image", "split")
_NO_SIZES = ROWS.sized(nq=0, beads=0, actions=0)
_NO_ROWS = Table(_NO_SIZES, _NO_SIZES.empty(0))
_REPORT = "report"


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
    made = [Table(ROWS, {name: np.array([one]) for name, one in row.items()}) for row in rows]
    return joined(made)


def with_report(rows: Table, report: Any) -> Result:
    """Return the result of a unit of work: columns, and a report as JSON beside them."""
    return {**rows, _REPORT: np.array(json.dumps(report))}


def without_report(result: Result) -> tuple[Table, Any]:
    """Return the rows and the report of a result."""
    columns = {name: column for name, column in result.items() if name != _REPORT}
    return Table(ROWS, columns), json.loads(str(result[_REPORT]))


def joined(parts: Iterable[Table]) -> Table:
    """Append the rows of all parts, with the optional columns that all of them have."""
    return appended([part for part in parts if part.rows] or [_NO_ROWS])


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
    columns = {**rows, "split": split, "image": draw_many(points, picture_of(points.shape[1]))}
    attributes = {
        "knotgym": knotgym.__version__,
        "mujoco": mujoco.__version__,
        "rope": rope_of(points.shape[1]).fingerprint,
        "engine": engine,
        "config": config,
    }
    return States.of(columns, attributes)
