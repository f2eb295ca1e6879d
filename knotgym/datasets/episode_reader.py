"""Reading episode files: whole episodes or single frames, in any process.

    /                   attributes: format, format_version, task (JSON), rope, stored, versions
                        (JSON), card (JSON, in datasets);
                        index, int32 (n, 2): the k and T of each episode, in order of k (missing in
                               files made before there was one)
    /episode_{k}        attributes: id, number, total_steps, policy, goal_gauss_code, relabelled,
                        hold, digest, seed, options/start, options/goal; start_qpos, goal_points
        actions rewards terminations truncations infos/*            what Minari reads
        observations    pixels and state, one of them, symbols,     what Minari reads; made from
                        or none                                     `infos/points`, the same bytes

Everything else can be made again from `start_qpos`, `goal_points` and `infos/points`, float64.

`stored` is "pixels", "state", "both", "symbolic" or, in the compact form, "none".
"""

from __future__ import annotations

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

from knotgym.common.errors import KnotgymError, MissingFile
from knotgym.common.hdf5_files import (
    Column,
    UnexpectedContent,
    check_format,
    foreign_bytes_as,
    member,
    read_attribute,
    read_column,
    stored_column,
)
from knotgym.datasets.trajectory import INFOS, OPTIONAL, Episode, array_column
from knotgym.envs.tasks import OBSERVATIONS, TaskConfig
from knotgym.states.state_file import leads_out, minari_root, ships, states_file

FORMAT = "knotgym-episodes"
FORMAT_VERSION = 1
STORED = (*OBSERVATIONS, "none")
TOLD_DIGEST = "attributes_sha256"  # an attribute too, see `told_digest`
_TOLD = ("task", "rope", "stored", "versions", "metadata")

ONCE = ("start_qpos", "goal_points")  # arrays of a whole episode: attributes
POINTS = "infos/points"
GOAL_INFO = "infos/goal_gauss_code"  # the goal's label, repeated at every state
Count = Callable[[str, int, int], None]  # told what is looked at, how many were, and of how many
_STEPS = ("actions", "rewards", "terminations", "truncations")
_LABELS = {
    "id": "integer",
    "number": "integer",
    "total_steps": "integer",
    "seed": "integer",
    "hold": "integer",
    "relabelled": "bool",
    "goal_gauss_code": "text",
    "policy": "text",
    "digest": "text",
}
_OBSERVED = {
    "pixels": Column("pixels", "uint8", ("states", None, None, None)),
    "state": Column("state", "float32", ("states", None), finite=True),
    "symbolic": Column("symbolic", "int16", ("states", 2, None)),
}


def uncounted(what: str, done: int, total: int) -> None:
    """A `Count` that nobody reads."""


class InvalidEpisodeFile(KnotgymError, ValueError):
    """A file that isn't an episode file this version can read, or files that don't go together."""


class Chosen(NamedTuple):
    """Some episodes of a dataset: the k of their groups `episode_{k}`, in order."""

    source: Any
    episode_indices: list[int]


