"""Decisions to clone: which macro-action, or pull, was chosen in which state for which goal."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from knotgym.common.atomic_files import atomic_write
from knotgym.common.errors import one_line
from knotgym.common.hdf5_files import require_regular
from knotgym.control.demonstrator import RANDOM
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.datasets.trajectory import MACRO_INFOS
from knotgym.envs.marked import Marked, mark
from knotgym.learn.rope_model import MAX_FORCE
from knotgym.learn.training_data import InvalidTraining, require_trainable
from knotgym.rope.actions import force_choices
from knotgym.topology.gauss import GaussCode


class Decisions(NamedTuple):
    """n choices of macro-actions, in the world.

    Attributes:
        points: float32 (n, beads, 3), metres.
        goals: str (n,), codes without chirality.
        macros: int64 (n, 3): bead to lead, bead of the strand to pass, +1 over or -1 under.
        forces: float32 (n, 3), relative to the largest, of pulls; not used for macro-actions.
        episodes: int64 (n,), episodes are held out whole.
    """

    points: NDArray[np.float32]
    goals: NDArray[np.str_]
    macros: NDArray[np.int64]
    forces: NDArray[np.float32]
    episodes: NDArray[np.int64]

    def rows(self, index: NDArray[Any]) -> Decisions:
        """Return some of the decisions."""
        return Decisions(*(column[index] for column in self))

    @property
    def digest(self) -> str:
        """SHA-256 of all columns, hexadecimal."""
        whole = hashlib.sha256("\n".join(self.goals.tolist()).encode())
        for column in (self.points, self.macros, self.forces, self.episodes):
            whole.update(np.ascontiguousarray(column).tobytes())
        return whole.hexdigest()


class Examples(NamedTuple):
    """n decisions in the canonical frame.

    Attributes:
        seen: states; frames apart, all that the network is shown.
        macros: int64 (n, 3): bead, strand, 0 for under or 1 for over.
        forces: int64 (n, 3), choices of the force components of pulls.
        episodes: int64 (n,).
    """

    seen: Marked
    macros: NDArray[np.int64]
    forces: NDArray[np.int64]
    episodes: NDArray[np.int64]

    def rows(self, index: NDArray[Any]) -> Examples:
        """Return some of the examples."""
        own = self.macros[index], self.forces[index], self.episodes[index]
        return Examples(self.seen.rows(index), *own)


def examples(decisions: Decisions) -> Examples:
    """Bring decisions into the canonical frame."""
    codes = {text: GaussCode.parse(text) for text in set(decisions.goals.tolist())}
    seen = mark(decisions.points, [codes[text] for text in decisions.goals.tolist()])
    frames, (beads, targets, sides) = seen.frames, decisions.macros.T
    macros = frames.renumber(beads), frames.renumber(targets), (frames.sides(sides) + 1) // 2
    forces = np.clip(frames.vectors(decisions.forces), -1, 1)
    return Examples(
        seen._replace(points=seen.points.astype(np.float32)),
        np.stack(macros, axis=1),
        force_choices(forces),
        decisions.episodes,
    )


def read_decisions(
    datasets: Sequence[Any], action: str = "macro", failed: bool = False
) -> Decisions:
    """Read the decisions of datasets, given as ids or folders.

    Args:
        datasets: of the train split.
        action: "macro" for the macro-actions that a demonstrator chose; "bead" for every pull.
        failed: also read episodes that didn't reach their goal.

    Raises:
        InvalidTraining: a dataset is not of the train split, has no episodes, was made with another
            rope, or holds no macro-actions.
        InvalidEpisodeFile, MissingFile: a dataset is missing or not of this version.
    """
    if not datasets:
        raise InvalidTraining("name at least one dataset to train on, as in --data FOLDER")
    parts = list[Decisions]()
    number = 0
    for dataset in datasets:
        reader = EpisodeReader(dataset)
        require_trainable(reader, dataset)
        if action == "macro" and not reader.has("macro_start"):
            raise InvalidTraining(
                f"{dataset} doesn't say which macro-actions its policy chose, so the clone can't"
                " learn them; use a demonstrator's set, or set action = bead to learn pulls"
            )
        for index in range(len(reader)):
            if failed or reader.column(index, "terminations")[-1]:
                parts.append(_of_episode(reader, index, action, number))
            number += 1
        reader.close()
    if not sum(len(part.points) for part in parts):
        raise InvalidTraining(
            f"no episode of {', '.join(map(str, datasets))} reached its goal, so there is nothing"
            " to imitate; set failed = true to learn from the others too"
        )
    return join(parts)


def join(parts: Sequence[Decisions]) -> Decisions:
    """Return all decisions in one; episode numbers stay as they are."""
    return Decisions(*(np.concatenate(own) for own in zip(*parts, strict=True)))


def save_decisions(path: Path, decisions: Decisions, rates: dict[str, float]) -> None:
    """Write decisions and the success rates of the play that made them, as safetensors."""
    arrays = decisions._asdict()
    arrays["goals"] = np.frombuffer(
        "".join(f"{goal}\n" for goal in decisions.goals.tolist()).encode(), dtype=np.uint8
    )
    with atomic_write(path) as part:
        part.write_bytes(save(arrays, metadata={key: repr(rate) for key, rate in rates.items()}))


def load_decisions(path: Path) -> tuple[Decisions, dict[str, float]]:
    """Read what `save_decisions` wrote; raise InvalidTraining if it is corrupted."""
    require_regular(path, "training", InvalidTraining)
    try:
        with safe_open(path, framework="numpy") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}
            rates = {key: float(rate) for key, rate in (file.metadata() or {}).items()}
        goals = np.array(bytes(arrays.pop("goals")).decode().split("\n")[:-1], dtype=np.str_)
        decisions = Decisions(goals=goals, **arrays)
        lengths = {len(column) for column in decisions}
    except (SafetensorError, TypeError, ValueError) as error:
        raise InvalidTraining(f"{path} can't be read: {one_line(error)}") from error
    if len(lengths) != 1:
        raise InvalidTraining(f"{path} is corrupted: its columns have different lengths")
    return decisions, rates


def _of_episode(reader: EpisodeReader, index: int, action: str, number: int) -> Decisions:
    episode = reader.episode(index)
    steps = len(episode)
    # an info at state t + 1 belongs to the pull that led there from state t
    forces = (episode.force[1:] / MAX_FORCE).astype(np.float32)
    if action == "macro":
        start, *macro = (reader.column(index, name)[1:] for name in MACRO_INFOS)
        # passes that nobody chose teach nothing
        drawn = (episode.move if episode.move is not None else np.full(steps + 1, ""))[1:] == RANDOM
        chosen = np.flatnonzero(start & ~drawn)
        macros = np.stack(macro, axis=1).astype(np.int64)[chosen]
    else:
        chosen = np.arange(steps)
        macros = np.zeros((steps, 3), dtype=np.int64)
        macros[:, 0] = episode.bead[1:]
    return Decisions(
        episode.points[:-1][chosen].astype(np.float32),
        np.full(len(chosen), episode.goal_gauss_code),
        macros,
        forces[chosen],
        np.full(len(chosen), number, dtype=np.int64),
    )
