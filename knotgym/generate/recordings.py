"""Recordings of the suite's datasets: the pulls, in a few bytes a step.

The starts and goals of a collection follow from its seed, and everything else from its pulls. So a
recorded dataset is rebuilt by stepping alone: nothing is planned. The first bytes of a digest of
each episode show whether another machine gets the same one.

    episodes    one row an episode, set after set: pulls, digest
    steps       one row a pull: bead, force in bins, and the macro-action that it is part of
    sets        attribute: id -> settings of the collection, and number of episodes

Forces of recorded policies are whole multiples of 1 / FORCE_BINS of the largest one.
"""

import hashlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import (
    Column,
    InvalidFile,
    InvalidInput,
    Schema,
    Stream,
    Table,
    as_json,
    from_json,
    read_tables,
    write_tables,
)
from knotgym.control import replay
from knotgym.datasets import MACROS, Episodes
from knotgym.generate.episode_configs import CollectConfig
from knotgym.rope import FORCE_BINS
from knotgym.runs import Result

RECORDINGS = Path(str(files("knotgym.generate") / "data" / "recordings.h5"))  # that ships
FORMAT = "knotgym-recordings"
DIGEST = 8  # bytes of an episode's SHA-256
LENGTH = Column("length", "uint16", (), "pulls", "T, the number of pulls", least=1)
DIGESTS = Column("digest", "uint8", (DIGEST,), "", "the first bytes of its states' SHA-256")
EPISODES = Schema("episodes", (LENGTH, DIGESTS), "an episode, set after set")
STEPS = Schema(
    "steps",
    (
        Column("bead", "uint8", (), "", "that is pulled, at its centre"),
        Column("force", "int8", (3,), f"max_force / {FORCE_BINS}", "that it is pulled with"),
        Column("macro_start", "bool", (), "", "the pull is the first of a macro-action"),
        Column("macro_bead", "uint8", (), "", "that the macro-action leads"),
        Column("macro_target", "uint8", (), "", "bead whose strand the macro-action passes"),
        Column("macro_side", "int8", (), "", "+1 over, -1 under; 0 without a macro-action"),
    ),
    "a pull, episode after episode",
)


class Recording(NamedTuple):
    """A recorded dataset.

    Attributes:
        config: of the collection that it was.
        episodes: lengths and pulls; `control.recorded_policy` repeats them.
        digests: uint8 (n, 8), of each episode.
    """

    config: CollectConfig
    episodes: Episodes
    digests: NDArray[np.uint8]

    @classmethod
    def of(cls, config: CollectConfig, episodes: Episodes) -> "Recording":
        """Record a collected dataset whose policy chooses quantized pulls.

        Raises:
            InvalidInput: its pulls aren't quantized, or it doesn't say which macro-actions were
                chosen.
        """
        steps = episodes.steps
        if MACROS[0] not in steps or Episodes.binned(steps["force"]) is None:
            raise InvalidInput(
                f"{config.dataset_id} can't be recorded: its policy must choose macro-actions, and"
                f" forces in multiples of 1/{FORCE_BINS} of the largest"
            )
        return cls(config, episodes, digests(episodes))

    @staticmethod
    @lru_cache(maxsize=2)
    def read_all(path: Path = RECORDINGS) -> Mapping[str, "Recording"]:
        """Read a file of recordings: id of the dataset -> its recording.

        Raises:
            MissingFile: the file doesn't exist.
            InvalidFile: it is corrupted or in another format.
        """
        (rows, steps), attributes = read_tables(path, EPISODES, STEPS, format=FORMAT)
        lengths = rows["length"].astype(np.int64)
        sets = attributes.get("sets")
        if not isinstance(sets, dict) or lengths.sum() != steps.rows:
            raise InvalidFile(f"{path}: its episodes don't fit its pulls")
        ends = np.concatenate([[0], np.cumsum(lengths)])
        found, first = dict[str, Recording](), 0
        try:
            for name, one in sets.items():
                config, last = from_json(CollectConfig, one["config"]), first + one["episodes"]
                pulls = steps.take(slice(ends[first], ends[last]))
                exact = {**pulls, "force": Episodes.unbinned(pulls["force"])}
                episodes = Episodes.to_repeat(lengths[first:last], exact, config.policy.policy)
                found[name] = Recording(config, episodes, rows["digest"][first:last])
                first = last
        except (KeyError, TypeError, IndexError) as error:
            raise InvalidFile(f"{path}: its list of sets is damaged: {error!r}") from error
        if first != rows.rows:
            raise InvalidFile(f"{path} has {rows.rows} episodes, and its sets have {first}")
        return found

    @staticmethod
    def write_all(path: Path, all_sets: Sequence["Recording"]) -> None:
        """Write recordings to a file; the same recordings give the same bytes."""
        rows, steps, sets = list[Table](), list[Table](), dict[str, Any]()
        for one in sorted(all_sets, key=lambda one: one.config.dataset_id):
            length, made = one.episodes.episodes["length"], one.episodes.pulls()
            bins = Episodes.binned(made["force"])
            assert bins is not None  # `Recording.of` refuses others
            columns = {**made, "force": bins}
            own = {c.name: columns[c.name].astype(c.dtype) for c in STEPS.columns}
            steps.append(Table(STEPS, own))
            own = {"length": length.astype(np.uint16), "digest": one.digests}
            rows.append(Table(EPISODES, own))
            sets[one.config.dataset_id] = {"config": as_json(one.config), "episodes": len(length)}
        write_tables(path, [rows, steps], {"sets": sets}, format=FORMAT, pack=True)