class EpisodeReader:
    """Reads an episode file or a dataset, whole episodes or single frames.

    It opens the file once in each process, and pickles without it.

    Attributes:
        path: of the HDF5 file.
        task: the environment; its `observation` is what `observations` returns by default.
        stored: the observations in the file.
        rows: the k of the groups `episode_{k}` read here, in order.
        lengths: int64 (len(rows),), the T of each.
    """

    def __init__(self, source: Any) -> None:
        """Open a file, a dataset's folder or id, a `Chosen`, or a `minari.MinariDataset`.

        Of the last two only the chosen episodes are read.

        Raises:
            InvalidEpisodeFile: not written by knotgym, truncated, or of a format this version
                doesn't know.
            MissingFile: there is none.
        """
        self.path = episode_file(source)
        self._opened: tuple[int, h5py.File] | None = None
        with foreign_bytes_as(InvalidEpisodeFile, f"{self.path} isn't a whole episode file"):
            check_format(
                self.file, format=FORMAT, versions=(FORMAT_VERSION,), error=InvalidEpisodeFile
            )
            said = {
                name: str(read_attribute(self.file, Column(name, "text", ())))
                for name in ("task", "stored", "rope", "versions")
            }
            self.task = TaskConfig(**json.loads(said["task"]))
            self._beads = self.task.rope.beads
            self.stored, self.rope = said["stored"], said["rope"]
            if self.stored not in STORED:
                raise UnexpectedContent(f"stored is {self.stored!r}, not {', '.join(STORED)}")
            self.versions: dict[str, str] = _versions(said["versions"])
            index = stored_index(self.file) or counted_index(self.file)
        chosen = getattr(source, "episode_indices", index)
        self.rows: list[int] = [int(row) for row in chosen]
        lengths = [index[row] for row in self.rows]
        self.lengths: NDArray[np.int64] = np.array(lengths, dtype=np.int64)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}

    def __len__(self) -> int:
        """Episodes."""
        return len(self.rows)

    @property
    def has_labels(self) -> bool:
        """An expert was asked at every state of every episode."""
        for index in range(len(self)):
            with self._naming(index):
                if place("expert_action") not in self.group(index):
                    return False
        return True

    def __iter__(self) -> Iterator[Episode]:
        return (self.episode(index) for index in range(len(self)))

    @property
    def file(self) -> h5py.File:
        """The open file, this process's own."""
        if self._opened is None or self._opened[0] != os.getpid():
            self._opened = os.getpid(), h5py.File(self.path, "r")
        return self._opened[1]

    def close(self) -> None:
        """Close the file; it opens again when needed."""
        if self._opened is not None and self._opened[0] == os.getpid():
            self._opened[1].close()
        self._opened = None

    def group(self, index: int) -> h5py.Group:
        """The HDF5 group of an episode."""
        with self._naming(index):
            return _group(self.file, self.rows[index])

    def column(self, index: int, name: str) -> NDArray[Any]:
        """One array of an episode, by `Episode`'s name for it."""
        with self._naming(index):
            return self._array(index, name)

    def labels(self, index: int) -> dict[str, Any]:
        """The attributes of an episode that are no arrays, by name, checked."""
        with self._naming(index):
            group = self.group(index)
            return {
                name: read_attribute(group, Column(name, _kind_of_label(name), ()))
                for name in group.attrs
                if name not in ONCE
            }

    def metadata(self) -> dict[str, Any] | None:
        """What a file says of the dataset it came from; None if it came from none."""
        with foreign_bytes_as(InvalidEpisodeFile, f"{self.path} isn't a whole episode file"):
            if "metadata" not in self.file.attrs:
                return None
            read = json.loads(read_attribute(self.file, Column("metadata", "text", ())))
            if not isinstance(read, dict):
                raise UnexpectedContent(f"metadata is {type(read).__name__}, should be an object")
            return read

    def states_path(self) -> Path:
        """The state file that its episodes were reset from, which may not be there.

        Raises:
            InvalidEpisodeFile: a dataset names one that lies elsewhere; a file by itself may.
        """
        beside, named = self.path.with_name("states.h5"), self.task.states
        if ships(named) or named is None:
            return states_file(named)
        if beside.is_file():
            return beside
        if self.path.with_name("metadata.json").is_file() and leads_out(named):
            raise InvalidEpisodeFile(
                f"{self.path} names states that lie outside the dataset, {named!r}; it should"
                " carry them, as states.h5 beside it"
            )
        return states_file(named)

    def goal_labels(self, index: int) -> list[str]:
        """The goal's code as it stands at every state; empty where it doesn't."""
        with self._naming(index):
            group = self.group(index)
            wanted = Column(GOAL_INFO, "text", ("states",))
            found: list[str] = (
                read_column(group, wanted, self._sizes(index)).tolist()
                if GOAL_INFO in group
                else []
            )
            return found

    def episode(self, index: int) -> Episode:
        """A whole episode, without its observations.

        Raises:
            InvalidEpisodeFile: something is missing, misshapen or unreadable; the message names it.
        """
        with self._naming(index):
            group = self.group(index)
            arrays = {
                name: self._array(index, name)
                for name in (*ONCE, "points", *_STEPS, *INFOS)
                if name not in OPTIONAL or place(name) in group
            }
            labels = self.labels(index)
            return Episode(
                **arrays,
                goal_gauss_code=str(labels["goal_gauss_code"]),
                policy=str(labels["policy"]),
                seed=int(labels["seed"]) if "seed" in labels else None,
                options={
                    name.removeprefix("options/"): int(row)
                    for name, row in labels.items()
                    if name.startswith("options/")
                },
                relabelled=bool(labels["relabelled"]),
                hold=int(labels["hold"]) if "hold" in labels else None,
            )

    def observations(
        self,
        index: int,
        steps: slice = slice(None),
        *,
        goal_step: int | None = None,
        observation: str = "",
        picture: Any = None,
    ) -> Any:
        """What the agent saw at some states of an episode.

        Args:
            index: of the episode.
            steps: which of its T + 1 states.
            goal_step: show this state of the episode as the goal instead.
            observation: "pixels", "state", "both" or "symbolic"; "" for the task's.
            picture: a `knotgym.rendering.picture.PictureConfig` to draw with, instead of what the
                file holds.

        Returns:
            uint8 (n, views * size, 2 size, 3 or 4), float32 (n, 6 beads), a dict of both, or int16
            (n, 2, SYMBOLS); made from the vertices where the file holds none.
        """
        wanted = observation or self.task.observation
        if wanted not in OBSERVATIONS:
            raise InvalidEpisodeFile(
                f"observation must be one of {', '.join(OBSERVATIONS)}, got {wanted!r}"
            )
        part_of_both = self.stored == "both" and wanted in ("pixels", "state")
        with self._naming(index):
            if (self.stored == wanted or part_of_both) and picture is None:
                return self._stored(index, steps, goal_step, wanted)
            points = self._stored_points(index)
            seen = points[steps]
            goal = self._array(index, "goal_points") if goal_step is None else points[goal_step]
        return self._drawn(seen, goal, wanted, picture)

    def stored_observations(self, index: int) -> dict[str, h5py.Dataset]:
        """The observations in the file of all states of an episode, by name; of "both" two."""
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

    def _stored(self, index: int, steps: slice, goal_step: int | None, wanted: str) -> Any:
        data = self.stored_observations(index)
        names = ("pixels", "state") if wanted == "both" else (wanted,)
        seen = {name: data[name][steps] for name in names}
        if goal_step is not None:
            for name, array in seen.items():
                side = 1
                if name == "pixels":
                    side = 2 if self.task.layout == "beside" else 3
                half = array.shape[side] // 2
                goal = data[name][goal_step][None]
                np.moveaxis(array, side, 0)[half:] = np.moveaxis(goal, side, 0)[:half]
        return seen if wanted == "both" else seen[wanted]

    def _drawn(self, seen: NDArray[Any], goal: NDArray[Any], wanted: str, picture: Any) -> Any:
        # here, so that loaders of states need no OpenCV
        from knotgym.envs.observations import observe, picture_config

        drawn = picture or picture_config(self.task)
        return observe(seen, goal, wanted, drawn, self.task.layout)

    def _naming(self, index: int) -> AbstractContextManager[None]:
        """What goes wrong in an episode names it."""
        return foreign_bytes_as(InvalidEpisodeFile, f"{self.path}, episode {self.rows[index]}")

    def _sizes(self, index: int) -> dict[str, int]:
        steps = int(self.lengths[index])
        return {"steps": steps, "states": steps + 1, "beads": self._beads}

    def _stored_points(self, index: int) -> h5py.Dataset:
        return stored_column(self.group(index), array_column("points"), self._sizes(index), POINTS)

    def _array(self, index: int, name: str) -> NDArray[Any]:
        """An array of an episode, by `Episode`'s name for it."""
        group, wanted, sizes = self.group(index), array_column(name), self._sizes(index)
        if name in ONCE:
            return np.asarray(read_attribute(group, wanted, sizes))
        return read_column(group, wanted, sizes, place(name))


