"""Recordings of demonstrators' datasets: what was decided, in a few bytes a step.

The start and the goal of an episode follow from the seed and its number, its actions from the rope
and four bytes a step (`rope.actions.encode_pulls`). So a dataset is rebuilt by stepping alone (see
`rebuild`). The reasons for the actions, the macro-actions and the number of actions simulated for
planning are recorded too. The first bytes of each episode's digest show whether another machine
gets the same episode. docs/formats/recordings.md has the layout.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from knotgym.common.atomic_files import atomic_write
from knotgym.common.configuration import read_json
from knotgym.common.errors import InvalidFile, one_line
from knotgym.common.hdf5_files import (
    Column,
    member,
    members,
    opened_hdf5,
    read_attribute,
    read_column,
)
from knotgym.common.tables import new_hdf5
from knotgym.control.planner import REST
from knotgym.control.policy import NO_MACRO, Choice, UnplannedPolicy
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.trajectory import MACRO_INFOS
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.rope.actions import decode_pulls, encode_pulls
from knotgym.rope.model import RopeConfig

RECORDINGS = Path(str(files("knotgym.generate.episodes") / "data" / "recordings.h5"))  # that ships
FORMAT, FORMAT_VERSION = "knotgym-recordings", 1
DIGEST_BYTES = 8  # of an episode's SHA-256
_COLUMNS = (
    Column("lengths", "int32", ("episodes",), least=1),
    Column("digests", "uint8", ("episodes", DIGEST_BYTES)),
    Column("pulls", "int8", ("steps", 4)),
    Column("macros", "int16", ("steps", 4), least=-1),
    Column("reason", "uint16", ("steps",)),
    Column("reasons", "uint8", (None,)),
)
_ATTRIBUTES = (
    Column("config", "text", ()),
    Column("source", "text", ()),
    Column("planned_actions", "int64", (), least=0),
)


class RecordedEpisode(NamedTuple):
    """What was decided in an episode of T steps.

    Attributes:
        pulls: int8 (T, 4), see `rope.actions.decode_pulls`.
        moves: the T reasons.
        macros: int64 (T, 4), as of `Choice`.
    """

    pulls: NDArray[np.int8]
    moves: list[str]
    macros: NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """A recorded dataset of n episodes and s steps in all.

    Attributes:
        config: the `CollectConfig` as JSON.
        source: digests of the files of policies and states, see `digests.sources`.
        planned_actions: actions simulated for planning.
        lengths: int32 (n,), steps of each episode.
        digests: uint8 (n, DIGEST_BYTES), of each episode.
        pulls, macros: int8 and int16 (s, 4), of all episodes one after another.
        reason: uint16 (s,), row of `reasons`.
        reasons: the different reasons.
    """

    config: dict[str, Any]
    source: dict[str, Any]
    planned_actions: int
    lengths: NDArray[np.int32]
    digests: NDArray[np.uint8]
    pulls: NDArray[np.int8]
    macros: NDArray[np.int16]
    reason: NDArray[np.uint16]
    reasons: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def name(self) -> str:
        """The id of the dataset."""
        return str(self.config["dataset_id"])

    @property
    def digest(self) -> str:
        """SHA-256 of its episodes' digests, hexadecimal."""
        return hashlib.sha256(np.ascontiguousarray(self.digests).tobytes()).hexdigest()

    def episode(self, number: int) -> RecordedEpisode:
        """Return an episode by its number."""
        end = int(self.lengths[: number + 1].sum())
        steps = slice(end - int(self.lengths[number]), end)
        moves = [self.reasons[row] for row in self.reason[steps].tolist()]
        return RecordedEpisode(self.pulls[steps], moves, self.macros[steps].astype(np.int64))

    def first_difference(self, dataset: Path) -> int | None:
        """Return the first episode of a dataset that isn't as recorded; None if all are."""
        reader = EpisodeReader(dataset)
        for index in range(len(reader)):
            digest = str(reader.attributes(index)["digest"])
            if index >= len(self) or digest[: 2 * DIGEST_BYTES] != bytes(self.digests[index]).hex():
                return index
        return None


class PulledPolicy(UnplannedPolicy):
    """Makes the recorded pulls, episode by episode; once they are used up, the rope is left alone.

    Episode i of the batch is the i-th recorded one.
    """

    def __init__(self, name: str, recorded: Sequence[RecordedEpisode]) -> None:
        super().__init__(name)
        self._recorded = recorded

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        pulls, moves = np.zeros((len(ids), 4), dtype=np.int8), [REST] * len(ids)
        macros = np.tile(NO_MACRO, (len(ids), 1))
        for row, index in enumerate(ids.tolist()):
            step, own = int(episodes.steps[index]), self._recorded[index]
            if step < len(own.pulls):
                pulls[row], moves[row], macros[row] = (column[step] for column in own)
        simulation = episodes.simulation
        actions = decode_pulls(pulls, simulation.points[ids], simulation.rope.config)
        return Choice(actions, moves, macros)


