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
from dataclasses import asdict
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

import knotgym
from knotgym.common import Ids, InvalidFile, InvalidInput, Table, Threads, atomic_write, require_own
from knotgym.datasets import EpisodeDataset, gauss_codes

if TYPE_CHECKING:
    from knotgym.envs import CanonicalFrames, Observer
    from knotgym.topology import GaussCode

_AT_ONCE = 256  # pictures drawn between two writes
_BLOCK = 1024  # states gathered at once, about what a processor's cache holds


class DrawnFrames:
    """The frames of one dataset as one kind of observation."""

    def __init__(
        self,
        dataset: EpisodeDataset,
        observation: str,
        picture: Any,
        cache: Any,
        canonical: bool = False,
    ) -> None:
        """Open the frames; with a cache, draw all pictures that its folder doesn't have yet.

        Args:
            dataset: columns.
            observation: "pixels", "state", "both", "symbolic" or "marked".
            canonical: whether vertices are seen in the ropes' own frames.
            picture: a `PictureConfig`; None for that of the environment.
            cache: folder for pictures; None to draw them when they are asked for.

        Raises:
            InvalidInput: the observation has no pictures to cache.
            InvalidFile: the folder can't be written, or is somebody else's.
        """
        self._dataset, self.observation, self._picture = dataset, observation, picture
        self._canonical = canonical
        self._rows = dataset.episodes.steps.rows
        self._count = self._rows + dataset.episodes.episodes.rows
        self._file = None
        if cache is not None:
            if observation not in ("pixels", "both"):
                raise InvalidInput(
                    f"a cache keeps pictures, and observation {observation!r} has none: leave out"
                    ' cache, or use observation="pixels"'
                )
            self._file = self._cached(Path(cache))

    @property
    def _names(self) -> tuple[str, ...]:
        """The parts of an observation: pixels and state for "both"."""
        return ("pixels", "state") if self.observation == "both" else (self.observation,)

    def goals(self, episodes: Ids) -> Ids:
        """Return the frames of episodes' own goals."""
        return self._rows + episodes

    def observe(self, shown: list[Ids], goals: Ids) -> list[Any]:
        """Join frames of ropes and goals into observations.

        Args:
            shown: frames of ropes, each (n,) or (n, k).
            goals: (n,), the frames of their goals.

        Returns:
            For each of `shown` an array (n, ...) or (n, k, ...), or a dict of them for "both".
        """
        every = [(ids.ravel(), np.repeat(goals, ids.size // max(1, len(goals)))) for ids in shown]
        found: dict[str, list[NDArray[Any]]] = {}
        for name in self._names:
            if name != "pixels":
                alone = self._canonical_states if self._canonical else partial(self._beside, name)
                seen = self._marked if name == "marked" else alone
                found[name] = [seen(*pair) for pair in every]
                continue
            halves = self._halves(name, [ids for pair in every for ids in pair])
            # along which the goal follows the rope
            axis = 2 if self._dataset.task.layout == "beside" else 3
            pairs = zip(halves[::2], halves[1::2], strict=True)
            found[name] = [np.concatenate(pair, axis=axis) for pair in pairs]
        return self._shaped(found, shown)

    def alone(self, shown: list[Ids]) -> list[Any]:
        """Return frames as they are, the halves of observations; for arguments see `observe`.

        Raises:
            InvalidInput: the frame of the observations depends on rope and goal.
        """
        if self.observation == "marked" or self._canonical:
            raise InvalidInput(
                "a marked observation has no halves, nor has one in the canonical frame, which"
                " depends on rope and goal; choose another observation or frame, or leave out apart"
                " and negatives"
            )
        found = {name: self._halves(name, [ids.ravel() for ids in shown]) for name in self._names}
        return self._shaped(found, shown)

    def _shaped(self, found: dict[str, list[NDArray[Any]]], shown: list[Ids]) -> list[Any]:
        each = [
            {n: own[k].reshape(*ids.shape, *own[k].shape[1:]) for n, own in found.items()}
            for k, ids in enumerate(shown)
        ]
        return each if self.observation == "both" else [one[self.observation] for one in each]

    def _halves(self, name: str, shown: list[Ids]) -> list[NDArray[Any]]:
        if name != "pixels":
            return [self._vertices(ids) if name == "state" else self._symbols(ids) for ids in shown]
        if self._file is not None:
            return [self._kept(self._file, ids) for ids in shown]
        # what several of them show is drawn once
        drawn, index = np.unique(np.concatenate(shown), return_inverse=True)
        pictures = self._drawn(drawn)
        ends = np.cumsum([len(ids) for ids in shown])[:-1]
        return [pictures[part] for part in np.split(index, ends)]

    def _beside(self, name: str, ropes: Ids, goals: Ids) -> NDArray[Any]:
        """Gather ropes and goals into one array, block by block: no half is held twice.

        On every core, because of memory that nobody has touched yet: to get it from the system
        takes longer than to fill it.
        """
        read = self._vertices if name == "state" else self._symbols
        none: NDArray[Any] = read(ropes[:0])
        width = none.shape[1]
        joined = np.empty((len(ropes), 2 * width, *none.shape[2:]), none.dtype)

        def _part(rows: slice) -> None:
            joined[rows, :width], joined[rows, width:] = read(ropes[rows]), read(goals[rows])

        Threads(0).spread(_part, len(ropes), most=_BLOCK)
        return joined

    def _column(self, ids: Ids, of_state: str, of_goal: str) -> NDArray[Any]:
        """Gather rows of a column of steps, and of one of episodes for goals."""
        own, steps = self._dataset.episodes
        goals = ids >= self._rows
        if not goals.any():
            return steps[of_state][ids]
        if goals.all():
            return own[of_goal][ids - self._rows]
        found = steps[of_state][np.where(goals, 0, ids)]
        found[goals] = own[of_goal][ids[goals] - self._rows]
        return found

    def _vertices(self, ids: Ids) -> NDArray[np.float32]:
        beads = self._dataset.task.beads
        return self._column(ids, "observation", "goal_points").reshape(len(ids), 3 * beads)

    def _codes(self, ids: Ids) -> NDArray[np.int16]:
        return self._column(ids, "visits", "goal_visits")

    def _symbols(self, ids: Ids) -> NDArray[np.int16]:
        from knotgym.envs import Observer

        return Observer.symbols(self._codes(ids))[:, None]

    def points(self, ids: Ids) -> NDArray[np.float64]:
        """Return the vertices of frames, float64 (n, beads, 3), metres."""
        return self._column(ids, "observation", "goal_points").astype(np.float64)

    def _goal_codes(self, goals: Ids) -> list[GaussCode]:
        from knotgym.topology import GaussCode

        return [GaussCode.parse(text) for text in gauss_codes(self._codes(goals)).tolist()]

    def _marked(self, ropes: Ids, goals: Ids) -> NDArray[np.float32]:
        from knotgym.envs import Marked

        return Marked.of(self.points(ropes), self._goal_codes(goals)).joined()

    def frames_of(self, ropes: Ids, goals: Ids, canonical: bool) -> CanonicalFrames:
        """Return the frames of ropes (n,) with goals (n,): canonical, or centred alone."""
        from knotgym.envs import CanonicalFrames, Marked

        if canonical:
            return Marked.of(self.points(ropes), self._goal_codes(goals)).frames
        axes = np.broadcast_to(np.eye(3), (len(ropes), 3, 3))
        centres = self.points(ropes).mean(axis=1)
        return CanonicalFrames(axes, centres, np.zeros(len(ropes), dtype=bool))

    def _canonical_states(self, ropes: Ids, goals: Ids) -> NDArray[np.float32]:
        frames = self.frames_of(ropes, goals, True)
        return frames.states(self.points(ropes), self.points(goals))

    def _drawn(self, ids: Ids) -> NDArray[np.uint8]:
        points = self.points(ids)
        of = self._dataset.episodes.offsets
        episodes = np.searchsorted(of, np.minimum(ids, self._rows - 1), side="right") - 1
        episodes = np.where(ids >= self._rows, ids - self._rows, episodes)
        return self._observer.draw_ropes(points, [self._looks[k] for k in episodes])

    @cached_property
    def _looks(self) -> list[Any]:
        own = self._dataset.episodes.episodes
        return self._observer.appearances(
            zip(own["goal"].tolist(), own["goal_points"], strict=True)
        )

    @cached_property
    def _observer(self) -> Observer:
        # imported here, so that loading vertices doesn't need OpenCV
        from knotgym.envs import Observer

        return Observer(self._dataset.task, self._picture)

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
        path, frame = folder / f"{self._key()}.npy", self._drawn(np.zeros(1, np.int64))[0]
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
                        for row, picture in zip(block, self._drawn(block), strict=True):
                            file[row] = picture, zlib.crc32(picture)
                    file.flush()
            found = open_memmap(path, "r")
        if found.shape != (self._count,) or found.dtype != kind:
            raise InvalidFile(f"{path} holds other pictures than its name says: delete it")
        return np.asarray(found)  # a plain array slices faster than np.memmap

    def _key(self) -> str:
        """Digest everything that decides the pictures."""
        import cv2

        episodes, steps = self._dataset.episodes
        decides = {
            # from equal pulls, the two engines' states differ
            "states": Table.digest(steps.only("observation")),
            "goals": Table.digest(episodes.only("goal_points", "length")),
            "picture": asdict(self._observer.picture),
            "looks": [look and asdict(look) for look in self._looks],
            "versions": {"knotgym": knotgym.__version__, "opencv": cv2.__version__},
        }
        # repr stands in for values that JSON can't hold, such as the rope model of a picture
        text = json.dumps(decides, sort_keys=True, default=repr)
        return hashlib.sha256(text.encode()).hexdigest()[:32]