def episode_file(source: Any) -> Path:
    """The HDF5 file of a dataset.

    Args:
        source: a file, a dataset's folder or the `data` in it, the folder of a run of `generate`
            for its demonstrations of the train split, a `minari.MinariDataset`, a `Chosen`, or an
            id that Minari would find.

    Raises:
        MissingFile: there is none.
        InvalidEpisodeFile: a run has demonstrations of several numbers of crossings.
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
            raise InvalidEpisodeFile(f"{path} holds several datasets; name one of them: {listed}")
        if found:
            return found[0]
    raise MissingFile(f"no episodes at {tried[0]}, nor a dataset of this id under {minari_root()}")


def stored_index(file: h5py.File) -> dict[int, int]:
    """The k and T of each episode, as the file's attribute says; empty where it has none."""
    if "index" not in file.attrs:
        return {}
    read = read_attribute(file, Column("index", "integer", (None, 2), least=0))
    return {int(row): int(steps) for row, steps in read}


def counted_index(file: h5py.File) -> dict[int, int]:
    """The k and T of each episode, looked up in every one."""
    rows = sorted(int(name.removeprefix("episode_")) for name in file)
    steps = Column("total_steps", "integer", (), least=0)
    return {row: int(read_attribute(_group(file, row), steps)) for row in rows}


def told_digest(attributes: Mapping[str, Any]) -> str:
    """SHA-256 of what a file says of all its episodes, hexadecimal: JSON of names and texts."""
    told = [[name, str(attributes[name])] for name in _TOLD if name in attributes]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()


def place(name: str) -> str:
    """Where an array of an episode's states or steps stands in its group."""
    return f"infos/{name}" if name in (*INFOS, "points") else name


def _group(file: h5py.File, row: int) -> h5py.Group:
    found = member(file, f"episode_{row}")
    if not isinstance(found, h5py.Group):
        raise UnexpectedContent(f"episode_{row} should be a group")
    return found


def _kind_of_label(name: str) -> str:
    return "integer" if name.startswith("options/") else _LABELS.get(name, "any")


def _versions(text: str) -> dict[str, str]:
    read = json.loads(text)
    if not isinstance(read, dict) or not all(isinstance(name, str) for name in read.values()):
        raise UnexpectedContent(f"versions is {text[:80]!r}, should be names and versions")
    return read
