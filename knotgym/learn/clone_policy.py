"""The clone as a policy: when its macro-action is over, it looks and chooses the next one.

A guided clone chooses among the macro-actions that its network finds likely and the first passes of
the order of policy `expert`, also by what they are worth in that order. Nothing is simulated.

It sees the rope and the goal's code from vertices; if the observation is "pixels" it sees nothing
but the pictures, as the reader of `shape_hypotheses` reads them.

After a change run what `clone_network` says.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from knotgym.common import Array, Ids, InvalidFile, InvalidPolicy
from knotgym.control import ActionPlayer, PassValues, Player, Sight
from knotgym.envs import OBSERVATIONS, EpisodeBatch, Marked, TaskConfig
from knotgym.learn.agent import require_readable
from knotgym.learn.card import CARD, PRETRAINED, read_card
from knotgym.learn.checkpoint import load_network, load_reader
from knotgym.learn.clone_network import WORKING, CloneNetwork, Inputs, inputs
from knotgym.learn.colour_reading import BEADS
from knotgym.learn.learners import CLONE, policy_folder
from knotgym.learn.shape_hypotheses import MOST_IMAGINED, ShapeHypotheses
from knotgym.photos import inference
from knotgym.rope import VIEWS, ActionView, ChainSimulation
from knotgym.topology import GaussCode, label

_BLOCK = 32  # states that the network is given at a time: its sums depend on their number
# Temperature after a macro-action that changed no code: the likeliest one would be chosen again.
# Measured on an earlier clone alone, where 0 did as well (notes/experiments.md).
_ESCAPE = 0.7
# weight of the chance of being chosen, where the order of the passes counts too; not measured alone
_GUIDED = 0.25
# of the order, at most; and what a macro-action is worth that it doesn't have: not measured
_PASSES = 40
_UNORDERED = 0.02


class ClonePolicy:
    """Chooses the macro-actions that its network finds likeliest.

    Attributes:
        name: of the policy.
        network: in evaluation mode.
        guided: whether the order of the passes counts too.
    """

    name = CLONE

    def __init__(self, network: CloneNetwork, guided: bool) -> None:
        self.network, self.guided = network, guided

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        """Return the task with observation "state" or "pixels"; raise InvalidPolicy if unfit."""
        view = VIEWS[task.action]
        if not (view.is_macro or view.is_plain):
            raise InvalidPolicy(
                f"policy {CLONE} chooses macro-actions, so it needs action 'macro' or 'pull', got"
                f" {task.action!r}"
            )
        if task.beads != BEADS:
            raise InvalidPolicy(f"policy {CLONE} needs a rope of {BEADS} beads, got {task.beads}")
        if not _sees_pictures_alone(task):
            return replace(task, observation="state")
        # a picture shows where to pull, but not where in the world that is
        require_readable(task, CLONE, "macro")
        return task

    def player(self, batch: EpisodeBatch) -> Player:
        """Return a player for the lanes of a batch."""
        return _ClonePlayer(self, batch)


def _sees_pictures_alone(task: TaskConfig) -> bool:
    return OBSERVATIONS[task.observation].goal == ("picture",)


class _ClonePlayer(ActionPlayer):
    """Chooses macro-actions, whatever the view of the task."""

    def __init__(self, policy: ClonePolicy, batch: EpisodeBatch) -> None:
        super().__init__(batch, CLONE, ActionView("macro", batch.simulation))
        self._network, split = policy.network, batch.task.split
        self._values = PassValues.of_split(split, every_code=True) if policy.guided else None
        self._codes: dict[int, GaussCode | None] = {}  # at the last choice
        self._seen: dict[int, ShapeHypotheses] = {}  # where only pictures are

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        super().begin(ids, rngs)
        for index in ids.tolist():
            self._codes[index] = None
            if _sees_pictures_alone(self.batch.task):
                reader, starts = load_reader(PRETRAINED)
                chain = ChainSimulation(MOST_IMAGINED)
                self._seen[index] = ShapeHypotheses(reader, chain, starts, self.rngs[index])

    def choose(self, ids: Ids) -> NDArray[np.float32]:
        indices = ids.tolist()
        if self._seen:
            read = [self._read(k) for k in indices]
            points, goals = np.stack([rope for rope, _ in read]), [goal for _, goal in read]
            codes = [label(rope) for rope in points]
        else:
            points, goals = self.batch.simulation.points[ids], self.batch.goals_of(ids)
            codes = self.batch.codes_of(ids)
        stuck = [code == self._codes[k] for k, code in zip(indices, codes, strict=True)]
        self._codes |= dict(zip(indices, codes, strict=True))
        rngs = [self.rngs[k] for k in indices]
        temperatures = np.where(stuck, _ESCAPE, 0.0)
        macros = _choose_macros(self._network, points, goals, temperatures, rngs, self._values)
        return macros.astype(np.float32)

    def _read(self, index: int) -> tuple[Array, GaussCode]:
        """Return the likeliest vertices of the rope, float64 (beads, 3), and code of the goal."""
        hypotheses = self._seen[index]
        hypotheses.observe(self.batch.rgb(index))
        rope, goals = hypotheses.ropes[0], hypotheses.goals
        # the goal isn't shown yet, or the episode would be over
        shown = label(rope)
        left = [code for code in goals if not code.matches(shown)] or list(goals)
        return rope, max(left, key=lambda code: goals[code])


def _choose_macros(
    network: CloneNetwork,
    points: Array,
    goals: Sequence[GaussCode],
    temperatures: Array,
    rngs: Sequence[np.random.Generator],
    values: PassValues | None = None,
) -> NDArray[np.int64]:
    """Choose macro-actions, int64 (n, 3): bead, target, side (0 under, 1 over).

    Args:
        network: in evaluation mode.
        points: float64 (n, beads, 3), metres.
        goals: n codes.
        temperatures: float64 (n,); 0 for the likeliest macro-action.
        rngs: source of each state's draws; used only at temperatures above 0.
        values: guides the choice; None for no guidance.
    """
    chosen = [np.zeros((0, 3), dtype=np.int64)]
    for first in range(0, len(points), _BLOCK):
        some = slice(first, first + _BLOCK)
        # Always _BLOCK rows, as sums of a network round by the shape of their batch.
        seen, count = Marked.of(points[some], goals[some]), len(points[some])
        shown = inputs(seen[:4])
        lacking = (0, _BLOCK - count)  # rows at the end
        states = Inputs(*(functional.pad(x, (0, 0) * (x.dim() - 1) + lacking) for x in shown))
        with inference():
            looked = network(states)
            macros, prior, weight = network.likely(looked), torch.zeros(1, 1), 1.0
            if values is not None:
                macros, prior = _with_passes(macros, values, points[some], goals[some], seen)
                weight = _GUIDED
            likely, works = network.rate(looked, macros)
        # the maximum of logits with Gumbel noise is a draw from their softmax
        noise = np.zeros(likely.shape)
        for row in np.flatnonzero(temperatures[some] > 0).tolist():
            drawn = rngs[first + row].gumbel(size=noise.shape[1])
            noise[row] = temperatures[first + row] * drawn
        # all are logarithms: worth by the order, chance of being chosen, and weighed by WORKING the
        # chance that it works
        worth = prior + weight * likely + WORKING * works + torch.from_numpy(noise)
        best = macros[torch.arange(count), worth.argmax(1)[:count]].numpy()
        # back from the canonical frame into the world; reversal is its own inverse
        world = seen.frames.macros(best, points.shape[1])
        world[:, 1] = (world[:, 1] + (world[:, 1] == world[:, 0])) % points.shape[1]  # not itself
        chosen.append(world)
    return np.concatenate(chosen)


def _with_passes(
    likely: Tensor, values: PassValues, points: Array, goals: Sequence[GaussCode], marked: Marked
) -> tuple[Tensor, Tensor]:
    """Add the first passes of the order to macro-actions (_BLOCK, k, 3).

    Args:
        likely: in the canonical frame.
        values: the order.
        points, goals, marked: up to _BLOCK states, for which passes are added.

    Returns:
        Macro-actions (_BLOCK, k + _PASSES, 3), and the logarithms of what they are worth; -inf
        where the order has fewer passes.
    """
    count, known = likely.shape[:2]
    macros = torch.cat([likely, torch.zeros(count, _PASSES, 3, dtype=torch.int64)], dim=1)
    prior = torch.full(macros.shape[:2], -math.inf)
    prior[:, :known] = math.log(_UNORDERED)
    for row, (sight, goal) in enumerate(zip(Sight.of(points), goals, strict=True)):
        ordered = [*islice(values.passes(goal, sight), _PASSES)]
        if ordered:
            passes = np.array([(bead, target, side > 0) for (bead, target, side), _ in ordered])
            seen = marked.rows([row]).frames.macros(passes, points.shape[1])
            macros[row, known : known + len(ordered)] = torch.from_numpy(seen)
            # no pass of the order may be worth less than one that the order doesn't have
            worth = torch.tensor([value for _, value in ordered]).clamp(min=_UNORDERED)
            prior[row, known : known + len(ordered)] = worth.log()
    return macros, prior


def load_clone(name: str | Path) -> ClonePolicy:
    """Load the policy of a learner's folder: a path, or the name of one that ships.

    Raises:
        InvalidFile: as in `load_network`, or it doesn't say whether the clone is guided.
    """

    def _make(tensors: dict[str, Tensor]) -> CloneNetwork:
        # sizes are those of the weights that are there, whatever the card says
        layers = len({name.split(".")[2] for name in tensors if name.startswith("body.layers.")})
        return CloneNetwork(len(tensors["codes.2.weight"]), layers)

    folder = policy_folder(name)
    network, _ = load_network(folder, CLONE, _make)
    config: Any = read_card(folder).get("config")
    guided = config.get("guided") if isinstance(config, dict) else None
    if not isinstance(guided, bool):
        raise InvalidFile(f"{folder / CARD} doesn't say whether the clone is guided")
    return ClonePolicy(network, guided)
