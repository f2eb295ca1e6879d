"""Read episode files: whole episodes or single frames, from any process.

    /                   attributes: format, format_version, task (JSON), rope, stored, versions
                        (JSON), attributes_sha256, metadata (JSON, in datasets);
                        index, int32 (n, 2): k and T of each episode, in order of k
    /episode_{k}        attributes: id, number, total_steps, policy, goal_gauss_code, relabelled,
                        hold, digest, seed, options/start, options/goal; start_qpos, goal_points
        actions rewards terminations truncations infos/*            read by Minari
        observations    pixels, state, a group of both, symbols,    read by Minari; can be rendered
                        or missing                                  from `infos/points`, same bytes

Everything else can be recomputed from `start_qpos`, `goal_points` and `infos/points`, all float64.

`stored` is "pixels", "state", "both", "symbolic", "marked" or, in the compact form, "none".
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from knotgym.common.errors import InvalidFile, MissingFile
from knotgym.common.hdf5_files import (
    Column,
    check_format,
    foreign_bytes_as,
    member,
    read_attribute,
    read_column,
    stored_column,
)
from knotgym.datasets.trajectory import ARRAYS, INFOS, OPTIONAL, Episode
from knotgym.envs.tasks import OBSERVATIONS, TaskConfig
from knotgym.states.state_file import leads_out, minari_root, ships, states_file

FORMAT = "knotgym-episodes"
FORMAT_VERSION = 1
STORED = (*OBSERVATIONS, "none")
ATTRIBUTES_DIGEST = "attributes_sha256"  # an attribute itself, see `attributes_digest`
_DIGESTED = ("task", "rope", "stored", "versions", "metadata")

ONCE = ("start_qpos", "goal_points")  # one array per episode, stored as attributes
POINTS = "infos/points"
GOAL_INFO = "infos/goal_gauss_code"  # the goal's code, repeated at every state
Count = Callable[[str, int, int], None]  # progress callback (stage, done, total)
_STEPS = ("actions", "rewards", "terminations", "truncations")
_ATTRIBUTE_KINDS = {
    **dict.fromkeys(("id", "number", "total_steps", "seed", "hold"), "integer"),
    **dict.fromkeys(("goal_gauss_code", "policy", "digest"), "text"),
    "relabelled": "bool",
}
_OBSERVED = {
    "pixels": Column("pixels", "uint8", ("states", None, None, None)),
    "state": Column("state", "float32", ("states", None), finite=True),
    "symbolic": Column("symbolic", "int16", ("states", 2, None)),
    "marked": Column("marked", "float32", ("states", None), finite=True),
}


def uncounted(what: str, done: int, total: int) -> None:
    """Ignore progress."""


class Chosen(NamedTuple):
    """A subset of a dataset: the k of its groups `episode_{k}`, in order."""

    source: Any
    episode_indices: list[int]


class EpisodeReader:
    """Reader of an episode file or a dataset, for whole episodes or single frames.

    Each process opens the file once; pickling a reader leaves the open file out.

    Attributes:
        path: of the HDF5 file.
        task: the environment; its `observation` is what `observations` returns by default.
        stored: kind of the observations in the file.
        rope: fingerprint of the rope model.
        versions: package -> version that wrote the file.
        rows: the k of each group `episode_{k}` that is read, in order.
        lengths: int64 (len(rows),), T of each.
    """

    def __init__(self, source: Any) -> None:
        """Open a file, a dataset's folder or id, a `Chosen`, or a `minari.MinariDataset`.

        A `Chosen` or a `MinariDataset` restricts the reader to its episodes.

        Raises:
            InvalidFile: the file is truncated, wasn't written by knotgym, or has an unknown
                format version.
            MissingFile: there is no such file.
        """
        self.path = episode_file(source)
        self._opened: tuple[int, h5py.File] | None = None
        with foreign_bytes_as(InvalidFile, f"{self.path} isn't a whole episode file"):
            check_format(self.file, format=FORMAT, versions=(FORMAT_VERSION,), error=InvalidFile)
            texts = {
                name: str(read_attribute(self.file, Column(name, "text", ())))
                for name in ("task", "stored", "rope", "versions")
            }
            self.task = TaskConfig(**json.loads(texts["task"]))
            self._beads = self.task.rope.beads
            self.stored, self.rope = texts["stored"], texts["rope"]
            if self.stored not in STORED:
                raise InvalidFile(f"stored is {self.stored!r}, not {', '.join(STORED)}")
            self.versions: dict[str, str] = _versions(texts["versions"])
            index = stored_index(self.file)
        chosen = getattr(source, "episode_indices", index)
        self.rows: list[int] = [int(row) for row in chosen]
        lengths = [index[row] for row in self.rows]
        self.lengths: NDArray[np.int64] = np.array(lengths, dtype=np.int64)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.rows)

    def has(self, name: str) -> bool:
        """Return whether every episode stores an array that episodes may lack."""
        return all(dataset_path(name) in self.group(index) for index in range(len(self)))

    def __iter__(self) -> Iterator[Episode]:
        return (self.episode(index) for index in range(len(self)))

    @property
    def file(self) -> h5py.File:
        """The file, opened by this process."""
        if self._opened is None or self._opened[0] != os.getpid():
            self._opened = os.getpid(), h5py.File(self.path, "r")
        return self._opened[1]

    def close(self) -> None:
        """Close the file; the next read reopens it."""
        if self._opened is not None and self._opened[0] == os.getpid():
            self._opened[1].close()
        self._opened = None

    def group(self, index: int) -> h5py.Group:
        """The HDF5 group of an episode."""
        with self._naming(index):
            return _group(self.file, self.rows[index])

    def column(self, index: int, name: str) -> NDArray[Any]:
        """Read one array of an episode, named as in `Episode`."""
        with self._naming(index):
            return self._array(index, name)

    def attributes(self, index: int) -> dict[str, Any]:
        """Read the scalar and text attributes of an episode; check their types."""
        with self._naming(index):
            group = self.group(index)
            return {
                name: read_attribute(group, Column(name, _attribute_kind(name), ()))
                for name in group.attrs
                if name not in ONCE
            }

    def metadata(self) -> dict[str, Any] | None:
        """Read the metadata of the dataset that the file belongs to or came from, if any."""
        with foreign_bytes_as(InvalidFile, f"{self.path} isn't a whole episode file"):
            if "metadata" not in self.file.attrs:
                return None
            entries = json.loads(read_attribute(self.file, Column("metadata", "text", ())))
            if not isinstance(entries, dict):
                found = type(entries).__name__
                raise InvalidFile(f"metadata is {found}, should be an object")
            return entries

    def states_path(self) -> Path:
        """Return the path of the state file that the episodes were reset from; it may not exist.

        A dataset that names a path outside it raises InvalidFile; a single file may do so.
        """
        beside, named = self.path.with_name("states.h5"), self.task.states
        if ships(named) or named is None:
            return states_file(named)
        if beside.is_file():
            return beside
        if self.path.with_name("metadata.json").is_file() and leads_out(named):
            raise InvalidFile(
                f"{self.path} names states that lie outside the dataset, {named!r}; it should"
                " include them, as states.h5 beside the episodes"
            )
        return states_file(named)

    def goal_codes(self, index: int) -> list[str]:
        """Read `infos/goal_gauss_code`: the goal's code, once per state."""
        with self._naming(index):
            wanted = Column(GOAL_INFO, "text", ("states",))
            codes: list[str] = read_column(self.group(index), wanted, self._sizes(index)).tolist()
            return codes

    def episode(self, index: int) -> Episode:
        """Read a whole episode, without its observations.

        What is missing, unreadable or of the wrong shape is named by InvalidFile.
        """
        with self._naming(index):
            group = self.group(index)
            arrays = {
                name: self._array(index, name)
                for name in (*ONCE, "points", *_STEPS, *INFOS)
                if name not in OPTIONAL or dataset_path(name) in group
            }
            stored = self.attributes(index)
            return Episode(
                **arrays,
                goal_gauss_code=str(stored["goal_gauss_code"]),
                policy=str(stored["policy"]),
                seed=int(stored["seed"]) if "seed" in stored else None,
                options={
                    name.removeprefix("options/"): int(row)
                    for name, row in stored.items()
                    if name.startswith("options/")
                },
                relabelled=bool(stored["relabelled"]),
                hold=int(stored["hold"]) if "hold" in stored else None,
            )

    def observations(
        self,
        index: int,
        steps: slice | NDArray[np.int64] = slice(None),
        *,
        goal_step: int | None = None,
        goal_episode: int | None = None,
        observation: str = "",
        picture: Any = None,
    ) -> Any:
        """Return the agent's observations at some states of an episode.

        Args:
            index: position of the episode in this reader.
            steps: which of its T + 1 states; an array must be increasing.
            goal_step: state of the episode to show as the goal instead of its own.
            goal_episode: position of the episode that `goal_step` is a state of; None for `index`.
            observation: one of OBSERVATIONS; "" for the task's.
            picture: a `knotgym.rendering.picture.PictureConfig` to render with, instead of using
                the stored pictures.

        Returns:
            uint8 (n, views * size, 2 size, 3 or 4), float32 (n, 6 beads), a dict of both, int16
            (n, 2, SYMBOLS), or float32 (n, marked.size(beads)); rendered from the vertices where
            the file stores no such observations.
        """
        wanted = observation or self.task.observation
        if wanted not in OBSERVATIONS:
            raise InvalidFile(
                f"observation must be one of {', '.join(OBSERVATIONS)}, got {wanted!r}"
            )
        if goal_episode is None:
            goal_episode = index
        part_of_both = self.stored == "both" and wanted in ("pixels", "state")
        with self._naming(index):
            # the frame of a marked observation depends on the goal
            kept = goal_step is None or wanted != "marked"
            if (self.stored == wanted or part_of_both) and picture is None and kept:
                return self._stored(index, steps, goal_step, goal_episode, wanted)
            points = self._stored_points(index)
            seen = _at(points, steps)
            if goal_step is None:
                goal = self._array(index, "goal_points")
            else:
                points = points if goal_episode == index else self._stored_points(goal_episode)
                goal = points[goal_step]
        # imported here, so that loading states doesn't need OpenCV
        from knotgym.envs.observations import observe, picture_config

        picture = picture or picture_config(self.task)
        return observe(seen, goal, wanted, picture, self.task.layout)

    def stored_observations(self, index: int) -> dict[str, h5py.Dataset]:
        """Return the HDF5 datasets of an episode's stored observations, by name: none, 1 or 2."""
        if self.stored == "none":
            return {}
        names = ("pixels", "state") if self.stored == "both" else (self.stored,)
        with self._naming(index):
            group, sizes = self.group(index), self._sizes(index)
            return {
                name: stored_column(
                    group,
                    _OBSERVED[name],
                    sizes,
                    f"observations/{name}" if self.stored == "both" else "observations",
                )
                for name in names
            }

    def _stored(
        self,
        index: int,
        steps: slice | NDArray[np.int64],
        goal_step: int | None,
        goal_episode: int,
        wanted: str,
    ) -> Any:
        data = self.stored_observations(index)
        names = ("pixels", "state") if wanted == "both" else (wanted,)
        seen = {name: _at(data[name], steps) for name in names}
        if goal_step is not None:
            data = data if goal_episode == index else self.stored_observations(goal_episode)
            for name, array in seen.items():
                # the goal's half of a view on the array becomes the rope's half at goal_step
                axis = goal_axis(self.task.layout) if name == "pixels" else 1
                goal = np.split(data[name][goal_step][None], 2, axis)[0]
                np.split(array, 2, axis)[1][:] = goal
        return seen if wanted == "both" else seen[wanted]

    def _naming(self, index: int) -> AbstractContextManager[None]:
        """Prefix errors with the path and the episode."""
        return foreign_bytes_as(InvalidFile, f"{self.path}, episode {self.rows[index]}")

    def _sizes(self, index: int) -> dict[str, int]:
        steps = int(self.lengths[index])
        return {"steps": steps, "states": steps + 1, "beads": self._beads}

    def _stored_points(self, index: int) -> h5py.Dataset:
        return stored_column(self.group(index), ARRAYS["points"], self._sizes(index), POINTS)

    def _array(self, index: int, name: str) -> NDArray[Any]:
        group, wanted, sizes = self.group(index), ARRAYS[name], self._sizes(index)
        if name in ONCE:
            return np.asarray(read_attribute(group, wanted, sizes))
        return read_column(group, wanted, sizes, dataset_path(name))


