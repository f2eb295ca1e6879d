"""Tables of states and episodes for Parquet files: columns and rows.

Arrays are stored flat, in C order. Column names have an underscore where the state file has a
slash.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.episode_reader import Count, EpisodeReader, uncounted
from knotgym.datasets.image_table import TABLES, arrow, encode, schema
from knotgym.states.state_file import States


class TableColumn(NamedTuple):
    """One column of a table; `kind` is its type in the notation of `image_table.COLUMNS`."""

    name: str
    kind: Any
    unit: str  # "" for none
    doc: str


def state_columns(states: States) -> list[TableColumn]:
    """Return the columns that a state file has."""
    out = []
    for column in states.table.schema.columns:
        name, values = column.name, states.table[column.name]
        if name == "image":
            kind: Any = "image"
        elif values.ndim > 1:
            kind = [values.dtype.name, int(np.prod(values.shape[1:]))]
        else:
            kind = "string" if values.dtype.kind == "U" else values.dtype.name
        shape = f", {values.shape[1:]}" if values.ndim > 2 and name != "image" else ""
        out.append(TableColumn(name.replace("/", "_"), kind, column.unit, column.doc + shape))
    return out


def state_rows(states: States) -> Iterator[dict[str, Any]]:
    """Yield the rows, with the columns of `state_columns`."""
    for row in range(len(states)):
        out = {}
        for name, values in states.table.items():
            value = values[row]
            if name == "image":
                out[name] = _png(value)
            else:
                out[name.replace("/", "_")] = value.ravel().tolist() if value.ndim else value.item()
        yield out


def step_columns(pictures: bool, beads: int) -> list[TableColumn]:
    """Return the columns of a table of episodes, one row per state."""
    columns = [TableColumn(name, *column) for name, column in TABLES["steps"].items()]
    ropes = ["float64", 3 * beads]
    return [
        column._replace(kind=ropes) if column.name.endswith("points") else column
        for column in columns
        if pictures or column.kind != "image"
    ]


def step_rows(
    reader: EpisodeReader, dataset: str, pictures: bool, count: Count = uncounted
) -> Iterator[dict[str, Any]]:
    """Yield the rows, with the columns of `step_columns`; holds one episode in memory."""
    for index in range(len(reader)):
        count(f"episodes of {dataset}", index, len(reader))
        episode = reader.episode(index)
        states = len(episode) + 1
        columns: dict[str, Iterable[Any]] = {
            "dataset": [dataset] * states,
            "episode": [reader.rows[index]] * states,
            "step": range(states),
            "points": episode.points.reshape(states, -1).tolist(),
            "goal_points": [episode.goal_points.ravel().tolist()] * states,
            "action": _ended(episode.actions),
            "reward": _ended(episode.rewards),
            "terminated": _ended(episode.terminations),
            "truncated": _ended(episode.truncations),
            "is_last": (np.arange(states) == len(episode)).tolist(),
            "gauss_code": episode.gauss_code.tolist(),
            "gauss_code_chiral": episode.gauss_code_chiral.tolist(),
            "goal_gauss_code": [episode.goal_gauss_code] * states,
            "crossings": episode.crossings.tolist(),
            "is_success": episode.is_success.tolist(),
            "policy": [episode.policy] * states,
        }
        if pictures:
            seen = reader.observations(index, observation="pixels")
            columns["image"] = (_png(frame[..., :3]) for frame in seen)
        for row in zip(*columns.values(), strict=True):
            yield dict(zip(columns, row, strict=True))


def _ended(values: NDArray[Any]) -> list[Any]:
    """Return T values, one for each action, and a zero for the last state."""
    return [*values.tolist(), np.zeros_like(values[0]).tolist()]


def _png(image: NDArray[np.uint8]) -> dict[str, Any]:
    """Encode a picture as Hugging Face's feature Image holds it."""
    return {"bytes": encode(image), "path": None}


def picture_columns() -> list[TableColumn]:
    """Return the columns of a perception table."""
    columns = TABLES["pictures"].items()
    return [TableColumn(name, column["type"], "", column["doc"]) for name, column in columns]


def write_parquet(
    path: Path, columns: Sequence[TableColumn], rows: Iterable[dict[str, Any]], group: int = 100
) -> int:
    """Write rows in groups of `group`; return how many there were."""
    pa, parquet = arrow(), arrow("pyarrow.parquet")
    kinds = schema({column.name: column.kind for column in columns})
    path.parent.mkdir(parents=True, exist_ok=True)
    count, left = 0, iter(rows)
    with parquet.ParquetWriter(path, kinds, compression="zstd") as writer:
        while held := list(islice(left, group)):
            writer.write_table(pa.Table.from_pylist(held, schema=kinds))
            count += len(held)
    return count
