"""Tables of states and episodes for Parquet files: columns and rows.

Arrays are stored flat, in C order. Column names have an underscore where the state file has a
slash.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.datasets.episode_reader import Count, EpisodeReader, uncounted
from knotgym.datasets.image_table import COLUMNS as PICTURE_COLUMNS
from knotgym.datasets.image_table import arrow, encode, schema
from knotgym.states.schema import COLUMNS as STATE_COLUMNS
from knotgym.states.state_file import States


class TableColumn(NamedTuple):
    """One column of a table; `kind` is its type in the notation of `image_table.COLUMNS`."""

    name: str
    kind: Any
    unit: str  # "" for none
    doc: str


def state_columns(states: States) -> list[TableColumn]:
    """Return the columns that a state file has."""
    known = {column.name: column for column in STATE_COLUMNS}
    out = []
    for name, values in states.columns().items():
        column = known.get(name)
        if name == "image":
            kind: Any = "image"
        elif values.ndim > 1:
            kind = [values.dtype.name, int(np.prod(values.shape[1:]))]
        else:
            kind = "string" if values.dtype.kind == "U" else values.dtype.name
        shape = f", {values.shape[1:]}" if values.ndim > 2 and name != "image" else ""
        unit = column.unit if column else states.units.get(name.partition("/")[2], "")
        doc = column.doc if column else "a measure of the state"
        out.append(TableColumn(name.replace("/", "_"), kind, unit, doc + shape))
    return out


def state_rows(states: States) -> Iterator[dict[str, Any]]:
    """Yield the rows, with the columns of `state_columns`."""
    columns = states.columns()
    for row in range(len(states)):
        out = {}
        for name, values in columns.items():
            value = values[row]
            if name == "image":
                out[name] = _png(value)
            else:
                out[name.replace("/", "_")] = value.ravel().tolist() if value.ndim else value.item()
        yield out


def step_columns(pictures: bool, beads: int) -> list[TableColumn]:
    """Return the columns of a table of episodes, one row per state."""
    ropes = ["float64", 3 * beads]
    image = TableColumn("image", "image", "levels", "what the agent saw: rope left, goal right")
    return [
        *([image] if pictures else []),
        TableColumn("dataset", "string", "", "Minari dataset of the episode"),
        TableColumn("episode", "int64", "", "its index there"),
        TableColumn("step", "int64", "actions", "number taken before this state"),
        TableColumn("points", ropes, "m", "vertices of the rope, bead by bead"),
        TableColumn("goal_points", ropes, "m", "vertices of the state that shows the goal"),
        TableColumn(
            "action", ["float32", 6], "[-1, 1]", "taken here: position / 2 m, force / 0.2 N"
        ),
        TableColumn("reward", "float64", "", "reward of that action"),
        TableColumn("terminated", "bool", "", "that action ended the task"),
        TableColumn("truncated", "bool", "", "the step limit was reached after it"),
        TableColumn("is_last", "bool", "", "last state of the episode; action and reward are 0"),
        TableColumn("gauss_code", "string", "", "Gauss code of the state"),
        TableColumn("gauss_code_chiral", "string", "", "the same with chirality"),
        TableColumn("goal_gauss_code", "string", "", "Gauss code of the goal"),
        TableColumn("crossings", "int64", "crossings", "in the picture of the state"),
        TableColumn("is_success", "bool", "", "the goal is reached"),
        TableColumn("policy", "string", "", "policy that chose the actions"),
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


_PICTURE_DOCS = {
    "image": "PNG, lossless",
    "gauss_code": "the walk from the white base bead towards red",
    "gauss_code_chiral": "the same with chirality",
    "nx": "crossings",
    "knot": "knot type",
    "points": "vertices of the rope, bead by bead, m",
    "crossings": "pixel of each, positions of its two strands along the rope in beads, sign",
    "split": "train, test, test-code (unseen codes) or test-nx (more crossings)",
    "accepted": "passes every limit for curated states",
    "grade": "difficulty of reading the picture",
    "quality": "quality measures of the published picture",
    "appearance": "how the picture was rendered",
    "source": "how the configuration was made",
}


def picture_columns() -> list[TableColumn]:
    """Return the columns of a perception table."""
    columns = PICTURE_COLUMNS.items()
    return [TableColumn(name, kind, "", _PICTURE_DOCS[name]) for name, kind in columns]


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
