"""Rows of a state file while a run makes them: columns by their name in the file.

Units of work return such columns, so a journal keeps them as they are. Pictures, PD and DT codes
follow from the others, and are added at the end.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.generate.states.state_filter import Judgement
from knotgym.quality import UNITS
from knotgym.rendering import draw_many, picture_of
from knotgym.rope import Array, rope_of
from knotgym.states import States
from knotgym.topology import knot_type

Rows = Mapping[str, NDArray[Any]]  # all of one length; empty without rows
ACTIONS = "source/actions"  # (n, T, 6), padded with zeros to the longest
_REPORT = "report"


def row_of(judgement: Judgement, points: Array, qpos: Array, **source: Any) -> dict[str, Any]:
    """Return one row: a configuration at rest, its judgement, and the columns of its provenance."""
    return {
        "qpos": qpos,
        "points": points,
        "gauss_code": str(judgement.code),
        "gauss_code_chiral": judgement.code.chiral,
        "knot": knot_type(judgement.code),
        "nx": judgement.code.nx,
        **{f"quality/{name}": getattr(judgement.quality, name) for name in UNITS},
        **{f"source/{name}": value for name, value in source.items()},
    }


def stacked(rows: Sequence[Mapping[str, Any]]) -> Rows:
    """Return single rows as columns."""
    return joined([{name: np.array([one]) for name, one in row.items()} for row in rows])


def with_report(rows: Rows, report: Any) -> Rows:
    """Return the result of a unit of work: rows, and a report as JSON beside them."""
    return {**rows, _REPORT: np.array(json.dumps(report))}


def without_report(result: Rows) -> tuple[Rows, Any]:
    """Return the rows and the report of a result."""
    rows = {name: column for name, column in result.items() if name != _REPORT}
    return rows, json.loads(str(result[_REPORT]))


def joined(parts: Iterable[Rows]) -> Rows:
    """Append the rows of all parts, with the columns that all of them have."""
    some = [part for part in parts if len(part.get("nx", ()))]
    if not some:
        return {}
    longest = max((part[ACTIONS].shape[1] for part in some if ACTIONS in part), default=0)
    return {
        name: np.concatenate(
            [_padded(part[name], longest) if name == ACTIONS else part[name] for part in some]
        )
        for name in some[0]
        if all(name in part for part in some)
    }


def taken(rows: Rows, which: Any) -> Rows:
    """Select rows by numbers or by a mask, in that order."""
    return {name: column[which] for name, column in rows.items()}


def states_of(
    rows: Rows, split: NDArray[np.str_], engine: str, config: Mapping[str, Any], **source: Any
) -> States:
    """Return rows as states of a file, with their pictures.

    Args:
        rows: at least one.
        split: str (n,).
        engine: that their provenance is replayed with.
        config: the generating configuration, as JSON.
        source: further columns of provenance, or other values for them.
    """
    points = rows["points"]
    columns = {
        **rows,
        "split": split,
        "image": draw_many(points, picture_of(points.shape[1])),
        **{f"source/{name}": values for name, values in source.items()},
    }
    attributes = {
        "knotgym": knotgym.__version__,
        "mujoco": mujoco.__version__,
        "rope": rope_of(points.shape[1]).fingerprint,
        "engine": engine,
        "config": config,
    }
    return States.of(columns, attributes)


def _padded(actions: NDArray[Any], length: int) -> NDArray[Any]:
    return np.pad(actions, ((0, 0), (0, length - actions.shape[1]), (0, 0)))
