"""The reader: a picture of a rope to where its beads are, heights too.

Two networks over the beads, each fed with what the colours say (`colour_reading`). The first joins
the beads into an axis. The second corrects a guess, be it the first one's or what was foreseen
before the picture was seen; so heights that a picture doesn't show are carried on from before.
Metres, z up, the rope's middle at the origin.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from knotgym.learn.bead_network import BeadNetwork, grown
from knotgym.learn.colour_reading import BEADS, Pixels, decode, gathered, joined, settle, votes
from knotgym.rendering.picture import DEFAULT, bead_colours

Array = NDArray[np.float64]

INPUTS = 15
PIXEL = 1 / DEFAULT.pixels_per_metre  # metres
_COLOURS = bead_colours(BEADS).astype(np.float64)
_GATE = 4.0  # pixels from a guess within which pixels count
_LEAST = 0.3  # weight of a bead that an axis goes through
_AXIS_SCALE, _OFF_SCALE, _HEIGHT_SCALE = 32.0, 3.0, 0.05
_APART = 0.009  # metres between strands that cross, at least
_LIFTED = 5  # beads to either side that are lifted along
_CHORD = 1.33 / BEADS / PIXEL  # pixels


class Seen(NamedTuple):
    """A picture and its bright pixels."""

    picture: NDArray[np.uint8]
    pixels: Pixels


class Reader(nn.Module):
    """The two networks."""

    def __init__(self, width: int = 48, seed: int = 0) -> None:
        """Fresh networks, the same for the same seed."""
        super().__init__()
        self.join, self.correct = (
            grown(BeadNetwork(INPUTS, 3, width, (1, 2, 4, 8, 1, 2, 4, 8)), 2 * seed + own)
            for own in range(2)
        )

    def joined(self, seen: list[Seen]) -> Tensor:
        """The first network's vertices, float32 (n, BEADS, 3), metres."""
        axes = np.stack([first_axis(one.pixels) for one in seen])
        guesses = np.zeros((len(seen), BEADS, 3))
        guesses[..., :2] = PIXEL * 0.5 * (axes + np.roll(axes, 1, axis=1))
        return self._applied(self.join, seen, guesses, False)

    def corrected(self, seen: list[Seen], guesses: Array) -> Tensor:
        """The second network's, from guesses (n, BEADS, 3), metres."""
        return self._applied(self.correct, seen, guesses, True)

    def read(self, pictures: NDArray[np.uint8]) -> Array:
        """Vertices of ropes never seen before, float64 (n, BEADS, 3)."""
        seen = [look(picture) for picture in pictures]
        with torch.no_grad():
            first = self.joined(seen).double().numpy()
            return _settled(self.corrected(seen, first).double().numpy(), seen)

    def follow(self, pictures: NDArray[np.uint8], foreseen: Array) -> Array:
        """The same of ropes that should lie as foreseen, float64 (n, BEADS, 3)."""
        seen = [look(picture) for picture in pictures]
        with torch.no_grad():
            return _settled(self.corrected(seen, foreseen).double().numpy(), seen)

    def _applied(
        self, network: BeadNetwork, seen: list[Seen], guesses: Array, heights: bool
    ) -> Tensor:
        told = np.stack([told_of(*pair, heights) for pair in zip(seen, guesses, strict=True)])
        out = network(torch.from_numpy(told)).transpose(1, 2)
        vertices = torch.from_numpy(guesses).float() + out * torch.tensor(
            [_OFF_SCALE * PIXEL, _OFF_SCALE * PIXEL, _HEIGHT_SCALE]
        )
        return vertices - vertices.mean(dim=1, keepdim=True)


def look(picture: NDArray[np.uint8]) -> Seen:
    """A picture made ready, uint8 (SIZE, SIZE, 3)."""
    return Seen(picture, decode(picture))


def _settled(vertices: Array, seen: list[Seen]) -> Array:
    for own, one in zip(vertices, seen, strict=True):
        flat = np.column_stack([own[:, :2] / PIXEL, own[:, 2]])
        settle(own, votes(one.picture, flat, _COLOURS), _APART, _LIFTED)
    return vertices


def first_axis(pixels: Pixels) -> Array:
    """Beads' middles by their colours alone, stragglers left out, float64 (BEADS, 2), pixels."""
    anywhere = np.full((BEADS, 2), np.nan)
    axis = joined(gathered(*pixels, anywhere, 1.0), _LEAST)
    for gate in (10.0, 5.0):
        smooth = 0.25 * (np.roll(axis, 1, 0) + 2 * axis + np.roll(axis, -1, 0))
        axis = joined(gathered(*pixels, smooth, gate), _LEAST)
    return axis


def told_of(seen: Seen, guess: Array, heights: bool) -> NDArray[np.float32]:
    """What a network is told of a picture and a guess (BEADS, 3): float32 (INPUTS, BEADS)."""
    axis = guess[:, :2] / PIXEL
    middles = 0.5 * (axis + np.roll(axis, -1, axis=0))
    sums = gathered(*seen.pixels, middles, _GATE)
    there = sums[:, 0] > 1e-3
    told = np.zeros((INPUTS, BEADS), dtype=np.float32)
    told[0:2] = axis.T / _AXIS_SCALE
    told[2:4] = (there[:, None] * (sums[:, 1:3] - middles)).T / _OFF_SCALE
    told[4] = np.log1p(sums[:, 0])
    told[5] = there
    told[6:9] = sums[:, 3:6].T / 4.0
    step = np.roll(axis, -1, axis=0) - axis
    told[9] = np.sqrt(np.maximum(0.0, 1 - (step**2).sum(axis=1) / _CHORD**2))
    for first, second, sure in votes(seen.picture, np.column_stack([axis, guess[:, 2]]), _COLOURS):
        one, other = int(first) % BEADS, int(second) % BEADS
        told[10, one] += sure
        told[10, other] -= sure
        gap = (guess[one, 2] - guess[other, 2]) / _HEIGHT_SCALE
        told[11, one] += gap
        told[11, other] -= gap
    told[12] = guess[:, 2] / _HEIGHT_SCALE
    told[13] = heights
    told[14, 0] = 1.0
    return told
