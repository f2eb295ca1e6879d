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

from knotgym.learn.reader import PIXEL, Reader, Seen, look
from knotgym.learn.rope_model import BEADS
from knotgym.rendering.picture import draw
from knotgym.streams import Stream, generator

Array = NDArray[np.float64]

_RATE = 2e-3
_HEIGHT = 0.02  # metres by which an error of height counts as one of a pixel, and a third of it
_GUESSES = 0.015  # metres that guesses are off, at most, about
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

    def __init__(self, frames: NDArray[np.float32], steps: int, batch: int, seed: int) -> None:
        """Begin on frames (n, BEADS, 3) with a fresh reader."""
        torch.set_num_threads(1)  # with more, sums are of another order
        self._frames, self._steps, self._batch, self._seed = frames, steps, batch, seed
        self.reader = Reader(seed=seed)
        self._optimizer = torch.optim.AdamW(self.reader.parameters(), lr=_RATE, weight_decay=1e-4)
        self.step, self.losses = 0, list[tuple[float, float]]()

    def advance(self) -> None:
        """One step."""
        for group in self._optimizer.param_groups:
            falling = 0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * self.step / self._steps))
            group["lr"] = _RATE * min(1.0, (self.step + 1) / 50) * falling
        rng = generator(Stream.LEARN_PICTURES, self._seed, self.step)
        seen, true, guesses = _drawn(self._frames, self._batch, rng)
        wanted = torch.from_numpy(true).float()
        readings, likely = self.reader.joined(seen)
        first, best = _loss_of_best(readings, likely, wanted)
        own = rng.random(self._batch) < 0.5
        guesses[own] = best.detach().double().numpy()[own]
        losses = first, _loss(self.reader.corrected(seen, guesses), wanted).mean()
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
    frames: NDArray[np.float32], count: int, rng: np.random.Generator
) -> tuple[list[Seen], Array, Array]:
    """Pictures, the vertices they show and guesses at them, (count, BEADS, 3)."""
    true = np.stack([_varied(frames[rng.integers(len(frames))], rng) for _ in range(count)])
    guesses = true + rng.uniform(0, _GUESSES, (count, 1, 1)) * _waves(count, rng)
    guesses -= guesses.mean(axis=1, keepdims=True)
    return [look(draw(points)) for points in true], true, guesses


def _varied(points: NDArray[np.float32], rng: np.random.Generator) -> Array:
    """One of the many states that a state is as good as, (BEADS, 3), its middle at the origin."""
    own = points.astype(np.float64)
    own -= own.mean(axis=0)
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    own[:, :2] = own[:, :2] @ turn
    own *= (rng.choice((-1.0, 1.0)), 1.0, rng.choice((-1.0, 1.0)))
    if rng.random() < 0.5:
        own = own[::-1]
    return np.roll(own, int(rng.integers(BEADS)), axis=0)


def _waves(count: int, rng: np.random.Generator) -> Array:
    """Smooth errors round the loop, of about 1, float64 (count, BEADS, 3)."""
    angle = 2 * np.pi * np.arange(BEADS) / BEADS
    numbers = np.arange(1, _WAVES + 1)[:, None, None]
    phase = rng.uniform(0, 2 * np.pi, (count, _WAVES, 1, 3))
    size = rng.normal(size=(count, _WAVES, 1, 3)) * math.sqrt(2 / _WAVES)
    waves: Array = (size * np.cos(numbers * angle[:, None] + phase)).sum(axis=1)
    return waves


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