def goal_axis(layout: str) -> int:
    """The axis of (n, height, width, channels) pictures along which the goal follows the rope."""
    return 2 if layout == "beside" else 3


def episode_file(source: Any) -> Path:
    """Find the HDF5 file of a dataset.

    Args:
        source: a file, a dataset's folder or the `data` folder in it, the folder of a run of
            `generate` (its demonstrations of the train split), a `minari.MinariDataset`, a
            `Chosen`, or an id that Minari would find.

    Raises:
        MissingFile: there is no such file.
        InvalidFile: a run has demonstrations of several crossing numbers.
    """
    if isinstance(source, Chosen):
        return episode_file(source.source)
    if hasattr(source, "storage"):
        return Path(source.storage.data_path) / "main_data.hdf5"
    tried = [Path(source)]
    if not leads_out(source):
        tried.append(minari_root() / str(source))
    for path in tried:
        for inside in (path, path / "main_data.hdf5", path / "data" / "main_data.hdf5"):
            if inside.is_file():
                return inside
        found = sorted((path / "minari").glob("knotgym/*/demonstrations-v0/data/main_data.hdf5"))
        if len(found) > 1:
            listed = ", ".join(str(one.parents[1]) for one in found)
            raise InvalidFile(f"{path} holds several datasets; choose one of them: {listed}")
        if found:
            return found[0]
    raise MissingFile(f"no episodes at {tried[0]}, nor a dataset of this id under {minari_root()}")


