"""The clone as a policy: it looks when its last macro-action is over, and chooses the next one.

A guided clone chooses among the macro-actions that its network finds likely and the first passes of
the demonstrator's order, by what they are worth in that order, too. Nothing is simulated.

In an environment of the action view "macro" or "bead" it returns its choices; in one of pulls, it
carries them out itself. It sees the rope and the goal's code from vertices; if the observation is
"pixels" it sees nothing but the pictures, as the reader of `shape_hypotheses` reads them.
"""

import math
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from knotgym.common.errors import InvalidFile, InvalidPolicy, one_line
from knotgym.control.demonstrator import passes_in_order
from knotgym.control.learned_policies import inference
from knotgym.control.pass_counts import DiagramValues, shipped_values
from knotgym.control.policy import Choice, UnplannedPolicy
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.marked import Marked, mark
from knotgym.envs.tasks import TaskConfig
from knotgym.learn.checkpoint import (
    CARD,
    PRETRAINED,
    WEIGHTS,
    load_policy,
    read_card,
    read_weights,
    write_checkpoint,
)
from knotgym.learn.clone_network import WORKING, CloneNetwork, inputs
from knotgym.learn.imagination import BEADS
from knotgym.learn.picture_policy import require_readable
from knotgym.learn.shape_hypotheses import HypothesesConfig, ShapeHypotheses
from knotgym.rope.action_views import ActionView
from knotgym.rope.actions import chosen_forces, force_choices
from knotgym.rope.chain.chain_simulation import ChainSimulation
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode

Array = NDArray[np.float64]

CLONE = "clone"
_VIEWS = {"macro": ("macro", "pull"), "bead": ("bead", "pull")}  # what each head can act in
# Temperature after a macro-action that changed no code: the likeliest one would be chosen again.
_ESCAPE = 0.7
_GUIDED = 0.25  # weight of the chance of being chosen, where the order of the passes counts too
_PASSES = 40  # of the order, at most
_UNORDERED = 0.02  # what a macro-action is worth that the order doesn't have


