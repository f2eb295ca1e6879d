"""Train the clone on decisions; reproducible, and to be continued after an interruption.

Weights are averaged over steps, and of the averages the one with the lowest held-out loss is kept:
a few thousand decisions are learned by heart in minutes.

After a change run `pytest tests/learn`: an interrupted training must end with the
same weights.
"""

import math
from collections.abc import Sequence
from itertools import product
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from knotgym.common import InvalidInput, Stream
from knotgym.datasets import EpisodeDataset
from knotgym.learn.clone_network import CloneNetwork, inputs
from knotgym.learn.clone_policy import ClonePolicy
from knotgym.learn.train_config import CloneConfig
from knotgym.learn.training import Trained, Training
from knotgym.learn.training_data import TOGETHER, Examples, demonstrate
from knotgym.learn.trials import Trials
from knotgym.runs import Call, Recipe

# Settings once, and constants since none was worth more than chance (notes/experiments.md).
_DECAY = 0.05  # of the weights
_AVERAGE = 0.998  # decay of their average, per step
_HELD_OUT = 0.1  # share of the episodes
_TRIALS = 10  # of a training, about
_JUDGED = 2048  # held-out decisions on which weights are judged, at most


class CloneTraining(Training):
    """A clone in training.

    About ten times the averaged weights play the trials. Then, and every `save_every` steps, they
    are judged: `losses` are the mean training loss since the last time, and the held-out loss.
    Weights of multiples of `save_every` steps may be kept.
    """

    NAME, LOSSES = "clone", ("training", "held_out")
    network: CloneNetwork

    @classmethod
    def begun(
        cls, datasets: Sequence[EpisodeDataset], config: CloneConfig, trials: Trials
    ) -> Recipe[Self]:
        """Begin a training on the passes of datasets, and on those of searches."""
        parts, count = list[Examples](), 0
        for dataset in datasets:
            if "macro_start" not in dataset.episodes.steps:
                raise InvalidInput(
                    f"{dataset.name} doesn't say which macro-actions its policy chose, so the clone"
                    " can't learn them; use a set of expert or noisy"
                )
            parts.append(Examples.of(dataset.episodes, count))
            count += dataset.episodes.episodes.rows
        calls = list[Call]()
        for task, nx in product(config.task, config.nx):
            for first in range(0, config.demonstrations, TOGETHER):
                few = min(TOGETHER, config.demonstrations - first)
                name = f"demonstrations of {task} {nx} {first}"
                calls.append(Call(name, demonstrate, (config, task, nx, first), few))
        for made in (Examples(**columns) for columns in (yield calls)):
            # searches are numbered from 0 for each task and nx
            # unique over all parts: held-out episodes are drawn by their numbers
            parts.append(made._replace(episodes=made.episodes % TOGETHER + count))
            count += TOGETHER
        data = Examples(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        if not data.worked.any():
            raise InvalidInput("no episode reached its goal, so there is nothing to imitate")
        return cls(config, data, trials)

    def __init__(self, config: CloneConfig, data: Examples, trials: Trials) -> None:
        """Begin a training on examples."""
        torch.manual_seed(config.seed)
        network = CloneNetwork(config.width, config.layers).to(config.device)
        super().__init__(network, config.rate, _DECAY, config.steps)
        self._config, self._trials = config, trials
        held, self._apart = (_held_out(data.episodes, config.seed), -(-config.steps // _TRIALS))
        aside, fitted = np.flatnonzero(held), np.flatnonzero(~held)
        self._fitted = _tensors(data, fitted, config.device)
        # evenly spread over the held-out decisions, so that every episode counts
        judged = aside[:: len(aside) // _JUDGED + 1]
        self._aside = _tensors(data, judged, config.device)
        self._average, self._best = (_copied(network.state_dict()) for _ in range(2))
        self._least = torch.full((1,), math.inf, dtype=torch.float64)
        self._facts = {
            "episodes": len(np.unique(data.episodes)),
            "decisions": int(data.worked.sum()),
            "decisions_not_imitated": int((~data.worked).sum()),
        }

    def _parts(self) -> dict[str, dict[str, Tensor]]:
        """Return the tensors to keep beside the optimizer's."""
        more = {"average": self._average, "best": self._best, "judged": {"least": self._least}}
        return {**super()._parts(), **more}

    def _advance(self) -> None:
        """Train up to the next row of the learning curve; then judge the averaged weights."""
        config, losses = self._config, list[Tensor]()
        self.network.train()
        ahead = (n - self.step % n for n in (config.save_every, self._apart))
        for _ in range(min(config.steps - self.step, *ahead)):
            # a stream for each step, so that a resumed training draws what it would have drawn
            rng = Stream.LEARN_CLONE.generator(config.seed, self.step)
            rows = rng.integers(len(self._fitted[-1]), size=config.batch)
            drawn = torch.from_numpy(rows).to(config.device)
            loss = _loss(self.network, [column[drawn] for column in self._fitted])
            self._minimize(loss)
            losses.append(loss.detach())
            # the average forgets the first steps faster
            decay = min(_AVERAGE, self.step / (self.step + 20))
            with torch.no_grad():
                for name, tensor in self.network.state_dict().items():
                    self._average[name].mul_(decay).add_(tensor, alpha=1 - decay)
        judged = losses[-1].item()
        if len(self._aside[-1]):
            with torch.no_grad():
                judged = _loss(self._made(self._average), self._aside).item()
        # early stopping without stopping: the weights are kept, the training goes on
        if self._is_due(self.step) and judged < self._least.item():
            self._least.fill_(judged)
            self._best = _copied(self._average)
        mean, success = torch.stack(losses).mean().item(), math.nan
        due = self.step % self._apart == 0 or self.step == config.steps
        if config.trials and due:
            policy = ClonePolicy(self._made(self._average).cpu(), config.guided)
            success = self._trials.success(policy)
        self.losses.append((self.step, mean, judged, success))

    def _ended(self) -> Trained:
        """Return the network with the averaged weights of least held-out loss."""
        rows = (row for row in self.losses if self._is_due(row[0]))
        step, _, loss, _ = min(rows, key=lambda row: row[2])
        kept, steps = int(step), self._config.steps
        early = "; later steps fit only the training episodes" if kept < steps else ""
        summary = f"kept step {kept} of {steps}, held-out loss {loss:.2f}{early}"
        facts = {"kept_step": kept, "held_out_loss": loss, **self._facts}
        return Trained(self._made(self._best).cpu(), facts, summary, kept)

    def _is_due(self, step: float) -> bool:
        """Return whether the weights of a step may be kept."""
        return step % self._config.save_every == 0 or step == self._config.steps

    def _made(self, weights: dict[str, Tensor]) -> CloneNetwork:
        network = CloneNetwork(self._config.width, self._config.layers).to(self._config.device)
        network.load_state_dict(weights)
        return network.eval()


def _held_out(episodes: NDArray[np.int64], seed: int) -> NDArray[np.bool_]:
    """Draw which decisions are held out, by whole episodes: bool (n,)."""
    numbers = np.unique(episodes)
    rng = Stream.LEARN_HELD_OUT.generator(seed)
    return np.isin(episodes, rng.permutation(numbers)[: round(_HELD_OUT * len(numbers))])


def _tensors(data: Examples, rows: NDArray[np.int64], device: str) -> list[Tensor]:
    return [torch.from_numpy(column[rows]).to(device) for column in data[:6]]


def _loss(network: CloneNetwork, data: Sequence[Tensor]) -> Tensor:
    *seen, macros, worked = data
    return network.loss(inputs(seen), macros.long(), worked).sum(1).mean()


def _copied(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: weight.clone() for name, weight in weights.items()}
