"""Uncompressed pictures of a dataset, in a memory-mapped file, and its vertices in memory.

    {folder}/{key}.frames       uint8 (frames, views * size, size, 3 or 4), without a header

An episode of T actions has T + 2 consecutive frames: the rope in its T + 1 states, then the goal.
Each observation is put together from the frame of a state and the frame of a goal, so a state that
ends one transition and begins the next is stored once and never decompressed.

The key is a digest of everything that decides the pictures: the dataset's checksum, the picture
settings, and the versions of knotgym and OpenCV. A file is written under a temporary name and
renamed, so a file of the right size is complete.
"""

import hashlib
import json
import math
import os
import stat
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common.atomic_files import atomic_write, require_own, sha256
from knotgym.common.errors import InvalidInput
from knotgym.datasets.episode_reader import EpisodeReader, goal_axis

_MOST_HELD = 1e9  # bytes of vertices that are held in memory


@dataclass(frozen=True)
class FrameCache:
    """A folder for uncompressed pictures of datasets.

    Attributes:
        folder: created if it doesn't exist. Files in it may be deleted whenever nobody reads them.
        limit: size limit of the folder, bytes. The least recently used files are deleted to make
            room for new ones.
    """

    folder: str | os.PathLike[str]
    limit: float = 20e9

    def __post_init__(self) -> None:
        if not self.limit > 0:
            raise InvalidInput(
                f"a cache's limit must be a number of bytes above 0, got {self.limit!r}"
            )


