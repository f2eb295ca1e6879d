"""Pictures of a dataset, uncompressed on the disk and mapped into memory, each of them once.

    {folder}/{key}/frames.bin   uint8 (frames, views * size, size, 3 or 4): the picture of the rope
                                in every state of every episode, then the goals, each once
    {folder}/{key}/goals.npy    int64 (episodes,): which frame is an episode's goal
    {folder}/{key}/made.json    that shape, the checksum of the goals, and what the key is the
                                checksum of

A state is seen by the transition that leads to it and by the one that leads on, its goal by a whole
episode, and compressed they would be unpacked each time. The key tells the dataset's checksum, how
its pictures are drawn and by which versions, so what is there is never another dataset's; it is
written under another name first. The system keeps in memory what is read of it, as much as there is
room for.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.atomic_files import (
    Occupied,
    Unwritable,
    atomic_write,
    require_own,
    require_own_tree,
    sha256,
)
from knotgym.configuration import read_json
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.errors import KnotgymError
from knotgym.hdf5_files import require_regular

_KEPT_FREE = 0.05  # share of a disk that is left alone
_NAMES = {"frames.bin", "goals.npy", "made.json"}


class NoCache(KnotgymError, ValueError):
    """A cache that can't be had: nothing to keep in it, or no room for it."""


@dataclass(frozen=True)
class FrameCache:
    """A folder for uncompressed pictures of datasets.

    Attributes:
        folder: made if it isn't there; anything in it may be deleted at any time that nobody reads.
        limit: bytes that it may take; pictures that were used longest ago make room for others.
    """

    folder: str | os.PathLike[str]
    limit: float = 20e9

    def __post_init__(self) -> None:
        if not self.limit > 0:
            raise NoCache(f"a cache's limit must be a number of bytes above 0, got {self.limit!r}")