def record(dataset: Path) -> Recording:
    """Record a dataset that `collect` made of a policy that chooses quantized pulls.

    Raises:
        InvalidFile: it wasn't collected whole, or its policy says nothing of macro-actions.
        InvalidInput: its pulls aren't quantized.
    """
    reader = EpisodeReader(dataset)
    try:
        report = read_json(dataset / "data" / "collection.json")
        config, source = report["config"], report["source"]
        planned = int(report["tally"]["planned_actions"])
        whole = len(reader) == config["episodes"] and not config["labels"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidFile(f"{dataset} isn't a collection: {one_line(error)}") from error
    if not whole or not reader.has("macro_start"):
        raise InvalidFile(
            f"{dataset} can't be recorded: it must hold every episode played, unlabelled, of a"
            " policy that chooses macro-actions"
        )
    rope, pulls, macros, moves = RopeConfig(), [], [], list[str]()
    for episode in reader:
        pulls.append(encode_pulls(episode.actions, episode.points[:-1], rope))
        columns = [np.asarray(getattr(episode, name))[1:] for name in MACRO_INFOS]
        macros.append(np.stack(columns, axis=1).astype(np.int16))
        moves += np.asarray(episode.move)[1:].tolist()
    reasons = tuple(sorted(set(moves)))
    rows = {text: row for row, text in enumerate(reasons)}
    digests = [str(reader.attributes(i)["digest"])[: 2 * DIGEST_BYTES] for i in range(len(reader))]
    return Recording(
        config=config,
        source=source,
        planned_actions=planned,
        lengths=reader.lengths.astype(np.int32),
        digests=np.array([list(bytes.fromhex(one)) for one in digests], dtype=np.uint8),
        pulls=np.concatenate(pulls),
        macros=np.concatenate(macros),
        reason=np.array([rows[text] for text in moves], dtype=np.uint16),
        reasons=reasons,
    )


def write_recordings(path: str | os.PathLike[str], recordings: Sequence[Recording]) -> None:
    """Write recordings to a file; the same recordings give the same bytes."""
    squeezed = {"compression": "gzip", "compression_opts": 9, "shuffle": True}
    with atomic_write(path) as temporary, new_hdf5(temporary, libver=("v110", "v110")) as file:
        file.attrs["format"], file.attrs["format_version"] = FORMAT, FORMAT_VERSION
        for one in sorted(recordings, key=lambda recording: recording.name):
            group = file.create_group(one.name)
            group.attrs["config"] = json.dumps(one.config, sort_keys=True)
            group.attrs["source"] = json.dumps(one.source, sort_keys=True)
            group.attrs["planned_actions"] = np.int64(one.planned_actions)
            text = np.frombuffer("\n".join(one.reasons).encode(), dtype=np.uint8)
            for column in _COLUMNS:
                data = text if column.name == "reasons" else getattr(one, column.name)
                group.create_dataset(column.name, data=data, **(squeezed if data.size else {}))


def recorded_ids(path: str | os.PathLike[str] = RECORDINGS) -> list[str]:
    """List the ids of the recorded datasets; none if the file is missing."""
    if Path(path) == RECORDINGS and not RECORDINGS.is_file():
        return []
    with _opened(path) as file:
        return [
            f"{root}/{setup}/{name}"
            for root in file
            for setup in members(file, root)
            for name in members(file, f"{root}/{setup}")
        ]


def read_recording(name: str, path: str | os.PathLike[str] = RECORDINGS) -> Recording:
    """Read the recording of a dataset by its id.

    Raises:
        MissingFile: the file doesn't exist.
        InvalidFile: it is corrupted, in another format, or hasn't this dataset.
    """
    if name not in (known := recorded_ids(path)):
        raise InvalidFile(f"no recording of {name}; there is {', '.join(known) or 'none'}")
    with _opened(path) as file:
        group, sizes = member(file, name), dict[str, int]()
        columns = {column.name: read_column(group, column, sizes) for column in _COLUMNS}
        attributes = {one.name: read_attribute(group, one) for one in _ATTRIBUTES}
        reasons = tuple(bytes(columns.pop("reasons")).decode().split("\n"))
        planned = int(attributes.pop("planned_actions"))
        config, source = (json.loads(text) for text in attributes.values())
        beads = columns["pulls"][:, 0].view(np.uint8)
        if (
            columns["lengths"].sum(dtype=np.int64) != len(beads)
            or columns["reason"].max(initial=0) >= len(reasons)
            or beads.max(initial=0) >= RopeConfig().beads
            or config["dataset_id"] != name
            or not "".join(reasons).isprintable()
        ):
            raise InvalidFile(f"{name}: lengths, beads or reasons don't fit its steps")
        return Recording(
            config=config, source=source, planned_actions=planned, reasons=reasons, **columns
        )


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    with opened_hdf5(
        path,
        what="file of recordings",
        format=FORMAT,
        versions=(FORMAT_VERSION,),
        error=InvalidFile,
    ) as file:
        yield file
