"""Decisions to learn from, and the policy that acts them out: shared by the scripts of this folder.

A demonstrator leads one bead for up to ten pulls, then decides anew. The pulls in between depend on
what it holds and where it is heading, which a single state doesn't show. So one row of the data is
a decision: the observation where a macro-action began, the bead that it pulls, and the forces until
it ended. A policy decides, pulls as it decided, and decides again; the environment gets six numbers
at every step, as always.

Everything is in the canonical frame of the marked observation, in which all images of a state by
the task's symmetries look alike; with `--frame world`, as it lies.
"""

from __future__ import annotations

import argparse
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from knotgym.control import Ids, Pulls
from knotgym.datasets import Episodes, columns_of, gauss_code
from knotgym.envs import CanonicalFrames, EpisodeBatch, TaskConfig, mark
from knotgym.learn import CloneNetwork, Inputs, MarkedInputs, inputs
from knotgym.rope import RopeConfig, quantized
from knotgym.topology import GaussCode, label

BEADS = RopeConfig().beads
BEAD_WIDTH = 32  # of `MarkedInputs.beads`
CHUNK = 10  # pulls of a macro-action, at most
HINDSIGHT = 2  # decisions whose outcome may be taken for their goal
MOST_CROSSINGS = 4  # of such a goal
REACH = 3.0  # scales positions to [-1, 1]
Floats = NDArray[np.float32]


class Decisions(NamedTuple):
    """N decisions, in the order of their episodes.

    Attributes:
        observations: float32 (N, size), see `observe`.
        beads: int64 (N,), the bead to pull.
        chunks: float32 (N, 3 + 4 CHUNK): where that bead lies, times REACH; the forces; and for
            each pull 1, or -1 from the macro-action's end on.
        rewards: float32 (N,), sum until the next decision.
        terminals, ends: bool (N,), whether the episode terminated there; whether it ended.
        chosen: bool (N,), whether it is worth imitating: chosen by the demonstrator, on a way that
            led to the goal.
        whole: bool (N,), whether the macro-action was carried out to its end.
        hindsight: bool (N,), whether its goal is a code that was reached instead, or on the way.
    """

    observations: Floats
    beads: NDArray[np.int64]
    chunks: Floats
    rewards: Floats
    terminals: NDArray[np.bool_]
    ends: NDArray[np.bool_]
    chosen: NDArray[np.bool_]
    whole: NDArray[np.bool_]
    hindsight: NDArray[np.bool_]

    def rows(self, index: NDArray[Any]) -> Decisions:
        """Return some of the decisions."""
        return Decisions(*(column[index] for column in self))