def stored_index(file: h5py.File) -> dict[int, int]:
    """Read k and T of each episode from the file's `index` attribute."""
    index = read_attribute(file, Column("index", "integer", (None, 2), least=0))
    return {int(row): int(steps) for row, steps in index}


def counted_index(file: h5py.File) -> dict[int, int]:
    """Read k and T of each episode from the episodes themselves."""
    rows = sorted(int(name.removeprefix("episode_")) for name in file)
    steps = Column("total_steps", "integer", (), least=0)
    return {row: int(read_attribute(_group(file, row), steps)) for row in rows}


def attributes_digest(attributes: Mapping[str, Any]) -> str:
    """Hash a file's attributes: SHA-256, hexadecimal, of a JSON list of names and texts."""
    texts = [[name, str(attributes[name])] for name in _DIGESTED if name in attributes]
    return hashlib.sha256(json.dumps(texts).encode()).hexdigest()


def dataset_path(name: str) -> str:
    """Return the path, in an episode's group, of an array that `Episode` calls `name`."""
    return f"infos/{name}" if name in (*INFOS, "points") else name


def _group(file: h5py.File, row: int) -> h5py.Group:
    found = member(file, f"episode_{row}")
    if not isinstance(found, h5py.Group):
        raise InvalidFile(f"episode_{row} should be a group")
    return found


def _at(data: h5py.Dataset, steps: slice | NDArray[np.int64]) -> NDArray[Any]:
    """Read some states; HDF5 reads a range many times faster than a list."""
    if isinstance(steps, slice):
        return data[steps]
    runs = np.split(steps, np.flatnonzero(np.diff(steps) > 1) + 1)
    return np.concatenate([data[run[0] : run[-1] + 1] for run in runs])


def _attribute_kind(name: str) -> str:
    return "integer" if name.startswith("options/") else _ATTRIBUTE_KINDS.get(name, "any")


def _versions(text: str) -> dict[str, str]:
    found = json.loads(text)
    if not isinstance(found, dict) or not all(isinstance(name, str) for name in found.values()):
        raise InvalidFile(f"versions is {text[:80]!r}, should be names and versions")
    return found
