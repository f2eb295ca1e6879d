"""Train the reader on pictures rendered on the fly from stored states, with augmentation.

After a change run `pytest tests/learn/test_training.py`: an interrupted training must end with the
same weights.
"""

import math
from collections.abc import Sequence
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from knotgym.common import Array, Stream
from knotgym.datasets import EpisodeDataset
from knotgym.learn.colour_reading import BEADS
from knotgym.learn.reader import PIXEL, Reader, look, waves
from knotgym.learn.shape_hypotheses import imagine
from knotgym.learn.train_config import ReaderConfig
from knotgym.learn.training import Trained, Training
from knotgym.learn.training_data import TrainingData
from knotgym.learn.trials import Trials
from knotgym.rendering import draw
from knotgym.rope import ChainSimulation
from knotgym.runs import Recipe

# Chosen without comparison. Readers that exist don't depend on them; one trained after a change
# must read as docs/perception.md says.
_RATE, _DECAY = 2e-3, 1e-4  # peak learning rate; weight decay
_HEIGHT = 0.02  # height error that counts like a pixel in x or y before weighting by 0.3, metres
# Largest standard deviation of the errors put on states before the engine predicts from them:
# x, y, z, metres; and the highest number of waves of those errors round the loop.
_GUESS_NOISE, _WAVES = np.array([0.0015, 0.0015, 0.02]), 12
_OWN = 0.3  # share of guesses that are the reader's own readings, not predictions
_SHARED = 0.05  # share of the readings' loss that is the mean over all readings, not the best one
_CHOICE = 0.05  # weight of the log-probability of the best reading


class ReaderTraining(Training):
    """A reader in training; `losses` are those of its two networks at each step."""

    NAME, LOSSES = "reader", ("join", "correct")
    network: Reader

    @classmethod
    def begun(
        cls, datasets: Sequence[EpisodeDataset], config: ReaderConfig, trials: Trials
    ) -> Recipe[Self]:
        """Begin a training on the states of datasets."""
        yield []  # a recipe yields calls at least once; this one has none to make
        return cls(TrainingData.of([dataset.episodes for dataset in datasets]), config)

    def __init__(self, data: TrainingData, config: ReaderConfig) -> None:
        """Create a reader."""
        super().__init__(Reader(seed=config.seed), _RATE, _DECAY, config.steps)
        self._data, self._config, self._chain = data, config, ChainSimulation(config.batch)

    def _advance(self) -> None:
        """Take one optimizer step."""
        count = self._config.batch
        rng = Stream.LEARN_PICTURES.generator(self._config.seed, self.step)
        true, guesses, moves = _drawn(self._data, self._chain, count, rng)
        seen = [look(draw(points)) for points in true]
        wanted = torch.from_numpy(true).float()
        readings, log_probabilities = self.network.joined(seen)
        first, best = _best_reading_loss(readings, log_probabilities, wanted)
        # `correct` must also refine readings, as it does for the first picture of an episode
        read = rng.random(count) < _OWN
        guesses[read], moves[read] = best.detach().double().numpy()[read], 0.0
        second = _loss(self.network.corrected(seen, guesses, moves), wanted).mean()
        self._minimize(first + second)
        self.losses.append((self.step, first.item(), second.item(), math.nan))

    def _ended(self) -> Trained:
        """Return the reader and start positions of ropes, drawn from those of the data."""
        data, config = self._data, self._config
        drawn = Stream.LEARN_PLACES.generator(config.seed).permutation(len(data.starts))
        # drawn without replacement, in the order of the data
        rows = data.starts[np.sort(drawn[: config.positions])]
        places = torch.from_numpy(data.frames[rows].mean(axis=1, dtype=np.float32))
        facts = {"episodes": len(data.starts), "frames": len(data.frames)}
        summary = f"{config.steps} steps"
        return Trained(self.network.eval(), facts, summary, others={"places": places})


