"""Write episode files, one episode at a time, and merge them; `episode_reader` has the layout.

A chunk of pictures is a strip: a few pixel rows of eight consecutive frames. The goal half doesn't
change between frames, and in a strip gzip's window still reaches the previous frame. Level 1 then
compresses as well as a higher level does with one frame per chunk, and reading a frame takes less
than 1 ms.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from functools import cache
from importlib.metadata import version
from itertools import product
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common.atomic_files import atomic_write
from knotgym.common.errors import InvalidFile
from knotgym.common.hdf5_files import Column, stored_column
from knotgym.common.tables import new_hdf5
from knotgym.datasets.episode_reader import (
    ATTRIBUTES_DIGEST,
    FORMAT,
    FORMAT_VERSION,
    GOAL_INFO,
    ONCE,
    POINTS,
    STORED,
    Count,
    EpisodeReader,
    attributes_digest,
    dataset_path,
    uncounted,
)
from knotgym.datasets.trajectory import Episode
from knotgym.envs.observations import observe, picture_config
from knotgym.envs.tasks import TaskConfig

_STRIP_FRAMES = 8
# bytes of one frame in a strip: the same pixel rows of the previous frame then lie within gzip's
# 32 kB window
_STRIP_BYTES = 12288
_GZIP_LEVEL = 1
_CHUNK_STEPS = 64  # steps per chunk, of everything but pictures
_INTERMEDIATE = h5py.h5p.create(h5py.h5p.LINK_CREATE)
_INTERMEDIATE.set_create_intermediate_group(True)
_SMALL = 4096  # bytes; a smaller array is stored contiguously: chunking it costs more than it saves


class EpisodeWriter:
    """Writer of an episode file that keeps one episode in memory at a time.

    Use it as a context manager; the file appears at its path when the block ends without an error.
    """

    def __init__(
        self, path: str | os.PathLike[str], task: TaskConfig, *, compact: bool = False
    ) -> None:
        """Prepare a file of episodes of one task; an existing file is replaced.

        `task.observation` says which observations are stored; with `compact` none are, and they are
        rendered when read.
        """
        self.path = Path(path)
        self.task = task
        self.stored = "none" if compact else task.observation
        self._stack = ExitStack()
        self._next = 0
        self._index: list[tuple[int, int]] = []

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            temporary = stack.enter_context(atomic_write(self.path))
            created = _created(temporary, _attributes(self.task, self.stored))
            self._file = stack.enter_context(created)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._stack:
            if error is not None:
                raise error
            _write_index(self._file, self._index)

    def add(self, episode: Episode, number: int | None = None) -> None:
        """Write an episode of the writer's task.

        `number` counts the episodes of all files to be merged; by default one more than the last.
        """
        number = self._next if number is None else number
        self._next = number + 1
        self._index.append((number, len(episode)))
        group = self._file.create_group(f"episode_{number}")
        attributes = episode.attributes()
        options = {f"options/{name}": row for name, row in attributes.pop("options").items()}
        counts = {"id": number, "number": number, "total_steps": len(episode)}
        arrays = episode.arrays()
        once = {name: arrays.pop(name) for name in ONCE}
        attributes |= {**counts, "digest": episode.digest(), **options, **once}
        _set_attributes(group, attributes)
        for name, array in arrays.items():
            _write(group, dataset_path(name), array)
        # the goal's code at every state, for readers that know infos alone
        _write(group, GOAL_INFO, np.full(len(episode) + 1, episode.goal_gauss_code))
        _observe(group, self.task, self.stored, episode.points, episode.goal_points)


def merge_episodes(
    sources: Sequence[Any],
    target: str | os.PathLike[str],
    *,
    store: str | None = None,
    concatenate: bool = False,
    distinct: bool = False,
    task: TaskConfig | None = None,
    attributes: Mapping[str, str] | None = None,
    count: Count = uncounted,
) -> None:
    """Merge the episodes of several files into one, numbered from 0.

    Compressed chunks are copied without encoding them again, so the same episodes give the same
    bytes however they were distributed over files.

    Args:
        sources: what `EpisodeReader` takes; all of one task and rope.
        target: path of the merged file; an existing file is replaced.
        store: observations in the target, one of STORED; rendered where the sources store others.
            None keeps those of the sources.
        concatenate: append the sources one after another; otherwise order episodes by their number,
            as for the shards of one run.
        distinct: refuse two equal episodes.
        task: task of the target, for episodes that are assigned to another split: `split` and
            `states` of the sources may then differ.
        attributes: further attributes of the target file.

    Raises:
        InvalidFile: the sources can't be combined, two episodes have the same number, or two
            are equal although `distinct` is set.
    """
    if store is not None and store not in STORED:
        raise InvalidFile(f"store must be one of {', '.join(STORED)}, got {store!r}")
    readers = [EpisodeReader(source) for source in sources]
    _require_one_kind(readers, task)
    first = readers[0]
    # every check comes before the target is created
    order = _in_order(readers, concatenate)
    if distinct:
        _require_distinct(order)
    store = store or first.stored
    task = task or first.task
    task = replace(task, observation=store) if store != "none" else task
    versions = {
        name: ", ".join(sorted({reader.versions[name] for reader in readers}))
        for name in first.versions
    }
    written = {
        **(attributes or {}),
        **_attributes(task, store),
        "rope": first.rope,
        "versions": json.dumps(versions),
    }
    with atomic_write(target) as temporary, _created(temporary, written) as file:
        for number, (reader, i) in enumerate(order):
            count("episodes", number, len(order))
            source, group = reader.group(i), file.create_group(f"episode_{number}")
            _copy(source, group, number, keep=store == first.stored)
            if store != first.stored:
                _observe(group, task, store, group[POINTS][()], group.attrs["goal_points"])
        lengths = [int(reader.lengths[i]) for reader, i in order]
        _write_index(file, list(enumerate(lengths)))
    for reader in readers:
        reader.close()


def _require_one_kind(readers: Sequence[EpisodeReader], task: TaskConfig | None) -> None:
    """Refuse sources of different tasks, ropes or observations.

    With a `task`, its `split` and `states` replace those of the sources first.
    """
    if not readers:
        raise InvalidFile("nothing to merge: give at least one file")
    first = readers[0]
    replaced: dict[str, Any] = {}
    if task is not None:
        replaced = {"split": task.split, "states": task.states}
    for other in readers[1:]:
        if other.task.engine != first.task.engine:
            raise InvalidFile(
                f"files to merge must be of one engine; {first.path} is of {first.task.engine},"
                f" {other.path} of {other.task.engine}"
            )
        for name in ("task", "rope", "stored"):
            one, two = getattr(first, name), getattr(other, name)
            if name == "task":
                one, two = replace(one, **replaced), replace(two, **replaced)
            if one != two:
                raise InvalidFile(
                    f"files to merge must have one {name}; {first.path} has {one}, {other.path}"
                    f" has {two}"
                )


def _require_distinct(order: Sequence[tuple[EpisodeReader, int]]) -> None:
    """Refuse two episodes with the same digest."""
    seen: dict[str, str] = {}
    for reader, i in order:
        here = f"episode {reader.rows[i]} of {reader.path}"
        earlier = seen.setdefault(str(reader.attributes(i)["digest"]), here)
        if earlier is not here:
            raise InvalidFile(
                f"{earlier} and {here} are the same; merge datasets that share no episode"
            )


def _in_order(
    readers: Sequence[EpisodeReader], concatenate: bool
) -> list[tuple[EpisodeReader, int]]:
    """List the episodes of all files, each by its reader and its position there.

    The order is file by file, or by number; numbers must then differ.
    """
    episodes = [(reader, i) for reader in readers for i in range(len(reader))]
    if concatenate:
        return episodes
    numbers = [int(reader.attributes(i)["number"]) for reader, i in episodes]
    if len(set(numbers)) < len(numbers):
        twice = next(number for number in sorted(numbers) if numbers.count(number) > 1)
        raise InvalidFile(
            f"two episodes have number {twice}, which shards of one run never have; merge other"
            " datasets with concatenate"
        )
    return [episodes[k] for k in np.argsort(numbers, kind="stable")]


def _attributes(task: TaskConfig, stored: str) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "task": json.dumps(asdict(task), sort_keys=True),
        "rope": task.rope.fingerprint,
        "stored": stored,
        "versions": json.dumps({"knotgym": knotgym.__version__, "mujoco": _mujoco()}),
    }


@cache
def _mujoco() -> str:
    """Return MuJoCo's version, cached: the lookup takes as long as rendering ten pictures."""
    return version("mujoco")


