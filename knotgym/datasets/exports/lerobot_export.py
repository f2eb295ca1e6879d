"""Export episodes as a LeRobot dataset, format v3.0.

    {out}/README.md                                 the card
    {out}/meta/info.json, stats.json, tasks.parquet, episodes/chunk-000/file-000.parquet
    {out}/data/chunk-000/file-000.parquet ...       one row per step, pictures as lossless PNG
    {out}/videos/observation.image/chunk-000/file-000.mp4 ...       or pictures as video

A row holds an observation, the action taken, and its outcome (`next.reward`, `next.done`,
`next.success`). The last state of an episode has no action and therefore no row. The task of an
episode is a sentence with the Gauss code of its goal, see `task_text`.

LeRobot's policies need `observation.state`, elsewhere the joints of a robot. Here it is the centre
of the rope, on which pictures are centred: with it, a place in the picture can be turned into the
coordinates of an action.

A video file holds the frames of many episodes one after another; the metadata of each episode says
in which file and from when to when. Source: `lerobot` 0.4.4.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write, require_output
from knotgym.common.errors import InvalidInput
from knotgym.datasets.cards.citation import filled, write_text
from knotgym.datasets.episode_reader import Count, EpisodeReader, uncounted
from knotgym.datasets.image_table import arrow, encode, schema
from knotgym.rendering.video import FRAMES_PER_SECOND, Codec, Encoder, pyav

VERSION = "v3.0"
# Every second frame is a key frame, as LeRobot does it, so that random access is fast.
# The rope's colours say where along it a bead lies. 4:2:0 keeps them at half the resolution, which
# limits any encoder to 32 dB on strands of two pixels; SVT-AV1 has no other format.
VIDEO_CODECS = {
    "h264": Codec("libx264", "yuv444p", {"crf": "18", "g": "2"}),
    "av1": Codec("libsvtav1", "yuv420p", {"crf": "20", "g": "2", "preset": "8"}),
}
LEAST_PSNR = {"h264": 40, "av1": 28}  # dB of any frame of 128 pixels, with a margin
_LEAST_SIDE = 64  # pixels, of SVT-AV1
_FILE_BYTES = 100 * 2**20  # a data file is closed when it holds this much
_VIDEO_BYTES = 200 * 2**20  # a video file is closed before an episode when it holds this much
_CHUNK = 1000  # files per folder
_PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_NAMES = {"pixels": "observation.image", "state": "observation.environment_state"}
_IMAGE = _NAMES["pixels"]
_VIDEO_PATH = f"videos/{{video_key}}/{_PLACE}.mp4"
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def to_lerobot(
    source: Any,
    out: str | os.PathLike[str],
    count: Count = uncounted,
    *,
    overwrite: bool = False,
    video: str = "",
) -> None:
    """Write the dataset into the new folder `out`, see `forms.export`.

    Args:
        source, out, count, overwrite: as in `forms.export`.
        video: "h264" or "av1" for pictures as video, which is lossy; "" for PNG.

    Raises:
        InvalidInput: no episodes, the format has no place for their observations, or they can't be
            written as this video.
        MissingExtra: pyarrow isn't installed.
        InvalidInput: PyAV isn't installed.
    """
    reader, folder = EpisodeReader(source), Path(out)
    task = reader.task
    require_output(folder, folder=True, overwrite=overwrite)
    plain = task.layout == "beside" and not task.depth
    if not len(reader) or task.observation == "symbolic" or not plain:
        raise InvalidInput(
            "LeRobot's format holds pixels, state or both, in layout beside and without depth;"
            f" {reader.path} has {len(reader)} episodes of {task.observation} in layout"
            f" {task.layout}{' with depth' if task.depth else ''}"
        )
    looks = [name for name in _NAMES if task.observation in (name, "both")]
    if video:
        _require_video(video, reader, looks)
    with atomic_write(folder, overwrite=overwrite) as temporary:
        _Writer(reader, looks, temporary, video).write(count)
    reader.close()


def _require_video(video: str, reader: EpisodeReader, looks: list[str]) -> None:
    size = reader.task.image_size
    if video not in VIDEO_CODECS:
        raise InvalidInput(f"no video {video!r}; there is {', '.join(VIDEO_CODECS)}")
    if "pixels" not in looks:
        raise InvalidInput(f"{reader.path} has no pictures to write as video, only {looks[0]}")
    if video == "av1" and (size < _LEAST_SIDE or size % 2):
        raise InvalidInput(
            f"AV1 needs an even number of at least {_LEAST_SIDE} pixels a side, and"
            f" {reader.path} has {size}; use h264, or collect with another image_size"
        )
    pyav("export without video")


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

    def __init__(self, reader: EpisodeReader, looks: list[str], folder: Path, video: str) -> None:
        self.reader, self.looks, self.folder, self.video = reader, looks, folder, video
        self.tasks: dict[str, int] = {}
        self.episodes: list[dict[str, Any]] = []
        self.stats: list[_Stats] = []  # of each episode
        self.files = 0
        self.videos, self.video_frames = 0, 0  # files begun; frames in the last one
        self.encoder: Encoder | None = None
        size = reader.task.image_size
        shape = [len(reader.task.views) * size, 2 * size, 3]
        picture: dict[str, Any] = {
            "dtype": "video" if video else "image",
            "shape": shape,
            "names": ["height", "width", "channels"],
        }
        if video:
            picture["info"] = {
                "video.height": shape[0],
                "video.width": shape[1],
                "video.codec": video,
                "video.pix_fmt": VIDEO_CODECS[video].pixels,
                "video.is_depth_map": False,
                "video.fps": FRAMES_PER_SECOND,
                "video.channels": 3,
                "has_audio": False,
            }
        beads = reader.column(0, "points").shape[1]
        shown = {"pixels": picture, "state": _feature("float32", 6 * beads)}
        self.features = {
            **{_NAMES[look]: shown[look] for look in looks},
            "observation.state": _feature("float32", 3, ["x", "y", "z"]),
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
        self.columns = [name for name, one in self.features.items() if one["dtype"] != "video"]

    def write(self, count: Count) -> None:
        """Write data files, videos and metadata."""
        parquet, waiting, size = arrow("pyarrow.parquet"), [], 0
        schema = _schema({name: self.features[name] for name in self.columns})
        for k in range(len(self.reader)):
            count("episodes", k, len(self.reader))
            table = arrow().table(self._columns(k), schema=schema)
            waiting.append(table)
            size += table.nbytes
            if size >= _FILE_BYTES or k == len(self.reader) - 1:
                path = self.folder / "data" / f"{_PLACE.format(**_place(self.files))}.parquet"
                path.parent.mkdir(parents=True, exist_ok=True)
                parquet.write_table(arrow().concat_tables(waiting), path)
                waiting, size, self.files = [], 0, self.files + 1
        if self.encoder is not None:
            self.encoder.close()
        self._write_meta()

    def _columns(self, k: int) -> list[Any]:
        """Return an episode's columns in the order of the features; add it to the metadata."""
        length = int(self.reader.lengths[k])
        goal = task_text(str(self.reader.attributes(k)["goal_gauss_code"]))
        number = self.tasks.setdefault(goal, len(self.tasks))
        first = self.episodes[-1]["dataset_to_index"] if self.episodes else 0
        steps = np.arange(length)
        centre = self.reader.column(k, "points")[:-1].mean(axis=1)
        column = {
            "observation.state": centre.astype(np.float32),
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
        stats = {
            name: _stats(values) for name, values in column.items() if values.dtype.kind != "U"
        }
        self.stats.append(stats)
        self.episodes.append(
            {
                "episode_index": k,
                "tasks": [goal],
                "length": length,
                **{f"data/{name}": index for name, index in _place(self.files).items()},
                "dataset_from_index": first,
                "dataset_to_index": first + length,
                **(self._encode(column[_IMAGE]) if self.video else {}),
                **{
                    f"stats/{name}/{kind}": value.tolist()
                    for name, of in stats.items()
                    for kind, value in of.items()
                },
                **{f"meta/episodes/{name}": index for name, index in _place(0).items()},
            }
        )
        return [_stored(column[name]) for name in self.columns]

    def _encode(self, frames: NDArray[np.uint8]) -> dict[str, Any]:
        """Add an episode to the video files; return where it is, as columns of its metadata."""
        if self.encoder is not None and self.encoder.size >= _VIDEO_BYTES:
            self.encoder.close()
            self.encoder = None
        if self.encoder is None:
            path = self.folder / _VIDEO_PATH.format(video_key=_IMAGE, **_place(self.videos))
            path.parent.mkdir(parents=True, exist_ok=True)
            self.encoder = Encoder(path, VIDEO_CODECS[self.video], frames.shape[1:])
            self.videos, self.video_frames = self.videos + 1, 0
        for frame in frames:
            self.encoder.add(frame)
        begin, self.video_frames = self.video_frames, self.video_frames + len(frames)
        return {
            **{f"videos/{_IMAGE}/{key}": at for key, at in _place(self.videos - 1).items()},
            f"videos/{_IMAGE}/from_timestamp": begin / FRAMES_PER_SECOND,
            f"videos/{_IMAGE}/to_timestamp": self.video_frames / FRAMES_PER_SECOND,
        }

    def _write_meta(self) -> None:
        parquet, pa = arrow("pyarrow.parquet"), arrow()
        episodes = self.folder / "meta/episodes" / f"{_PLACE.format(**_place(0))}.parquet"
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
            "video_files_size_in_mb": _VIDEO_BYTES >> 20,
            "fps": FRAMES_PER_SECOND,
            "splits": {self.reader.task.split: f"0:{total}"},
            "data_path": f"data/{_PLACE}.parquet",
            "video_path": _VIDEO_PATH if self.video else None,
            "features": self.features,
        }
        stats = {
            name: {kind: value.tolist() for kind, value in _aggregated(name, self.stats).items()}
            for name in self.stats[0]
        }
        for name, content in (("info", info), ("stats", stats)):
            path = self.folder / "meta" / f"{name}.json"
            path.write_text(json.dumps(content, indent=1), encoding="utf-8")
        self._write_card(info)

    def _write_card(self, info: dict[str, Any]) -> None:
        task = self.reader.task
        pictures = "No pictures."
        if "pixels" in self.looks:
            pictures = "Pictures are lossless PNG."
        if self.video:
            codec = VIDEO_CODECS[self.video]
            pictures = (
                f"Pictures are video, {codec.encoder} with {codec.pixels} and"
                f" crf {codec.options['crf']}, which is **lossy**: at 128 pixels a side every frame"
                f" keeps at least {LEAST_PSNR[self.video]} dB (PSNR). Colours say where along the"
                " rope a bead lies; where they matter, use PNG."
            )
        write_text(
            self.folder / "README.md",
            filled(
                "lerobot_card.md",
                pictures=pictures,
                task=f"{task.task}, nx {task.nx}, split {task.split}, engine {task.engine}",
                **{key: info[key] for key in ("total_episodes", "total_frames", "total_tasks")},
            ),
        )