def digests(episodes: Episodes) -> NDArray[np.uint8]:
    """Compute the first bytes of the SHA-256 of each episode: uint8 (n, 8).

    It covers the start, all states with their codes, and the pulls; rewards and ends follow.
    """
    steps, offsets = episodes.steps, episodes.offsets
    found = np.zeros((episodes.episodes.rows, DIGEST), dtype=np.uint8)
    for row, start in enumerate(np.asarray(episodes.episodes["start_qpos"])):
        states = slice(offsets[row], offsets[row + 1])
        pulls = slice(offsets[row], offsets[row + 1] - 1)
        # codes of sets are padded to different widths, so zeros don't count
        codes = [steps[name][states] for name in ("visits", "signs")]
        parts = [
            *(start, steps["observation"][states], steps["bead"][pulls], steps["force"][pulls]),
            *(steps["crossings"][states], *(code[code != 0] for code in codes)),
        ]
        digest = hashlib.sha256(b"".join(part.tobytes() for part in parts)).digest()
        found[row] = np.frombuffer(digest[:DIGEST], dtype=np.uint8)
    return found


def first_difference(episodes: Episodes, recording: Recording) -> int | None:
    """Return the first episode that isn't as recorded; None if all are.

    Starts, states, pulls and macro-actions are compared; what follows from them isn't stored here.
    """
    count = episodes.episodes.rows
    known = recording.digests[:count]
    if len(known) < count:
        return len(known)
    same = (digests(episodes) == known).all(axis=1)
    own = recording.episodes.select(np.arange(count)).steps
    for name in MACROS:
        if name in episodes.steps and len(own[name]) == episodes.steps.rows:
            rows = np.flatnonzero(episodes.steps[name] != own[name])
            same[episodes.episode_of()[rows]] = False
    return None if same.all() else int(same.argmin())


def rebuilt(config: CollectConfig, numbers: range, path: Path = RECORDINGS) -> Result:
    """Make a block of a collection's episodes from their recording.

    Args:
        config: the collection, whose id names the recording.
        numbers: of the episodes.
        path: file of recordings.

    Raises:
        InvalidFile: there is no such recording, or it has fewer episodes.
    """
    recording = Recording.read_all(path)[config.dataset_id]
    if numbers.stop > recording.episodes.episodes.rows:
        raise InvalidFile(
            f"{config.dataset_id} is recorded with {recording.episodes.episodes.rows} episodes, got"
            f" {config.episodes}"
        )
    own = recording.episodes.select(np.arange(numbers.start, numbers.stop))
    seeds = [Stream.EPISODE.derived_seed(config.seed, number) for number in numbers]
    return replay(own, config.policy_task, seeds).columns()