class ClonePolicy(UnplannedPolicy):
    """Chooses macro-actions, or pulls, as its network finds likeliest.

    Attributes:
        network: in evaluation mode.
    """

    def __init__(
        self, network: CloneNetwork, action: str, guided: bool, temperature: float = 0.0
    ) -> None:
        """Take a network, which head acts ("macro" or "bead"), and whether macros are guided."""
        super().__init__(CLONE)
        self.network, self._action, self._temperature = network, action, temperature
        self._guided = guided
        self._view: ActionView | None = None
        self._codes: dict[int, GaussCode | None] = {}  # at the last choice
        self._eyes: dict[int, _Eyes] = {}

    def suited(self, task: TaskConfig) -> TaskConfig:
        if task.action not in _VIEWS[self._action]:
            raise InvalidPolicy(
                f"policy {CLONE} chooses by its {self._action} head, so it needs action"
                f" {' or '.join(map(repr, _VIEWS[self._action]))}, got {task.action!r}"
            )
        if task.beads != BEADS:
            raise InvalidPolicy(f"policy {CLONE} needs a rope of {BEADS} beads, got {task.beads}")
        if task.observation != "pixels":
            return replace(task, observation="state")
        # a picture shows where to pull, but not where in the world that is
        require_readable(task, CLONE, self._action)
        return task

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        super().begin(episodes, index, rng)
        if self._view is None or len(self._view.busy) != episodes.count:
            self._view = ActionView("macro", episodes.simulation)
        self._view.reset(np.array([index]))
        self._codes[index] = None
        if episodes.config.observation == "pixels":
            self._eyes[index] = _Eyes(rng)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        own = episodes.config.action == "pull"
        if not own or self._action == "bead":
            chosen = self._choose(episodes, ids)
            actions: NDArray[Any] = chosen
            if own:
                forces = chosen_forces(chosen[:, 1:]) * episodes.simulation.max_force
                actions = episodes.simulation.actions(chosen[:, 0], forces, ids)
            return Choice(actions, [self._action] * len(ids))
        view = self._view
        assert view is not None
        pulled = ids[view.busy[ids]]
        view.pulled(pulled, np.zeros(len(pulled), dtype=bool))
        deciding = ids[~view.busy[ids]]
        if len(deciding):
            view.begin(self._choose(episodes, deciding), deciding)
        macros = np.column_stack([view.pulls[ids] == 0, view.macros[ids]])
        return Choice(view.next_pulls(ids).astype(np.float32), ["macro"] * len(ids), macros)

    def _choose(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return actions of the view "macro", (n, 3), or "bead", (n, 4)."""
        indices = ids.tolist()
        if self._eyes:
            seen = [self._eyes[index].look(episodes.picture(index)) for index in indices]
            points, goals = np.stack([rope for rope, _ in seen]), [goal for _, goal in seen]
            codes = [label(rope) for rope in points]
        else:
            points, goals = episodes.simulation.points[ids], [episodes.goals[i] for i in indices]
            codes = [episodes.codes[index] for index in indices]
        stuck = [code == self._codes[i] for i, code in zip(indices, codes, strict=True)]
        self._codes |= dict(zip(indices, codes, strict=True))
        rngs = [self._rngs[index] for index in indices]
        if self._action == "bead":
            return choose_pulls(self.network, points, goals)
        heat = np.where(stuck, max(_ESCAPE, self._temperature), self._temperature)
        values = shipped_values(episodes.config.split, every_code=True) if self._guided else None
        return choose_macros(self.network, points, goals, heat, rngs, values)


class _Eyes:
    """Reads the pictures of one episode."""

    def __init__(self, rng: np.random.Generator) -> None:
        learned = load_policy(PRETRAINED)
        starts, config = learned.starts.astype(np.float64), HypothesesConfig()
        chain = ChainSimulation(config.imagined)
        self._hypotheses = ShapeHypotheses(learned.reader, chain, starts, config, rng)
        self._goals: dict[GaussCode, float] = {}

    def look(self, picture: NDArray[np.uint8]) -> tuple[Array, GaussCode]:
        """Return the likeliest vertices of the rope, float64 (beads, 3), and code of the goal."""
        size = picture.shape[0]
        if not self._goals:
            goal = np.ascontiguousarray(picture[:, size:])
            self._goals = self._hypotheses.read_codes(goal)
        self._hypotheses.start(np.ascontiguousarray(picture[:, :size]))
        rope = self._hypotheses.ropes[0]
        # the goal isn't shown yet, or the episode would be over
        shown = label(rope)
        left = [code for code in self._goals if not code.matches(shown)] or list(self._goals)
        return rope, max(left, key=lambda code: self._goals[code])


def choose_macros(
    network: CloneNetwork,
    points: Array,
    goals: list[GaussCode],
    temperatures: Array,
    rngs: list[np.random.Generator],
    values: DiagramValues | None = None,
) -> NDArray[np.int64]:
    """Choose macro-actions of the view "macro", int64 (n, 3): bead, target, 0 under or 1 over.

    Args:
        network: in evaluation mode.
        points: float64 (n, beads, 3), metres.
        goals: n codes.
        temperatures: float64 (n,); 0 for the likeliest macro-action.
        rngs: source of each state's draws; used only at temperatures above 0.
        values: guides the choice; None for no guidance.
    """
    seen = mark(points, goals)
    with inference(torch):
        looked = network(inputs(seen))
        macros, prior, share = network.likely(looked), torch.zeros(1, 1), 1.0
        if values is not None:
            macros, prior = _with_passes(macros, values, points, goals, seen)
            share = _GUIDED
        chosen, works = network.rate(looked, macros)
        # the maximum of logits with Gumbel noise is a draw from their softmax
        noise = np.zeros(chosen.shape)
        for row in np.flatnonzero(temperatures > 0):
            noise[row] = temperatures[row] * rngs[row].gumbel(size=noise.shape[1])
        best = (prior + share * chosen + WORKING * works + torch.from_numpy(noise)).argmax(1)
        beads, targets, sides = macros[torch.arange(len(best)), best].numpy().T
    beads, targets = seen.frames.renumber(beads), seen.frames.renumber(targets)
    targets = (targets + (targets == beads)) % points.shape[1]  # a bead can't pass itself
    return np.stack([beads, targets, (seen.frames.sides(2 * sides - 1) + 1) // 2], axis=1)


def _with_passes(
    likely: Tensor, values: DiagramValues, points: Array, goals: list[GaussCode], marked: Marked
) -> tuple[Tensor, Tensor]:
    """Add the first passes of the demonstrator's order to macro-actions (n, k, 3).

    Args:
        likely: in the canonical frame.
        values, points, goals: as of `choose_macros`.
        marked: the same states.

    Returns:
        Macro-actions (n, k + _PASSES, 3), and the logarithms of what they are worth; -inf where the
        order has fewer passes.
    """
    count, known = likely.shape[:2]
    macros = torch.cat([likely, torch.zeros(count, _PASSES, 3, dtype=torch.int64)], dim=1)
    prior = torch.full(macros.shape[:2], -math.inf)
    prior[:, :known] = math.log(_UNORDERED)
    for row, (rope, goal) in enumerate(zip(points, goals, strict=True)):
        ordered = [*islice(passes_in_order(values, goal, rope), _PASSES)]
        if ordered:
            beads, targets, sides = np.array([move for move, _ in ordered]).T[:, :, None]
            own = marked.rows([row]).frames
            seen = own.renumber(beads), own.renumber(targets), (own.sides(sides) + 1) // 2
            macros[row, known : known + len(ordered)] = torch.from_numpy(np.hstack(seen))
            worth = torch.tensor([value for _, value in ordered]).clamp(min=_UNORDERED)
            prior[row, known : known + len(ordered)] = worth.log()
    return macros, prior


def choose_pulls(network: CloneNetwork, points: Array, goals: list[GaussCode]) -> NDArray[np.int64]:
    """Choose the likeliest pulls of the view "bead", int64 (n, 4): bead and three forces."""
    seen = mark(points, goals)
    with inference(torch):
        looked = network(inputs(seen))
        beads = looked.logits.argmax(1)
        bins = network.forces(looked, beads).argmax(2).numpy()
    forces = force_choices(seen.frames.world_vectors(chosen_forces(bins)))
    return np.concatenate([seen.frames.renumber(beads.numpy())[:, None], forces], axis=1)


def save_clone(folder: Path, network: CloneNetwork, made: dict[str, Any]) -> None:
    """Write a checkpoint folder; `made` adds to its card, and must hold `config`."""
    tensors = {name: own.detach().half().contiguous() for name, own in network.state_dict().items()}
    write_checkpoint(folder, tensors, {"learner": CLONE, **made})


def load_clone(folder: Path) -> ClonePolicy:
    """Load the policy of a checkpoint folder.

    Raises:
        InvalidFile: it is missing, of another version, changed or truncated.
    """
    config: Any = read_card(folder).get("config")
    tensors = read_weights(folder)
    try:
        network = CloneNetwork(int(config["width"]), int(config["layers"]))
        network.load_state_dict(tensors)
        action, guided = str(config["action"]), bool(config["guided"])
        _VIEWS[action]
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise InvalidFile(
            f"{folder / WEIGHTS} and {CARD} don't make a clone: {one_line(error)[:200]}"
        ) from error
    for name, values in network.state_dict().items():
        if not torch.isfinite(values).all():
            raise InvalidFile(f"{folder / WEIGHTS}: {name} has numbers that aren't finite")
    return ClonePolicy(network.eval(), action, guided)