_Stats = dict[str, dict[str, NDArray[Any]]]  # feature -> statistic -> values


def _stats(values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Return the statistics that LeRobot keeps of an episode.

    Args:
        values: (T,), (T, n) or pictures uint8 (T, height, width, 3).

    Returns:
        min, max, mean, std and five quantiles, shape (1,), (n,), or (3, 1, 1) of pictures per
        channel, scaled to [0, 1]; and the count of frames, (1,).
    """
    numbers = values.reshape(-1, values.shape[-1] if values.ndim > 1 else 1)
    scale, shape = (255, (-1, 1, 1)) if values.ndim == 4 else (1, (-1,))
    if values.dtype == bool:
        numbers = numbers.astype(np.float64)
    found = {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0, dtype=np.float64),
        "std": numbers.std(axis=0, dtype=np.float64),
        **dict(zip(_QUANTILES, np.quantile(numbers, [*_QUANTILES.values()], axis=0), strict=True)),
    }
    scaled = {kind: (value / scale).reshape(shape) for kind, value in found.items()}
    return {**scaled, "count": np.array([len(values)])}


def _aggregated(name: str, episodes: list[_Stats]) -> dict[str, NDArray[Any]]:
    """Combine the statistics of a feature as LeRobot does: quantiles are weighted means."""
    each = {kind: np.stack([one[name][kind] for one in episodes]) for kind in episodes[0][name]}
    count = each["count"]
    share = (count / count.sum()).reshape(-1, *[1] * (each["mean"].ndim - 1))
    mean = (share * each["mean"]).sum(axis=0)
    # the variance of all is the mean variance plus the variance of the means
    variance = (share * (each["std"] ** 2 + (each["mean"] - mean) ** 2)).sum(axis=0)
    return {
        "min": each["min"].min(axis=0),
        "max": each["max"].max(axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        **{kind: (share * each[kind]).sum(axis=0) for kind in _QUANTILES},
        "count": count.sum(axis=0),
    }


def _place(number: int) -> dict[str, int]:
    """Return the folder and the place in it of a numbered file."""
    return {"chunk_index": number // _CHUNK, "file_index": number % _CHUNK}


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
