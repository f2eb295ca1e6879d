"""Tables of states and episodes as Parquet files.

Arrays are stored flat, in C order. Column names have an underscore where the state file has a
slash.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Column, Schema, Table
from knotgym.datasets.episode_dataset import EpisodeDataset
from knotgym.datasets.episodes import STEPS, gauss_codes, goal_reached, ranges
from knotgym.datasets.image_table import arrow, encode, picture_column, shown

_AT_ONCE = 256  # episodes converted at once
_PNG_LEVEL = 6  # level 9 takes four times as long, for a twentieth less
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
_KEPT = tuple(
    column._replace(name="points") if column.name == "observation" else column
    for column in STEPS.columns
    if column.name not in ("visits", "signs")
)
ROWS_OF_STEPS = Schema("steps", (*_TEXTS, *_PLACES, *_KEPT, _IMAGE))


def rows_of_steps(datasets: Iterable[EpisodeDataset], pictures: bool) -> Schema:
    """Return the columns of a file of these datasets: optional ones if any of them has them."""
    stored = {name for one in datasets for name in one.episodes.steps}
    lacking = [c.name for c in _KEPT if c.optional and c.name not in stored]
    return ROWS_OF_STEPS.without(*lacking, *([] if pictures else ["image"]))


def step_tables(dataset: EpisodeDataset, schema: Schema) -> Iterator[Table]:
    """Yield a dataset's states, one row each, in tables of some episodes.

    Args:
        dataset: columns.
        schema: `rows_of_steps`; optional columns that the dataset lacks hold `Column.unknown`.
    """
    pictures = any(column.name == "image" for column in schema.columns)
    for first in range(0, dataset.episodes.episodes.rows, _AT_ONCE):
        last = min(first + _AT_ONCE, dataset.episodes.episodes.rows)
        yield _step_table(dataset.select(np.arange(first, last)), first, pictures).filled(schema)


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
        "is_success": goal_reached(part.episodes, part.task),
        "goal_points": own["goal_points"][episode],
    }
    if pictures:
        from knotgym.envs import alone, looks, picture_config, pixels

        picture, ropes = picture_config(part.task), own["goal_points"].astype(np.float64)
        shown = looks(part.task, zip(own["goal"].tolist(), ropes, strict=True))
        goals = alone(ropes, shown, picture)
        points = steps["observation"].astype(np.float64)
        each, look = [goals[k] for k in episode], [shown[k] for k in episode]
        columns["image"] = pixels(points, each, picture, looks=look)[..., :3]
    return Table(ROWS_OF_STEPS, columns)


def write_parquet(path: Path, tables: Iterable[Table]) -> tuple[int, str]:
    """Append tables of equal columns to one file; return its rows and a page of its columns."""
    parquet, writer, rows, page = arrow("pyarrow.parquet"), None, 0, ""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        for table in tables:
            made = _arrow_table(table)
            if writer is None:
                writer = parquet.ParquetWriter(path, made.schema, compression="zstd")
                page = table.schema.page()
            writer.write_table(made, row_group_size=1000)
            rows += table.rows
    finally:
        if writer is not None:
            writer.close()
    return rows, page


def _arrow_table(table: Table) -> Any:
    """Convert a table; its metadata say where Hugging Face finds pictures."""
    pa, columns = arrow(), dict[str, Any]()
    for name, values in table.items():
        flat = np.ascontiguousarray(values).reshape(len(values), -1)
        if name == "image":
            column = picture_column(encode(one, _PNG_LEVEL) for one in values)
        elif values.ndim > 1:
            column = pa.FixedSizeListArray.from_arrays(pa.array(flat.ravel()), flat.shape[1])
        else:
            column = pa.array(values.tolist() if values.dtype.kind == "U" else values)
        columns[name.replace("/", "_")] = column
    return pa.table(columns, metadata=shown("image") if "image" in columns else None)
