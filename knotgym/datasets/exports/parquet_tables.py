"""Tables of states and episodes as Parquet files.

Arrays are stored flat, in C order. Column names have an underscore where the state file has a
slash.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common.tables import Column, Schema, Table
from knotgym.datasets.episode_dataset import EpisodeDataset
from knotgym.datasets.episode_outcomes import outcomes
from knotgym.datasets.episodes import STEPS, gauss_codes, ranges
from knotgym.datasets.image_table import TABLES, arrow, encode, schema

_AT_ONCE = 256  # episodes converted at once
_TEXTS = (
    Column("dataset", "text", (), "", "id of the dataset"),
    Column("policy", "text", (), "", "that acted"),
    Column("gauss_code", "text", (), "", "Gauss code of the state"),
    Column("gauss_code_chiral", "text", (), "", "the same with chirality"),
    Column("goal_gauss_code", "text", (), "", "Gauss code to reach"),
)
_PLACES = (
    Column("episode", "int64", (), "", "number of the episode in its dataset"),
    Column("step", "int64", (), "", "number of the state in its episode"),
    Column("is_last", "bool", (), "", "the episode's last state, which has no action"),
    Column("is_success", "bool", (), "", "the goal has been shown for long enough"),
    Column("goal_points", "float32", ("beads", 3), "m", "vertices that show the goal"),
)
_IMAGE = Column("image", "uint8", ("height", "width", 3), "", "what the environment shows", True)
# columns that some datasets lack are left out, because a file's rows have the same columns
_KEPT = tuple(
    column._replace(name="points") if column.name == "observation" else column
    for column in STEPS.columns
    if column.name not in ("visits", "signs") and not column.optional
)
ROWS_OF_STEPS = Schema("steps", (*_TEXTS, *_PLACES, *_KEPT, _IMAGE))


class TableColumn(NamedTuple):
    """One column of a Parquet file; `kind` is its type in the notation of `image_table.COLUMNS`."""

    name: str
    kind: Any
    unit: str  # "" for none
    doc: str


def columns_of_table(table: Table) -> list[TableColumn]:
    """Return the columns in which `write_parquet` stores a table."""
    out = []
    for column in table.schema.columns:
        values, shape = table[column.name], ""
        if column.name == "image":
            kind: Any = "image"
        elif values.ndim > 1:
            kind = [values.dtype.name, int(np.prod(values.shape[1:]))]
            shape = f", {values.shape[1:]}" if values.ndim > 2 else ""
        else:
            kind = "string" if values.dtype.kind == "U" else values.dtype.name
        out.append(
            TableColumn(column.name.replace("/", "_"), kind, column.unit, column.doc + shape)
        )
    return out


def picture_columns() -> list[TableColumn]:
    """Return the columns of a perception table."""
    columns = TABLES["pictures"].items()
    return [TableColumn(name, column["type"], "", column["doc"]) for name, column in columns]


def step_tables(dataset: EpisodeDataset, pictures: bool) -> Iterator[Table]:
    """Yield a dataset's states, one row each, in tables of some episodes."""
    for first in range(0, dataset.episodes.episodes.rows, _AT_ONCE):
        last = min(first + _AT_ONCE, dataset.episodes.episodes.rows)
        yield _step_table(dataset.select(np.arange(first, last)), first, pictures)


def _step_table(part: EpisodeDataset, number: int, pictures: bool) -> Table:
    (own, steps), episode = part.episodes, part.episodes.episode_of()
    is_last = np.zeros(steps.rows, dtype=bool)
    is_last[part.episodes.last()] = True
    columns: dict[str, NDArray[Any]] = {
        **steps,
        "points": steps["observation"],
        "dataset": np.full(steps.rows, part.name),
        "policy": own["policy"][episode],
        "gauss_code": gauss_codes(steps["visits"]),
        "gauss_code_chiral": gauss_codes(steps["visits"], steps["signs"]),
        "goal_gauss_code": gauss_codes(own["goal_visits"])[episode],
        "episode": number + episode,
        "step": ranges(np.zeros_like(own["length"]), own["length"] + 1),
        "is_last": is_last,
        "is_success": outcomes(part.episodes, part.task).reached,
        "goal_points": own["goal_points"][episode],
    }
    if pictures:
        from knotgym.envs.observations import observe, picture_config

        picture, ends = picture_config(part.task), part.episodes.offsets
        seen = [
            observe(
                steps["observation"][ends[k] : ends[k + 1]].astype(np.float64),
                own["goal_points"][k].astype(np.float64),
                "pixels",
                picture,
            )
            for k in range(own.rows)
        ]
        columns["image"] = np.concatenate(seen)[..., :3]
    return Table(ROWS_OF_STEPS, columns)


def write_parquet(path: Path, tables: Iterable[Table]) -> tuple[int, list[TableColumn]]:
    """Append tables of equal columns to one file; return its rows and columns."""
    parquet, writer, rows = arrow("pyarrow.parquet"), None, 0
    columns: list[TableColumn] = []
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        for table in tables:
            made = _arrow_table(table)
            if writer is None:
                columns = columns_of_table(table)
                writer = parquet.ParquetWriter(path, made.schema, compression="zstd")
            writer.write_table(made, row_group_size=1000)
            rows += table.rows
    finally:
        if writer is not None:
            writer.close()
    return rows, columns


def _arrow_table(table: Table) -> Any:
    """Convert a table; its schema holds the features by which Hugging Face reads pictures."""
    pa, columns = arrow(), columns_of_table(table)
    kinds = schema({column.name: column.kind for column in columns})
    arrays = []
    for column, values in zip(columns, table.values(), strict=True):
        if column.kind == "image":
            pictures = [{"bytes": encode(image), "path": None} for image in values]
            arrays.append(pa.array(pictures, kinds.field(column.name).type))
        elif values.ndim > 1:
            flat = pa.array(np.ascontiguousarray(values).ravel())
            kind = kinds.field(column.name).type
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, type=kind))
        else:
            arrays.append(pa.array(values.tolist() if column.kind == "string" else values))
    return pa.Table.from_arrays(arrays, schema=kinds)