def _write_index(file: h5py.File, index: list[tuple[int, int]]) -> None:
    """List k and T of all episodes in one attribute, so that large files open quickly."""
    file.attrs["index"] = np.array(sorted(index), dtype=np.int32).reshape(-1, 2)


@contextmanager
def _created(path: Path, attributes: dict[str, Any]) -> Iterator[h5py.File]:
    with new_hdf5(path, libver=("v110", "v110")) as file:
        file.attrs.update(attributes)
        file.attrs[ATTRIBUTES_DIGEST] = attributes_digest(file.attrs)
        yield file


def _observe(
    group: h5py.Group,
    task: TaskConfig,
    stored: str,
    points: NDArray[np.float64],
    goal_points: NDArray[np.float64],
) -> None:
    """Render the observations of an episode and write them."""
    if stored == "none":
        return
    seen = observe(points, goal_points, stored, picture_config(task), task.layout)
    if stored != "both":
        _write(group, "observations", seen)
        return
    for name, array in seen.items():
        _write(group, f"observations/{name}", array)


def _write(group: h5py.Group, name: str, array: NDArray[Any]) -> None:
    if array.dtype.kind == "U":
        encoded = np.char.encode(array, "utf-8")
        group.create_dataset(
            name, data=encoded.astype(h5py.string_dtype("utf-8", max(1, encoded.dtype.itemsize)))
        )
    elif array.nbytes < _SMALL:
        group.create_dataset(name, data=array)
    else:
        chunks: tuple[int, ...] = (min(len(array), _CHUNK_STEPS), *array.shape[1:])
        if array.dtype == np.uint8:
            rows = max(1, min(array.shape[1], _STRIP_BYTES // array[0, 0].nbytes))
            chunks = (min(len(array), _STRIP_FRAMES), rows, *array.shape[2:])
        group.create_dataset(
            name,
            data=array,
            chunks=chunks,
            compression="gzip",
            compression_opts=_GZIP_LEVEL,
            shuffle=True,
        )


def _set_attributes(group: h5py.Group, attributes: Mapping[str, Any]) -> None:
    """Set the attributes that aren't None in sorted order, which determines the file's bytes."""
    for name, value in sorted(attributes.items()):
        if value is not None:
            group.attrs[name] = value


def _copy(source: h5py.Group, target: h5py.Group, number: int, keep: bool) -> None:
    """Copy an episode under a new number, with its observations if `keep` is set."""
    _set_attributes(target, {**source.attrs, "id": number, "number": number})
    for name in _members(source):
        if keep or not name.startswith("observations"):
            data = stored_column(source, Column(name, "any", None), {})
            # rows of variable length are references into the source file's heap
            if data.dtype.kind == "O":
                raise InvalidFile(f"{source.file.filename}: {name} should be text of fixed length")
            _copy_dataset(data, target, name)


def _copy_dataset(source: h5py.Dataset, target: h5py.Group, name: str) -> None:
    """Copy an array without decompressing its chunks.

    HDF5's own H5Ocopy would write bytes that depend on the rest of the source file.
    """
    like = source.id.get_create_plist()
    copied = h5py.h5d.create(
        target.id, name.encode(), source.id.get_type(), source.id.get_space(), like, _INTERMEDIATE
    )
    if source.chunks is None:
        h5py.Dataset(copied)[()] = source[()]
        return
    # one raw chunk at a time, as it is compressed; `mask` says which filters were skipped
    axes = zip(source.shape, source.chunks, strict=True)
    for start in product(*(range(0, size, chunk) for size, chunk in axes)):
        mask, stored = source.id.read_direct_chunk(start)
        copied.write_direct_chunk(start, stored, mask)


def _members(group: h5py.Group) -> list[str]:
    """List the paths of all arrays of an episode: sorted, observations last."""
    names: list[str] = []
    group.visititems(
        lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None
    )
    return sorted(names, key=lambda name: (name.startswith("observations"), name))