def decision_options(options: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add the options of learning from decisions."""
    options.add_argument("--rate", type=float, default=1e-3, help="learning rate")
    options.add_argument("--frame", choices=("rope", "world"), default="rope", help="of states")
    options.set_defaults(steps=3000, batch=64)
    return options


def observe(
    points: NDArray[np.floating], goals: list[GaussCode], frame: str
) -> tuple[Floats, CanonicalFrames]:
    """Return observations float32 (n, size) of ropes (n, beads, 3), and their frames."""
    seen = mark(points, goals, canonical=frame == "rope")
    flat = [part.flatten(1).float() for part in inputs(seen[:4])]
    return torch.cat(flat, dim=1).numpy(), seen.frames


def parts(observations: Tensor) -> Inputs:
    """Return the network inputs that `observe` made flat."""
    beads, arcs, codes = observations.split(
        [8 * BEADS, BEADS, observations.shape[1] - 9 * BEADS], 1
    )
    count = len(observations)
    return Inputs(beads.reshape(count, BEADS, 8), arcs.long(), codes.reshape(count, 2, -1, 14))


def read(datasets: list[str], frame: str) -> Decisions:
    """Read the decisions of datasets, in the frame of the rope or the world."""
    rows = list[_Row]()
    for dataset in datasets:
        episodes = columns_of(dataset).episodes
        if "macro_start" not in episodes.steps:
            raise SystemExit(f"{dataset} records no macro-actions; use a demonstrator's set")
        for number in range(episodes.episodes.rows):
            own = _decided(episodes, number)
            rows += own + _in_hindsight(own)
    columns = _Row(*zip(*rows, strict=True))
    points = np.stack(columns.points)
    observations, frames = observe(points, list(columns.goal), frame)
    beads = frames.renumber(columns.bead)
    chunks = [
        REACH * frames.points(points)[np.arange(len(beads)), beads],
        frames.vectors(columns.forces).reshape(len(beads), -1),
        np.stack(columns.going),
    ]
    return Decisions(
        observations,
        beads,
        np.concatenate(chunks, axis=1).clip(-1, 1).astype(np.float32),
        np.array(columns.reward, dtype=np.float32),
        *(np.array(column) for column in columns[8:]),
    )


class _Row(NamedTuple):
    """A decision in the world; the last five are those of `Decisions`."""

    points: Any
    goal: Any
    bead: Any
    forces: Any
    going: Any
    before: Any
    after: Any
    reward: Any
    terminal: Any
    end: Any
    chosen: Any
    whole: Any
    hindsight: Any


def _decided(episodes: Episodes, number: int) -> list[_Row]:
    """Return the decisions of an episode."""
    first, count = int(episodes.offsets[number]), int(episodes.episodes["length"][number])
    steps = episodes.steps.take(slice(first, first + count + 1))
    points = steps["observation"].astype(np.float64)
    # a pull is part of a macro-action where one has a side
    start, led = steps["macro_start"][:count], steps["macro_side"][:count] != 0
    won = bool(steps["terminated"][count - 1])
    begun = np.flatnonzero(start).tolist()
    shown = [label(points[at]).plain for at in (*begun, count)]
    goal = gauss_code(episodes.episodes["goal_visits"][number]).plain
    ends = [*begun[1:], count][: len(begun)]  # none if the planner led from the start
    rows = []
    for row, (at, after) in enumerate(zip(begun, ends, strict=True)):
        # the macro-action ends where the next begins, or before a pull that is part of none
        stop = at + int(np.append(~led[at:after], True).argmax())
        pulls = min(stop - at, CHUNK)
        forces = np.zeros((CHUNK, 3))
        forces[:pulls] = steps["force"][at : at + pulls]
        rows.append(
            _Row(
                points=points[at],
                goal=goal,
                bead=int(steps["bead"][at]),
                forces=forces,
                going=np.where(np.arange(CHUNK) < pulls, 1.0, -1.0),
                before=shown[row],
                after=shown[row + 1],
                reward=steps["reward"][at:after].sum(),
                terminal=won and after == count,
                end=after == count,
                chosen=won,
                whole=stop == after or pulls == CHUNK,
                hindsight=False,
            )
        )
    return rows


def _in_hindsight(rows: list[_Row]) -> list[_Row]:
    """Return decisions as if the code that they, or the next ones, led to had been the goal."""
    found = []
    for first, row in enumerate(rows):
        left = {row.goal}
        for last in rows[first : first + HINDSIGHT]:
            left.add(last.before)
            if not last.whole:  # a random pull came between
                break
            if last.after not in left and last.after.nx <= MOST_CROSSINGS:
                ended = {"chosen": True, "hindsight": True, "terminal": True, "end": True}
                found.append(row._replace(goal=last.after, **ended))
    return found


class Eyes(nn.Module):
    """Looks at observations by attention over the beads, and points at one of them.

    Attributes:
        size: of the vectors that `look` returns.
    """

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self._network = CloneNetwork(width)
        self.size = width + BEAD_WIDTH + 3

    def forward(self, observations: Tensor) -> MarkedInputs:
        """Return what is seen of observations (n, size): beads, the whole, and bead logits."""
        seen: MarkedInputs = self._network(parts(observations))
        return seen

    def look(self, observations: Tensor, shares: Tensor | None = None) -> Tensor:
        """Return the whole and one bead (n, size): that of one-hot `shares` (n, beads), or a mean
        by the softmax of the logits."""
        seen = self(observations)
        weights = seen.logits.softmax(1) if shares is None else shares
        beads = torch.cat([seen.beads, parts(observations).beads[..., :3]], dim=2)
        return torch.cat([seen.whole, (weights[:, None] @ beads)[:, 0]], dim=1)


class ChunkPolicy(ABC):
    """Decides, pulls the bead as decided, and decides anew when the chunk is over.

    Attributes:
        name: in the results.
        frame: "rope" or "world", as in training.
        rngs: the generator of each lane's episode.
    """

    def __init__(self, name: str, frame: str) -> None:
        self.name, self.frame = name, frame
        self.rngs: dict[int, np.random.Generator] = {}

    @abstractmethod
    def choose(self, indices: list[int], seen: Floats, points: Floats) -> tuple[Any, Floats]:
        """Decide for lanes, given their observations and ropes (n, beads, 3) in the frame.

        Returns:
            beads (n,), and the forces and signs of `Decisions.chunks`, (n, 4 CHUNK).
        """

    def begin(self, index: int, rng: np.random.Generator) -> None:
        """Start an episode in a lane."""
        self.rngs[index] = rng

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """Any task of pulls."""
        return task

    def player(self, batch: EpisodeBatch) -> ChunkPlayer:
        """Return a player for the lanes of a batch."""
        return ChunkPlayer(self, batch)


class ChunkPlayer:
    """Carries out what a `ChunkPolicy` decides."""

    def __init__(self, policy: ChunkPolicy, batch: EpisodeBatch) -> None:
        self._policy, self._batch = policy, batch
        self.planned = np.zeros(batch.count, dtype=np.int64)
        self._left: dict[int, list[tuple[int, Any]]] = {}

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        """Start new episodes in lanes."""
        for index, rng in zip(ids.tolist(), rngs, strict=True):
            self._left[index] = []
            self._policy.begin(index, rng)

    def act(self, ids: Ids) -> Pulls:
        """Choose pulls in lanes."""
        if deciding := [index for index in ids.tolist() if not self._left[index]]:
            self._decide(np.array(deciding))
        beads, forces = zip(*(self._left[index].pop(0) for index in ids.tolist()), strict=True)
        return Pulls(ids, np.array(beads), quantized(np.clip(forces, -1, 1)).astype(np.float32))

    def _decide(self, ids: Ids) -> None:
        points = self._batch.simulation.points[ids]
        observations, frames = observe(points, self._batch.goals_of(ids), self._policy.frame)
        seen = frames.points(points).astype(np.float32)
        beads, chunks = self._policy.choose(ids.tolist(), observations, seen)
        count, pulls = len(ids), chunks.shape[1] // 4
        forces = chunks[:, : 3 * pulls].reshape(count, pulls, 3)
        # at least one pull, and those before the first that isn't to be made any more
        length = 1 + (chunks[:, 3 * pulls + 1 :] > 0).cumprod(1).sum(1)
        own, pulled = frames.renumber(beads), frames.world_vectors(forces)
        for row, index in enumerate(ids.tolist()):
            self._left[index] = [(own[row], pulled[row, step]) for step in range(length[row])]


def nearest(chunks: Floats, points: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the bead of `points` that each of `Decisions.chunks` pulls, and the rest of it."""
    offsets = points - chunks[:, None, :3] / REACH
    return (offsets**2).sum(2).argmin(1), chunks[:, 3:]