class CachedFrames:
    """The pictures of a dataset; pickles, and every process maps them for itself.

    Attributes:
        place: the folder they are in.
        offsets: int64 (episodes + 1,), the first frame of each episode.
    """

    def __init__(self, reader: EpisodeReader, picture: Any, cache: FrameCache) -> None:
        """Find them, or make them: about a millisecond a picture.

        Args:
            reader: of the dataset.
            picture: a `PictureConfig` to draw with; None for the environment's pictures.
            cache: where.

        Raises:
            NoCache: there is no room.
            Unwritable: nothing can be written there.
        """
        self.offsets: NDArray[np.int64] = np.cumsum([0, *(reader.lengths + 1)])
        self._layout = reader.task.layout
        require_own(Path(cache.folder), NoCache)
        told = _key(reader, picture)
        key = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:32]
        self.place = Path(cache.folder) / key
        require_own(self.place, NoCache)
        if not self._is_whole():
            try:
                self._make(reader, picture, cache, told)
            except OSError as error:
                raise Unwritable(
                    f"pictures can't be kept at {self.place}: {error.strerror}"
                ) from error
        if os.access(self.place, os.W_OK):
            os.utime(self.place)  # used now

    def __getstate__(self) -> dict[str, Any]:
        mapped = ("frames", "goals")
        return {name: value for name, value in self.__dict__.items() if name not in mapped}

    @cached_property
    def frames(self) -> NDArray[np.uint8]:
        """uint8 (frames, views * size, size, 3 or 4), read-only."""
        try:
            shape = _shape(self.place)
            mapped = np.memmap(self.place / "frames.bin", np.uint8, "r", shape=shape)
        except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
            raise self._spoilt() from error
        return mapped.view(np.ndarray)

    @cached_property
    def goals(self) -> NDArray[np.int64]:
        """int64 (episodes,), the frame that is the goal of each episode."""
        try:
            return _goals(self.place, len(self.offsets) - 1)
        except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
            raise self._spoilt() from error

    def goal(self, episode: NDArray[np.int64], goal_step: NDArray[np.int64]) -> NDArray[np.int64]:
        """The frames of goals: states of the episodes, or their own goals where `goal_step` < 0."""
        return np.where(goal_step < 0, self.goals[episode], self.offsets[episode] + goal_step)

    def pictures(self, ropes: NDArray[np.int64], goals: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Observations put together of the frames of n ropes and of their goals.

        Returns:
            uint8 (n, views * size, 2 size, 3 or 4), or as the task's layout has it.
        """
        height, width, channels = self.frames.shape[1:]
        axis = goal_axis(self._layout)
        size = self.frames.shape[axis]
        shape = [len(ropes), height, width, channels]
        shape[axis] *= 2
        seen = np.empty(shape, np.uint8)
        rope, goal = np.split(seen, [size], axis=axis)
        for row, (own, other) in enumerate(zip(ropes.tolist(), goals.tolist(), strict=True)):
            rope[row], goal[row] = self.frames[own], self.frames[other]
        return seen

    def _spoilt(self) -> NoCache:
        return NoCache(f"the pictures at {self.place} are gone or spoilt: open the dataset anew")

    def _is_whole(self) -> bool:
        if not _is_ours(self.place):
            return False
        try:
            _goals(self.place, len(self.offsets) - 1)
            frames = self.place / "frames.bin"
            return frames.stat().st_size == math.prod(_shape(self.place))
        except (OSError, ValueError, KeyError, TypeError, OverflowError):
            return False

    def _make(
        self, reader: EpisodeReader, picture: Any, cache: FrameCache, told: dict[str, Any]
    ) -> None:
        if not len(reader):
            raise NoCache(f"{reader.path} has no episodes, so there are no pictures to keep")
        axis = goal_axis(self._layout)
        first = reader.observations(0, slice(0, 1), observation="pixels", picture=picture)
        half = np.split(first, 2, axis=axis)[0].shape[1:]
        one, states = math.prod(half), int(self.offsets[-1])
        self.place.parent.mkdir(parents=True, exist_ok=True)
        _make_room(cache, one * states)
        goals = np.empty(len(reader), np.int64)
        distinct: dict[bytes, int] = {}
        with atomic_write(self.place) as folder:
            folder.mkdir()
            with open(folder / "frames.bin", "wb") as file:
                for index in range(len(reader)):
                    seen = reader.observations(index, observation="pixels", picture=picture)
                    ropes, aims = np.split(seen, 2, axis=axis)
                    file.write(np.ascontiguousarray(ropes).data)
                    goals[index] = distinct.setdefault(aims[0].tobytes(), states + len(distinct))
                for goal in distinct:
                    file.write(goal)
            np.save(folder / "goals.npy", goals)
            goals_sum = sha256(folder / "goals.npy")
            made = {**told, "shape": [states + len(distinct), *half], "goals_sha256": goals_sum}
            (folder / "made.json").write_text(json.dumps(made, indent=1), encoding="utf-8")


def goal_axis(layout: str) -> int:
    """The axis of n observations of pictures along which the goal comes after the rope."""
    return 2 if layout == "beside" else 3


def _shape(place: Path) -> tuple[int, ...]:
    made = read_json(place / "made.json")
    shape = tuple(made["shape"])
    if len(shape) != 4 or not all(type(size) is int and size > 0 for size in shape):
        raise NoCache(f"{place} says that its pictures are of shape {shape}")
    return shape


def _goals(place: Path, episodes: int) -> NDArray[np.int64]:
    """Which frame is the goal of each episode; none that there isn't, nor more than are stored."""
    require_regular(place / "goals.npy", "goals", NoCache)
    if read_json(place / "made.json")["goals_sha256"] != sha256(place / "goals.npy"):
        raise NoCache(f"{place} has other goals than were written there")
    found = np.array(np.load(place / "goals.npy", mmap_mode="r", allow_pickle=False))
    if found.dtype != np.int64 or found.shape != (episodes,):
        raise NoCache(f"{place} has goals {found.dtype} {found.shape}, should be ({episodes},)")
    if not ((found >= 0) & (found < _shape(place)[0])).all():
        raise NoCache(f"{place} names a goal that it has no picture of")
    return found


def _key(reader: EpisodeReader, picture: Any) -> dict[str, Any]:
    """All that decides the pictures."""
    import cv2

    from knotgym.rendering.observations import picture_config

    told: dict[str, Any] = {
        "format": "knotgym-frames",
        "format_version": 1,
        "sha256": sha256(reader.path),
        "episodes": hashlib.sha256(np.array(reader.rows, "<i8").tobytes()).hexdigest(),
        "picture": asdict(picture or picture_config(reader.task)),
        "drawn": picture is not None or reader.stored not in ("pixels", "both"),
        "versions": {"knotgym": knotgym.__version__, "opencv": cv2.__version__},
    }
    # what isn't of JSON, such as a rope, by its own representation
    found: dict[str, Any] = json.loads(json.dumps(told, default=repr))
    return found


def _make_room(cache: FrameCache, needed: int) -> None:
    """Delete what was used longest ago until there is room for `needed` bytes.

    Raises:
        NoCache: there never will be.
    """
    folder = Path(cache.folder)
    if needed > cache.limit:
        raise NoCache(
            f"these pictures take {needed / 1e9:.1f} GB, more than the cache may hold,"
            f" {cache.limit / 1e9:.1f} GB: raise its limit, or take smaller pictures"
        )
    # none but our own: a folder is one of the cache's by what is in it
    kept = [place for place in folder.iterdir() if _is_ours(place)]
    sizes = {place: sum(file.stat().st_size for file in place.iterdir()) for place in kept}
    for place in sorted(kept, key=lambda one: one.stat().st_mtime):
        if sum(sizes.values()) + needed <= cache.limit:
            break
        shutil.rmtree(place)
        del sizes[place]
    disk = shutil.disk_usage(folder)
    if needed > disk.free - _KEPT_FREE * disk.total:
        raise NoCache(
            f"these pictures take {needed / 1e9:.1f} GB, and {folder} has {disk.free / 1e9:.1f} GB"
            " left, of which a twentieth of the disk stays free"
        )


def _is_ours(place: Path) -> bool:
    """Whether a folder is one of the cache's: this user's, with its three files and no link."""
    try:
        require_own_tree(place)
    except Occupied:
        return False
    return (
        place.is_dir()
        and {file.name for file in place.iterdir()} == _NAMES
        and all(file.is_file() for file in place.iterdir())
    )
