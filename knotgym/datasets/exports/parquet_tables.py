"""Tables of states and episodes for Parquet files: columns and rows.

Arrays are stored flat, in C order. Column names have an underscore where the state file has a
slash.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from knotgym.datasets.episode_reader import Count, EpisodeReader, uncounted
from knotgym.datasets.image_table import COLUMNS as PICTURE_COLUMNS
from knotgym.datasets.image_table import arrow, arrow_type, encode, feature
from knotgym.states.schema import COLUMNS as STATE_COLUMNS
from knotgym.states.state_file import States


class TableColumn(NamedTuple):
    """One column of a table.

    Attributes:
        name: name in the file.
        kind: type, in the notation of `image_table.COLUMNS`.
        unit: "" for none.
        doc: description.
    """

    name: str
    kind: Any
    unit: str
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
                out[name] = {"bytes": encode(value), "path": None}
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
    """Yield the rows, with the columns of `step_columns`; holds one episode in memory.

    `count` is called before each episode.
    """
    for index in range(len(reader)):
        count(f"episodes of {dataset}", index, len(reader))
        episode = reader.episode(index)
        seen = reader.observations(index, observation="pixels") if pictures else None
        goal = episode.goal_points.ravel().tolist()
        for step in range(len(episode) + 1):
            last = step == len(episode)
            row = {
                "dataset": dataset,
                "episode": reader.rows[index],
                "step": step,
                "points": episode.points[step].ravel().tolist(),
                "goal_points": goal,
                "action": [0.0] * 6 if last else episode.actions[step].tolist(),
                "reward": 0.0 if last else float(episode.rewards[step]),
                "terminated": not last and bool(episode.terminations[step]),
                "truncated": not last and bool(episode.truncations[step]),
                "is_last": last,
                "gauss_code": str(episode.gauss_code[step]),
                "gauss_code_chiral": str(episode.gauss_code_chiral[step]),
                "goal_gauss_code": episode.goal_gauss_code,
                "crossings": int(episode.crossings[step]),
                "is_success": bool(episode.is_success[step]),
                "policy": episode.policy,
            }
            if seen is not None:
                row["image"] = {"bytes": encode(seen[step][..., :3]), "path": None}
            yield row


_PICTURE_DOCS = {
    "image": "PNG, lossless",
    "gauss_code": "the walk from the white base bead towards red",
    "gauss_code_chiral": "the same with chirality",
    "pd_code": "PD code; edge 1 leads from the base bead to the first crossing",
    "dt_code": "DT code, with the first crossing as 1",
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
    return [TableColumn(name, kind, "", _PICTURE_DOCS[name]) for name, kind in
            PICTURE_COLUMNS.items()]  # fmt: skip


def write_parquet(
    path: Path, columns: Sequence[TableColumn], rows: Iterable[dict[str, Any]], group: int = 100
) -> int:
    """Write rows in groups of `group`; return how many there were."""
    pa, parquet = arrow(), arrow("pyarrow.parquet")
    features = {column.name: feature(column.kind) for column in columns}
    schema = pa.schema(
        [(column.name, arrow_type(pa, column.kind)) for column in columns],
        metadata={"huggingface": json.dumps({"info": {"features": features}}, sort_keys=True)},
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    count = 0
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        held: list[dict[str, Any]] = []
        for row in rows:
            held.append(row)
            if len(held) == group:
                writer.write_table(pa.Table.from_pylist(held, schema=schema))
                count, held = count + group, []
        writer.write_table(pa.Table.from_pylist(held, schema=schema))
    return count + len(held)