class _Frames:
    """Consecutive frames of states and goals: an episode of T actions has T + 2.

    `offsets`, int64 (episodes + 1,), has the first frame of each episode, then their total.
    """

    offsets: NDArray[np.int64]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "frames"}

    def goal(self, episode: NDArray[np.int64], goal_step: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the frames of goals: a state of the episode, or its own goal for a step < 0."""
        return np.where(
            goal_step < 0, self.offsets[episode + 1] - 1, self.offsets[episode] + goal_step
        )


class HeldVertices(_Frames):
    """The vertices of one dataset in memory, read when first needed.

    Can be pickled: each process reads them itself.
    """

    def __init__(self, reader: EpisodeReader) -> None:
        self._reader, self.offsets = reader, np.cumsum([0, *(reader.lengths + 2)])

    @property
    def fits(self) -> bool:
        """Whether they are small enough to be held."""
        return self._reader.task.rope.beads * 12 * int(self.offsets[-1]) <= _MOST_HELD

    @cached_property
    def frames(self) -> NDArray[np.float32]:
        """float32 (frames, 3 beads), metres."""
        held = np.empty((int(self.offsets[-1]), 3 * self._reader.task.rope.beads), np.float32)
        for index, first in enumerate(self.offsets[:-1].tolist()):
            seen = self._reader.observations(index, observation="state")
            ropes, goals = np.split(seen, 2, axis=1)
            held[first : first + len(ropes)], held[first + len(ropes)] = ropes, goals[0]
        return held

    def joined(self, ropes: NDArray[np.int64], goals: NDArray[np.int64]) -> NDArray[np.float32]:
        """Join n frames of ropes with n of goals into observations, float32 (n, 6 beads)."""
        return np.concatenate([self.frames[ropes], self.frames[goals]], axis=1)


class CachedFrames(_Frames):
    """The pictures of one dataset, at `path`. Can be pickled: each process maps the file itself."""

    def __init__(self, reader: EpisodeReader, picture: Any, cache: FrameCache) -> None:
        """Open the file, or write it first, which takes about a millisecond per picture.

        Raises:
            InvalidInput: the dataset has no episodes, the pictures exceed the limit, or the folder

                the file is a link or belongs to another user.
            InvalidInput: the folder can't be written.
        """
        if not len(reader):
            raise InvalidInput(f"{reader.path} has no episodes, so there are no pictures to keep")
        folder = Path(cache.folder)
        require_own(folder, InvalidInput)
        self.path = folder / f"{_key(reader, picture)}.frames"
        self.offsets = np.cumsum([0, *(reader.lengths + 2)])
        self._goal_axis = goal_axis(reader.task.layout)
        first = reader.observations(0, slice(0, 1), observation="pixels", picture=picture)
        frame = np.split(first, 2, axis=self._goal_axis)[0].shape[1:]
        self._shape = (int(self.offsets[-1]), *frame)
        require_own(self.path, InvalidInput)
        try:
            if not self.path.is_file() or self.path.stat().st_size != math.prod(self._shape):
                folder.mkdir(parents=True, exist_ok=True)
                _make_room(cache, math.prod(self._shape))
                self._write(reader, picture)
        except OSError as error:
            raise InvalidInput(f"can't write pictures to {self.path}: {error.strerror}") from error
        if os.access(self.path, os.W_OK):
            os.utime(self.path)  # _make_room deletes the oldest files first

    @cached_property
    def frames(self) -> NDArray[np.uint8]:
        """uint8 (frames, views * size, size, 3 or 4), read-only."""
        require_own(self.path, InvalidInput)
        try:
            mapped = np.memmap(self.path, np.uint8, "r", shape=self._shape)
        except (OSError, ValueError) as error:
            raise InvalidInput(
                f"{self.path} is missing or truncated: open the dataset again"
            ) from error
        return mapped.view(np.ndarray)

    def joined(self, ropes: NDArray[np.int64], goals: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Join n frames of ropes with n frames of goals into observations.

        uint8 (n, views * size, 2 size, 3 or 4), or (n, views * size, size, 6 or 8) in layout
        "stacked".
        """
        shape = [len(ropes), *self._shape[1:]]
        shape[self._goal_axis] *= 2
        seen = np.empty(shape, np.uint8)
        rope, goal = np.split(seen, 2, axis=self._goal_axis)  # views, filled row by row
        for row, (own, other) in enumerate(zip(ropes.tolist(), goals.tolist(), strict=True)):
            rope[row], goal[row] = self.frames[own], self.frames[other]
        return seen

    def _write(self, reader: EpisodeReader, picture: Any) -> None:
        with atomic_write(self.path) as temporary, temporary.open("wb") as file:
            for index in range(len(reader)):
                seen = reader.observations(index, observation="pixels", picture=picture)
                ropes, goals = np.split(seen, 2, axis=self._goal_axis)
                file.write(np.ascontiguousarray(ropes).data)
                file.write(np.ascontiguousarray(goals[0]).data)


def _key(reader: EpisodeReader, picture: Any) -> str:
    """Digest everything that decides the pictures."""
    import cv2

    from knotgym.envs.observations import picture_config

    decides = {
        "format": "knotgym-frames",
        "format_version": 1,
        "sha256": sha256(reader.path),
        "episodes": hashlib.sha256(np.array(reader.rows, "<i8").tobytes()).hexdigest(),
        "picture": asdict(picture or picture_config(reader.task)),
        "drawn": picture is not None or reader.stored not in ("pixels", "both"),
        "versions": {"knotgym": knotgym.__version__, "opencv": cv2.__version__},
    }
    # repr stands in for values that JSON can't hold, such as the rope model of a picture
    text = json.dumps(decides, sort_keys=True, default=repr)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _make_room(cache: FrameCache, needed: int) -> None:
    """Delete the least recently used files until `needed` bytes fit under the limit, or raise
    InvalidInput.
    """
    if needed > cache.limit:
        raise InvalidInput(
            f"these pictures take {needed / 1e9:.1f} GB, more than the cache's limit of"
            f" {cache.limit / 1e9:.1f} GB: raise the limit, or use smaller pictures"
        )
    mine: dict[Path, os.stat_result] = {}
    for path in Path(cache.folder).glob("[0-9a-f]" * 32 + ".frames"):
        found = path.lstat()
        if stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid():
            mine[path] = found
    total = sum(found.st_size for found in mine.values())
    for path in sorted(mine, key=lambda one: mine[one].st_mtime):
        if total + needed <= cache.limit:
            break
        path.unlink(missing_ok=True)
        total -= mine[path].st_size
