"""Frames of a dataset, from which observations are put together: the halves for rope and goal.

Frames have numbers. Those below R, the rows of steps of the dataset, are the states in these rows;
R + k is the goal of episode k. An observation joins the frame of a state and the frame of a goal,
so that a state that ends one transition and begins the next is stored once.

Vertices and codes are columns of the dataset. Pictures are drawn when they are asked for, or once
into a file of NumPy's format, which is mapped into memory:

    {folder}/{key}.npy      structures (R + episodes,): picture, uint8 (views * size, size, 3 or 4),
                            and crc, uint32, its CRC-32, which is compared at the first reading

The key is a digest of everything that decides the pictures. You may delete the files.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

import knotgym
from knotgym.common import (
    Ids,
    InvalidFile,
    InvalidInput,
    Table,
    Threads,
    atomic_write,
    code_sha256,
    require_own,
)
from knotgym.datasets import EpisodeDataset
from knotgym.envs import OBSERVATIONS, CanonicalFrames, Observer, TaskConfig

_DRAWING = "rendering", "photos", "envs"  # rooms whose code decides how a picture looks
_AT_ONCE = 256  # pictures drawn between two writes
_BLOCK = 1024  # states gathered at once, about what a processor's cache holds


class DrawnFrames:
    """The frames of one dataset as one kind of observation."""

    def __init__(self, dataset: EpisodeDataset, task: TaskConfig, picture: Any, cache: Any) -> None:
        """Open the frames; with a cache, draw all pictures that its folder doesn't have yet.

        Args:
            dataset: columns.
            task: that of the dataset, with the observation and the frame that are wanted.
            picture: a `PictureConfig`; None for that of the environment.
            cache: folder for pictures; None to draw them when they are asked for.

        Raises:
            InvalidInput: the observation has no pictures to cache.
            InvalidFile: the folder can't be written, or is somebody else's.
        """
        self._dataset, self.task, self._kind = dataset, task, OBSERVATIONS[task.observation]
        self._observer = Observer(dataset.task, picture)
        self._rows = dataset.episodes.steps.rows
        self._count = self._rows + len(dataset)
        self._frames = replace(dataset.frames(self._observer), threads=Threads(0), block=_BLOCK)
        if cache is not None:
            if "picture" not in self._kind.goal:
                raise InvalidInput(
                    f"a cache keeps pictures, and observation {task.observation!r} has none: leave"
                    ' out cache, or use observation="pixels"'
                )
            file = self._cached(Path(cache))
            self._frames = replace(self._frames, pictures=partial(self._kept, file))

    def goals(self, episodes: Ids) -> Ids:
        """Return the frames of episodes' own goals."""
        return self._rows + episodes

    def observe(self, shown: list[Ids], goals: Ids) -> list[Any]:
        """Join frames of ropes and goals into observations.

        Args:
            shown: frames of ropes, each (n,) or (n, k).
            goals: (n,), the frames of their goals.

        Returns:
            For each of `shown` an array (n, ...) or (n, k, ...), or a dict of several.
        """
        each = [np.repeat(goals, ids.size // max(1, len(goals))) for ids in shown]
        ropes = np.concatenate([ids.ravel() for ids in shown])
        seen = self._kind.observe(self.task, self._frames, ropes, np.concatenate(each))
        return _shaped(seen, shown)

    def alone(self, shown: list[Ids]) -> list[Any]:
        """Return frames as they are, the halves of observations; for arguments see `observe`.

        Raises:
            InvalidInput: the observations depend on rope and goal.
        """
        if not self._kind.has_halves(self.task):
            raise InvalidInput(
                "a marked observation has no halves, nor has one in the canonical frame, which"
                " depends on rope and goal; choose another observation or frame, or leave out apart"
                " and negatives"
            )
        ids = np.concatenate([ids.ravel() for ids in shown])
        return _shaped(self._kind.halves(self._frames, ids), shown)

    def points(self, ids: Ids) -> NDArray[np.float64]:
        """Return the vertices of frames, float64 (n, beads, 3), metres."""
        return self._frames.points(ids).astype(np.float64)

    def frames_of(self, ropes: Ids, goals: Ids) -> CanonicalFrames:
        """Return the frames of ropes (n,) with goals (n,): canonical, or centred alone."""
        if self.task.is_canonical:
            return self._frames.marked(ropes, goals).frames
        return CanonicalFrames.centred(self.points(ropes))

    def _kept(self, file: NDArray[np.void], ids: Ids) -> NDArray[np.uint8]:
        """Read pictures from the cache.

        Raises:
            InvalidFile: one isn't what was written.
        """
        for row in np.unique(ids[self._unread[ids]]):
            if zlib.crc32(file["picture"][row]) != file["crc"][row]:
                raise InvalidFile(f"picture {row} of {self._path} is damaged: delete the file")
            self._unread[row] = False
        return np.asarray(file["picture"][ids])

    def _cached(self, folder: Path) -> NDArray[np.void]:
        """Map the file of pictures, which is written first if need be, 1 ms a picture."""
        drawn = self._frames.pictures
        path, frame = folder / f"{self._key()}.npy", drawn(np.zeros(1, np.int64))[0]
        kind = np.dtype([("picture", np.uint8, frame.shape), ("crc", np.uint32)])
        self._path, self._unread = path, np.ones(self._count, dtype=np.bool_)
        require_own(folder, InvalidFile)
        require_own(path, InvalidFile)
        said = f"pictures can't be kept at {path}; delete it"
        with InvalidFile.instead(said, OSError, ValueError):
            if not path.is_file():
                folder.mkdir(parents=True, exist_ok=True)
                with atomic_write(path) as part:
                    file = open_memmap(part, "w+", kind, (self._count,))
                    for first in range(0, len(file), _AT_ONCE):
                        block = np.arange(first, min(first + _AT_ONCE, len(file)))
                        for row, picture in zip(block, drawn(block), strict=True):
                            file[row] = picture, zlib.crc32(picture)
                    file.flush()
            pictures = open_memmap(path, "r")
        if pictures.shape != (self._count,) or pictures.dtype != kind:
            raise InvalidFile(f"{path} holds other pictures than its name says: delete it")
        return np.asarray(pictures)  # a plain array slices faster than np.memmap

    def _key(self) -> str:
        """Digest everything that decides the pictures."""
        import cv2

        episodes, steps = self._dataset.episodes
        goals = zip(episodes["goal"].tolist(), episodes["goal_points"], strict=True)
        decides = {
            # from equal pulls, the two engines' states differ
            "states": Table.digest(steps.only("observation")),
            "goals": Table.digest(episodes.only("goal_points", "length")),
            "picture": asdict(self._observer.picture),
            "looks": [look and asdict(look) for look in self._observer.appearances(goals)],
            "code": [code_sha256(Path(knotgym.__file__).parent / room) for room in _DRAWING],
            "opencv": cv2.__version__,
        }
        # repr stands in for values that JSON can't hold, such as the rope model of a picture
        text = json.dumps(decides, sort_keys=True, default=repr)
        return hashlib.sha256(text.encode()).hexdigest()[:32]


def _shaped(seen: Any, shown: list[Ids]) -> list[Any]:
    """Divide observations into those of each of `shown`."""
    ends = np.cumsum([ids.size for ids in shown]).tolist()

    def _part(whole: NDArray[Any], end: int, ids: Ids) -> NDArray[Any]:
        return whole[end - ids.size : end].reshape(*ids.shape, *whole.shape[1:])

    pairs = zip(ends, shown, strict=True)
    return [Observer.map_parts(seen, partial(_part, end=end, ids=ids)) for end, ids in pairs]
