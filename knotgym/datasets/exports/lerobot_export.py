"""Export episodes as a LeRobot dataset, format v3.0.

    {out}/meta/info.json, stats.json, tasks.parquet, episodes/chunk-000/file-000.parquet
    {out}/data/chunk-000/file-000.parquet ...       one row per step, pictures as lossless PNG

A row holds an observation, the action taken, and its outcome (`next.reward`, `next.done`,
`next.success`). The last state of an episode has no action and therefore no row. The task of an
episode is a sentence with the Gauss code of its goal, see `task_text`.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write, require_output
from knotgym.datasets.episode_reader import Count, EpisodeReader, uncounted
from knotgym.datasets.exports.forms import ExportError
from knotgym.datasets.image_table import arrow, encode, schema

VERSION = "v3.0"
FRAMES_PER_SECOND = 5  # an action takes 0.192 s; LeRobot needs an integer
_FILE_BYTES = 100 * 2**20  # a data file is closed when it holds this much
_CHUNK = 1000  # files per folder
_PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_NAMES = {"pixels": "observation.image", "state": "observation.environment_state"}


def to_lerobot(
    source: Any,
    out: str | os.PathLike[str],
    count: Count = uncounted,
    *,
    overwrite: bool = False,
) -> None:
    """Write the dataset into the new folder `out`, see `forms.export`.

    Raises:
        ExportError: no episodes, or the format has no place for their observations.
        MissingExtra: pyarrow isn't installed.
    """
    reader, folder = EpisodeReader(source), Path(out)
    task = reader.task
    require_output(folder, folder=True, overwrite=overwrite)
    plain = task.layout == "beside" and not task.depth
    if not len(reader) or task.observation == "symbolic" or not plain:
        raise ExportError(
            "LeRobot's format holds pixels, state or both, in layout beside and without depth;"
            f" {reader.path} has {len(reader)} episodes of {task.observation} in layout"
            f" {task.layout}{' with depth' if task.depth else ''}"
        )
    looks = [name for name in _NAMES if task.observation in (name, "both")]
    with atomic_write(folder, overwrite=overwrite) as temporary:
        _Writer(reader, looks, temporary).write(count)
    reader.close()


def task_text(goal: str) -> str:
    """Describe the goal of an episode in words.

    >>> task_text("1+,1-"), task_text("")
    ('Move the rope until its Gauss code is 1+,1-.', 'Untie the rope into a plain loop.')
    """
    if not goal:
        return "Untie the rope into a plain loop."
    return f"Move the rope until its Gauss code is {goal}."


class _Writer:
    """Writes a dataset episode by episode and accumulates its statistics."""

    def __init__(self, reader: EpisodeReader, looks: list[str], folder: Path) -> None:
        self.reader, self.looks, self.folder = reader, looks, folder
        self.tasks: dict[str, int] = {}
        self.episodes: list[dict[str, Any]] = []
        self.sums: dict[str, _Sums] = {}
        self.files = 0
        size = reader.task.image_size
        shown = {
            "pixels": {
                "dtype": "image",
                "shape": [len(reader.task.views) * size, 2 * size, 3],
                "names": ["height", "width", "channels"],
            },
            "state": _feature("float32", 100 * 6),
        }
        self.features = {
            **{_NAMES[look]: shown[look] for look in looks},
            "action": _feature("float32", 6, ["x", "y", "z", "fx", "fy", "fz"]),
            "next.reward": _feature("float32"),
            "next.done": _feature("bool"),
            "next.success": _feature("bool"),
            "gauss_code": _feature("string"),
            "timestamp": _feature("float32"),
            **{
                name: _feature("int64")
                for name in ("frame_index", "episode_index", "index", "task_index")
            },
        }

    def write(self, count: Count) -> None:
        """Write data files and metadata."""
        parquet, waiting, size = arrow("pyarrow.parquet"), [], 0
        schema = _schema(self.features)
        for k in range(len(self.reader)):
            count("episodes", k, len(self.reader))
            table = arrow().table(self._columns(k), schema=schema)
            waiting.append(table)
            size += table.nbytes
            if size >= _FILE_BYTES or k == len(self.reader) - 1:
                place = {"chunk_index": self.files // _CHUNK, "file_index": self.files % _CHUNK}
                path = self.folder / "data" / _PLACE.format(**place)
                path.parent.mkdir(parents=True, exist_ok=True)
                parquet.write_table(arrow().concat_tables(waiting), path)
                waiting, size, self.files = [], 0, self.files + 1
        self._write_meta()

    def _columns(self, k: int) -> list[Any]:
        """Return an episode's columns in the order of the features; add it to the metadata."""
        length = int(self.reader.lengths[k])
        goal = task_text(str(self.reader.attributes(k)["goal_gauss_code"]))
        number = self.tasks.setdefault(goal, len(self.tasks))
        first = self.episodes[-1]["dataset_to_index"] if self.episodes else 0
        steps = np.arange(length)
        column = {
            "action": self.reader.column(k, "actions"),
            "next.reward": self.reader.column(k, "rewards").astype(np.float32),
            "next.done": self.reader.column(k, "terminations")
            | self.reader.column(k, "truncations"),
            "next.success": self.reader.column(k, "is_success")[1:],
            "gauss_code": self.reader.column(k, "gauss_code")[:-1],
            "timestamp": (steps / FRAMES_PER_SECOND).astype(np.float32),
            "frame_index": steps,
            "episode_index": np.full(length, k),
            "index": first + steps,
            "task_index": np.full(length, number),
        }
        for look in self.looks:
            column[_NAMES[look]] = self.reader.observations(k, slice(0, length), observation=look)
        for name, values in column.items():
            if values.dtype.kind != "U":
                self.sums.setdefault(name, _Sums()).add(values)
        self.episodes.append(
            {
                "episode_index": k,
                "tasks": [goal],
                "length": length,
                "data/chunk_index": self.files // _CHUNK,
                "data/file_index": self.files % _CHUNK,
                "dataset_from_index": first,
                "dataset_to_index": first + length,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        return [_stored(column[name]) for name in self.features]

    def _write_meta(self) -> None:
        parquet, pa = arrow("pyarrow.parquet"), arrow()
        episodes = self.folder / "meta" / "episodes" / _PLACE.format(chunk_index=0, file_index=0)
        episodes.parent.mkdir(parents=True)
        parquet.write_table(pa.Table.from_pylist(self.episodes), episodes)
        tasks = pa.table({"task_index": [*self.tasks.values()], "task": [*self.tasks]})
        # LeRobot reads this table with pandas and looks tasks up in its index
        kinds = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        names = ("name", "field_name", "pandas_type", "numpy_type", "metadata")
        columns = [
            dict(zip(names, (name, name, kind, numpy_kind, None), strict=True))
            for name, kind, numpy_kind in kinds
        ]
        index = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
        parquet.write_table(
            tasks.replace_schema_metadata({"pandas": json.dumps(index)}),
            self.folder / "meta/tasks.parquet",
        )
        total = len(self.episodes)
        info = {
            "codebase_version": VERSION,
            "robot_type": "knotgym",
            "total_episodes": total,
            "total_frames": self.episodes[-1]["dataset_to_index"],
            "total_tasks": len(self.tasks),
            "chunks_size": _CHUNK,
            "data_files_size_in_mb": _FILE_BYTES >> 20,
            "video_files_size_in_mb": 200,
            "fps": FRAMES_PER_SECOND,
            "splits": {self.reader.task.split: f"0:{total}"},
            "data_path": f"data/{_PLACE}",
            "video_path": None,
            "features": self.features,
        }
        stats = {name: sums.stats() for name, sums in self.sums.items()}
        for name, content in (("info", info), ("stats", stats)):
            path = self.folder / "meta" / f"{name}.json"
            path.write_text(json.dumps(content, indent=1), encoding="utf-8")


class _Sums:
    """Running min, max, mean and standard deviation per component; of pictures, per channel."""

    def __init__(self) -> None:
        self.count = self.frames = 0
        self.least: Any = np.inf
        self.most: Any = -np.inf
        self.total: Any = 0.0
        self.squares: Any = 0.0
        self.shape: tuple[int, ...] = (-1,)

    def add(self, values: NDArray[Any]) -> None:
        """Add values (T,), (T, n) or pictures uint8 (T, height, width, 3)."""
        numbers = values.reshape(-1, values.shape[-1] if values.ndim > 1 else 1).astype(np.float64)
        if values.ndim == 4:
            # LeRobot scales pictures to [0, 1]; statistics have shape (3, 1, 1)
            numbers, self.shape = numbers / 255, (-1, 1, 1)
        self.least = np.minimum(self.least, numbers.min(axis=0))
        self.most = np.maximum(self.most, numbers.max(axis=0))
        self.total = self.total + numbers.sum(axis=0)
        self.squares = self.squares + (numbers**2).sum(axis=0)
        self.count, self.frames = self.count + len(numbers), self.frames + len(values)

    def stats(self) -> dict[str, Any]:
        """Return them in the layout of LeRobot's stats.json."""
        mean = self.total / self.count
        std = np.sqrt(np.maximum(self.squares / self.count - mean**2, 0))
        each = {"min": self.least, "max": self.most, "mean": mean, "std": std}
        return {
            **{name: value.reshape(self.shape).tolist() for name, value in each.items()},
            "count": [self.frames],
        }


def _feature(dtype: str, length: int = 1, names: list[str] | None = None) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [length], "names": names}


def _stored(values: NDArray[Any]) -> Any:
    """Convert a column for pyarrow; pictures become PNG."""
    if values.ndim == 4:
        return [{"bytes": encode(picture), "path": None} for picture in values]
    if values.ndim == 2:
        pa = arrow()
        return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
    return values


def _schema(features: dict[str, dict[str, Any]]) -> Any:
    """Return the pyarrow schema of data files, with Hugging Face features in its metadata."""
    kinds: dict[str, Any] = {}
    for name, one in features.items():
        is_list = one["dtype"] != "image" and one["shape"][0] > 1
        kinds[name] = [one["dtype"], one["shape"][0]] if is_list else one["dtype"]
    found = schema(kinds)
    declared = found.metadata[b"huggingface"].replace(b'"List"', b'"Sequence"')  # LeRobot's word
    return found.with_metadata({"huggingface": declared})
