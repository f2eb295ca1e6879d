"""Decisions to clone: which macro-action, or pull, was chosen in which state for which goal."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.envs.marked import mark
from knotgym.learn.clone_network import FORCE_BINS, Inputs, Macros, inputs
from knotgym.learn.rope_model import MAX_FORCE
from knotgym.learn.training_data import InvalidTraining, require_trainable
from knotgym.topology.gauss import GaussCode

_CHUNK = 4096  # states marked at once
_MACRO_INFOS = ("macro_start", "macro_bead", "macro_target", "macro_side")


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

    @property
    def digest(self) -> str:
        """SHA-256 of all columns, hexadecimal."""
        whole = hashlib.sha256("\n".join(self.goals.tolist()).encode())
        for column in (self.points, self.macros, self.forces, self.episodes):
            whole.update(np.ascontiguousarray(column).tobytes())
        return whole.hexdigest()


class Examples(NamedTuple):
    """n decisions in the canonical frame, as the network takes them.

    Attributes:
        states: what the network sees.
        macros: bead, strand and side.
        bins: int64 (n, 3), bins of the force.
        episodes: int64 (n,).
    """

    states: Inputs
    macros: Macros
    bins: Tensor
    episodes: NDArray[np.int64]

    def rows(self, index: Tensor) -> Examples:
        """Return some of the examples."""
        return Examples(
            self.states.rows(index),
            Macros(*(column[index] for column in self.macros)),
            self.bins[index],
            self.episodes[index.numpy()],
        )

    def __len__(self) -> int:
        return len(self.episodes)


def examples(decisions: Decisions) -> Examples:
    """Bring decisions into the canonical frame."""
    codes = {text: GaussCode.parse(text) for text in set(decisions.goals.tolist())}
    states, columns = list[Inputs](), list[tuple[NDArray[Any], ...]]()
    for first in range(0, len(decisions.points), _CHUNK):
        rows = slice(first, first + _CHUNK)
        seen = mark(decisions.points[rows], [codes[text] for text in decisions.goals[rows].tolist()])
        frames, (bead, target, side) = seen.frames, decisions.macros[rows].T
        over = (frames.sides(side) > 0).astype(np.int64)
        force = frames.vectors(decisions.forces[rows])
        states.append(inputs(seen))
        columns.append((frames.renumber(bead), frames.renumber(target), over, force_bins(force)))
    bead, target, over, bins = (torch.from_numpy(np.concatenate(own)) for own in zip(*columns))
    together = Inputs(*(torch.cat(own) for own in zip(*states, strict=True)))
    return Examples(together, Macros(bead, target, over), bins, decisions.episodes)


def force_bins(forces: NDArray[Any]) -> NDArray[np.int64]:
    """Return the bins of forces (n, 3) relative to the largest; bins are centred on -1, ..., 1."""
    scaled = (np.clip(forces, -1, 1) + 1) / 2 * (FORCE_BINS - 1)
    return np.rint(scaled).astype(np.int64)


def bin_forces(bins: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the forces at the centres of bins; the inverse of `force_bins`."""
    return bins / (FORCE_BINS - 1) * 2 - 1.0


def read_decisions(datasets: Sequence[Any], action: str = "macro") -> Decisions:
    """Read the decisions of datasets, given as ids or folders.

    Args:
        datasets: of the train split.
        action: "macro" for the macro-actions that a demonstrator began; "bead" for every pull.

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
            parts.append(_of_episode(reader, index, action, number))
            number += 1
        reader.close()
    return join(parts)


def join(parts: Sequence[Decisions]) -> Decisions:
    """Return all decisions in one; episode numbers stay as they are."""
    return Decisions(*(np.concatenate(own) for own in zip(*parts, strict=True)))


def _of_episode(reader: EpisodeReader, index: int, action: str, number: int) -> Decisions:
    episode = reader.episode(index)
    steps = len(episode)
    # an info at state t + 1 belongs to the pull that led there from state t
    forces = (episode.force[1:] / MAX_FORCE).astype(np.float32)
    if action == "macro":
        start, *macro = (reader.column(index, name)[1:] for name in _MACRO_INFOS)
        # without a bead to pass it is a random pull
        chosen = np.flatnonzero(start & (macro[1] >= 0))
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
