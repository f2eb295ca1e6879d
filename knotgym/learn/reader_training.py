"""Training the reader: on pictures drawn as it goes from stored states, each turned, mirrored and
walked otherwise.

Each step's draws come from a generator of its own, so a training broken off and gone on with draws
what an unbroken one does.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from knotgym.common.streams import Stream, generator
from knotgym.learn.reader import PIXEL, Reader, look, waves
from knotgym.learn.rope_model import BEADS, MAX_FORCE, Dynamics
from knotgym.learn.training_data import TrainingData
from knotgym.rendering.picture import draw

Array = NDArray[np.float64]

_RATE = 2e-3
_HEIGHT = 0.02  # metres by which an error of height counts as one of a pixel, and a third of it
_GUESSES = np.array([0.0015, 0.0015, 0.02])  # metres that states are read wrong by, at most, about
_OWN = 0.3  # of the guesses, that are the reader's own readings
_SHARED = 0.05  # of the loss of a picture's readings, by all of them
_NAMING = 0.05  # how much naming the best reading counts, beside reading
_WAVES = 12  # round the loop, of the errors of guesses


class ReaderTraining:
    """A reader, and how far its training has come.

    Attributes:
        reader: trained so far.
        step: steps done.
        losses: of each step, of its two networks.
    """

    def __init__(
        self, data: TrainingData, dynamics: Dynamics, steps: int, batch: int, seed: int
    ) -> None:
        """Begin with a fresh reader; `dynamics` foresees what it shall correct."""
        torch.set_num_threads(1)  # with more, sums are of another order
        self._data, self._dynamics = data, dynamics
        self._steps, self._batch, self._seed = steps, batch, seed
        self.reader = Reader(seed=seed)
        self._optimizer = torch.optim.AdamW(self.reader.parameters(), lr=_RATE, weight_decay=1e-4)
        self.step, self.losses = 0, list[tuple[float, float]]()

    def advance(self) -> None:
        """One step."""
        for group in self._optimizer.param_groups:
            falling = 0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * self.step / self._steps))
            group["lr"] = _RATE * min(1.0, (self.step + 1) / 50) * falling
        rng = generator(Stream.LEARN_PICTURES, self._seed, self.step)
        true, guesses, moves = _drawn(self._data, self._dynamics, self._batch, rng)
        seen = [look(draw(points)) for points in true]
        wanted = torch.from_numpy(true).float()
        readings, likely = self.reader.joined(seen)
        first, best = _loss_of_best(readings, likely, wanted)
        own = rng.random(self._batch) < _OWN
        guesses[own], moves[own] = best.detach().double().numpy()[own], 0.0
        losses = first, _loss(self.reader.corrected(seen, guesses, moves), wanted).mean()
        self._optimizer.zero_grad()
        (losses[0] + losses[1]).backward()
        torch.nn.utils.clip_grad_norm_(self.reader.parameters(), 1.0)
        self._optimizer.step()
        self.losses.append((losses[0].item(), losses[1].item()))
        self.step += 1

    def state(self) -> dict[str, Tensor]:
        """All that it takes to go on."""
        tensors = {f"reader.{name}": own for name, own in self.reader.state_dict().items()}
        for number, moments in self._optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{number}.{name}": own for name, own in moments.items()}
        tensors["losses"] = torch.tensor(self.losses, dtype=torch.float64).reshape(-1, 2)
        return tensors

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from `state`."""
        self.reader.load_state_dict(
            {
                name.removeprefix("reader."): own
                for name, own in tensors.items()
                if name.startswith("reader.")
            }
        )
        moments: dict[int, dict[str, Tensor]] = {}
        for name, own in tensors.items():
            if name.startswith("optimizer."):
                _, number, moment = name.split(".")
                moments.setdefault(int(number), {})[moment] = own
        self._optimizer.load_state_dict({**self._optimizer.state_dict(), "state": moments})
        self.losses = [(first, second) for first, second in tensors["losses"].tolist()]
        self.step = len(self.losses)


def _drawn(
    data: TrainingData, dynamics: Dynamics, count: int, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Vertices to be read, guesses at them, and how those moved there, (count, BEADS, 3) each.

    A guess is what is foreseen of an action, from a state that was itself read a little wrong.
    Where an episode begins, it is the state, read a little wrong, and nothing moved.
    """
    rows = rng.integers(len(data.frames), size=count)
    beads, forces = data.beads[rows], data.forces[rows] / MAX_FORCE
    begins = beads < 0
    true = data.frames[rows].astype(np.float64)
    before = data.frames[rows - ~begins].astype(np.float64)
    speeds = _speeds(data, dynamics, rows - ~begins)
    before += rng.uniform(0, 1, (count, 1, 1)) * _GUESSES * waves(count, _WAVES, rng)
    after, _ = dynamics.step(before, speeds, np.maximum(beads, 0), forces)
    after[begins] = before[begins]
    moves = after - before
    for own in (true, after):
        own -= own.mean(axis=1, keepdims=True)
    both = [_varied(np.stack(own, axis=1), rng) for own in zip(true, after, moves, strict=True)]
    true, after, moves = np.stack(both).transpose(2, 0, 1, 3)
    return true, np.ascontiguousarray(after), np.ascontiguousarray(moves)


def _speeds(data: TrainingData, dynamics: Dynamics, rows: NDArray[np.int64]) -> Array:
    """How fast vertices moved in states, by what was done before, (n, BEADS, 3), m/s."""
    beads, forces = data.beads[rows], data.forces[rows] / MAX_FORCE
    begins = beads < 0
    before = data.frames[rows - ~begins].astype(np.float64)
    _, speeds = dynamics.step(before, np.zeros_like(before), np.maximum(beads, 0), forces)
    speeds[begins] = 0.0
    return speeds


def _varied(vectors: Array, rng: np.random.Generator) -> Array:
    """Vectors (BEADS, k, 3) of one rope, turned, mirrored and walked otherwise, all alike."""
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    own = vectors.copy()
    own[..., :2] = own[..., :2] @ turn
    own *= (rng.choice((-1.0, 1.0)), 1.0, rng.choice((-1.0, 1.0)))
    if rng.random() < 0.5:
        own = own[::-1]
    return np.roll(own, int(rng.integers(BEADS)), axis=0)


def _loss_of_best(readings: Tensor, likely: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """The loss of the reading that is best, and how likely it was said to be; and that reading.

    The others share a little of it, lest one that is never best stays bad.
    """
    each = _loss(readings, true[:, None])
    best = each.detach().argmin(dim=1)
    rows = torch.arange(len(best))
    least = (1 - _SHARED) * each[rows, best] + _SHARED * each.mean(dim=1)
    return (least - _NAMING * likely[rows, best]).mean(), readings[rows, best]


def _loss(read: Tensor, true: Tensor) -> Tensor:
    """Of vertices (..., BEADS, 3), (...)."""
    off = read - true
    across, height = off[..., :2] / PIXEL, off[..., 2] / _HEIGHT
    return functional.smooth_l1_loss(
        across, torch.zeros_like(across), beta=0.5, reduction="none"
    ).mean(dim=(-2, -1)) + 0.3 * functional.smooth_l1_loss(
        height, torch.zeros_like(height), reduction="none"
    ).mean(dim=-1)