def _drawn(
    data: TrainingData, chain: ChainSimulation, count: int, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Draw true vertices, guesses and the guesses' moves, float64 (count, BEADS, 3) each.

    A guess is the chain engine's prediction of an action's effect from a perturbed state, as
    during an episode. For the first state of an episode it is the perturbed state, and its moves
    are 0.
    """
    rows = rng.integers(len(data.frames), size=count)
    beads, forces = data.beads[rows], data.forces[rows].astype(np.float64)
    begins = beads < 0
    true = data.frames[rows].astype(np.float64)
    # rows - 1 is the state before, except where an episode begins
    before = data.frames[rows - ~begins].astype(np.float64)
    velocities = _velocities(data, chain, rows - ~begins)
    before += rng.uniform(0, 1, (count, 1, 1)) * _GUESS_NOISE * waves(count, _WAVES, rng)
    after, _ = imagine(chain, before, velocities, np.maximum(beads, 0), forces)
    after[begins] = before[begins]
    moves = after - before
    # positions relative to the rope's middle, as a camera that follows it shows them
    for vertices in (true, after):
        vertices -= vertices.mean(axis=1, keepdims=True)
    # augment the three of one example alike: stacked as (BEADS, 3 kinds, 3)
    both = [
        _augmented(np.stack(vectors, axis=1), rng)
        for vectors in zip(true, after, moves, strict=True)
    ]
    true, after, moves = np.stack(both).transpose(2, 0, 1, 3)
    return true, np.ascontiguousarray(after), np.ascontiguousarray(moves)


def _velocities(data: TrainingData, chain: ChainSimulation, rows: NDArray[np.int64]) -> Array:
    """Estimate the velocities of states, float64 (n, BEADS, 3), m/s.

    Datasets hold no velocities: the engine repeats the action before, from rest.
    """
    beads, forces = data.beads[rows], data.forces[rows].astype(np.float64)
    begins = beads < 0
    before = data.frames[rows - ~begins].astype(np.float64)
    rest = np.zeros_like(before)
    _, velocities = imagine(chain, before, rest, np.maximum(beads, 0), forces)
    velocities[begins] = 0.0
    return velocities


def _augmented(vectors: Array, rng: np.random.Generator) -> Array:
    """Rotate vectors (BEADS, k, 3) of one rope about z, mirror them, and renumber the beads."""
    # mirroring y is the same as mirroring x and turning by pi, so only x and z are mirrored
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    turned = vectors.copy()
    turned[..., :2] = turned[..., :2] @ turn
    turned *= (rng.choice((-1.0, 1.0)), 1.0, rng.choice((-1.0, 1.0)))
    # walk the rope backwards, and start at another bead
    if rng.random() < 0.5:
        turned = turned[::-1]
    return np.roll(turned, int(rng.integers(BEADS)), axis=0)


def _best_reading_loss(
    readings: Tensor, log_probabilities: Tensor, true: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the winner-takes-all loss of several readings, and the best reading.

    All readings share a little of the loss, so that one that never wins still improves. The
    probabilities are trained to name the winner.
    """
    each = _loss(readings, true[:, None])
    best = each.detach().argmin(dim=1)
    rows = torch.arange(len(best))
    least = (1 - _SHARED) * each[rows, best] + _SHARED * each.mean(dim=1)
    return (least - _CHOICE * log_probabilities[rows, best]).mean(), readings[rows, best]


def _loss(read: Tensor, true: Tensor) -> Tensor:
    """Return the loss of vertices (..., BEADS, 3), averaged over beads: shape (...)."""
    # Huber losses: of x and y in pixels, quadratic up to 0.5, and of heights in units of _HEIGHT,
    # quadratic up to 1 and weighted by 0.3
    off = read - true
    across, height = off[..., :2] / PIXEL, off[..., 2] / _HEIGHT
    return functional.smooth_l1_loss(
        across, torch.zeros_like(across), beta=0.5, reduction="none"
    ).mean(dim=(-2, -1)) + 0.3 * functional.smooth_l1_loss(
        height, torch.zeros_like(height), reduction="none"
    ).mean(dim=-1)
