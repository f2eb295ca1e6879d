"""The reader: a picture of a rope to where its beads are, heights too.

Two networks over the beads, each fed with what the colours say (`colour_reading`). The first joins
the beads into an axis. Heights are seen only as far as chords look short, which way they go is not;
so it tells several readings, each with heights of its own, and how likely each is. The second
corrects a guess, be it a reading or what was foreseen before the picture was seen; so heights that
a picture doesn't show are carried on from before. Metres, z up, the rope's middle at the origin.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from knotgym.control.learned_policies import inference
from knotgym.learn.bead_network import BeadNetwork, grown
from knotgym.learn.colour_reading import BEADS, Pixels, decode, gathered, joined, settle, votes
from knotgym.rendering.picture import DEFAULT, bead_colours

Array = NDArray[np.float64]

INPUTS = 19
READINGS = 8  # of one picture, alike but for heights
PIXEL = 1 / DEFAULT.pixels_per_metre  # metres
_COLOURS = bead_colours(BEADS).astype(np.float64)
_GATE = 4.0  # pixels from a guess within which pixels count
_LEAST = 0.3  # weight of a bead that an axis goes through
_AXIS_SCALE, _OFF_SCALE, _HEIGHT_SCALE, _MOVE_SCALE = 32.0, 3.0, 0.05, 0.02
_OFF, _OFF_WAVES = 0.0012, 40  # metres that readings are off, and in how many waves
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
            grown(BeadNetwork(INPUTS, outputs, width, (1, 2, 4, 8, 1, 2, 4, 8)), 2 * seed + own)
            for own, outputs in enumerate((2 + 2 * READINGS, 3))
        )

    def joined(self, seen: list[Seen]) -> tuple[Tensor, Tensor]:
        """The first network's readings, float32 (n, READINGS, BEADS, 3), metres, and the logarithms
        of how likely they are, (n, READINGS).
        """
        axes = np.stack([first_axis(one.pixels) for one in seen])
        guesses = np.zeros((len(seen), BEADS, 3))
        guesses[..., :2] = PIXEL * 0.5 * (axes + np.roll(axes, 1, axis=1))
        out = self._told(self.join, seen, guesses, False)
        across = torch.from_numpy(guesses[..., :2]).float() + _OFF_SCALE * PIXEL * out[..., :2]
        heights = _HEIGHT_SCALE * out[..., 2 : 2 + READINGS].transpose(1, 2)
        both = across[:, None].expand(-1, READINGS, -1, -1)
        vertices = torch.cat([both, heights[..., None]], dim=3)
        likely = torch.log_softmax(out[..., 2 + READINGS :].mean(dim=1), dim=1)
        return vertices - vertices.mean(dim=2, keepdim=True), likely

    def corrected(self, seen: list[Seen], guesses: Array, moves: Array | None = None) -> Tensor:
        """The second network's vertices, float32 (n, BEADS, 3), metres.

        Args:
            seen: n pictures.
            guesses: at what they show, (n, BEADS, 3), metres.
            moves: how vertices should have moved to come there, (n, BEADS, 3); by where they came
                instead, more is known of their heights. 0 where a guess has no past.
        """
        out = self._told(self.correct, seen, guesses, True, moves)
        vertices = torch.from_numpy(guesses).float() + out * torch.tensor(
            [_OFF_SCALE * PIXEL, _OFF_SCALE * PIXEL, _HEIGHT_SCALE]
        )
        return vertices - vertices.mean(dim=1, keepdim=True)

    def read(self, picture: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Readings of a rope never seen before, float64 (READINGS, BEADS, 3), and how likely they
        are, (READINGS,), the likeliest first.
        """
        seen = look(picture)
        with inference(torch):
            vertices, likely = self.joined([seen])
        order = torch.argsort(-likely[0], stable=True)
        return self.follow(picture, vertices[0, order].double().numpy()), (
            likely[0, order].double().exp().numpy()
        )

    def follow(
        self, picture: NDArray[np.uint8], foreseen: Array, moves: Array | None = None
    ) -> Array:
        """Where a rope is that may lie as any of those foreseen, float64 (n, BEADS, 3).

        `moves` as in `corrected`.
        """
        seen = [look(picture)] * len(foreseen)
        with inference(torch):
            vertices = self.corrected(seen, foreseen, moves).double().numpy()
        _settle_all(vertices, picture)
        return vertices

    def varied(
        self, picture: NDArray[np.uint8], ropes: Array, count: int, rng: np.random.Generator
    ) -> Array:
        """Ropes that readings (n, BEADS, 3) of a picture may stand for, `count` for each, float64
        (n count, BEADS, 3): off by as much as readings are.
        """
        vertices = np.repeat(ropes, count, axis=0)
        vertices[..., :2] += _OFF * waves(len(vertices), _OFF_WAVES, rng)[..., :2]
        _settle_all(vertices, picture)
        return vertices

    def _told(
        self,
        network: BeadNetwork,
        seen: list[Seen],
        guesses: Array,
        heights: bool,
        moves: Array | None = None,
    ) -> Tensor:
        """What a network says of pictures and guesses at them, float32 (n, BEADS, outputs)."""
        told = np.stack([told_of(*pair, heights) for pair in zip(seen, guesses, strict=True)])
        if moves is not None:
            told[:, 15:18] = moves.transpose(0, 2, 1) / _MOVE_SCALE
            told[:, 18] = (moves != 0).any(axis=2)
        return network(torch.from_numpy(told)).transpose(1, 2)


def _settle_all(vertices: Array, picture: NDArray[np.uint8]) -> None:
    """Make ropes (n, BEADS, 3) cross as a picture shows it, in place."""
    for own in vertices:
        flat = np.column_stack([own[:, :2] / PIXEL, own[:, 2]])
        settle(own, votes(picture, flat, _COLOURS), _APART, _LIFTED)


def waves(count: int, most: int, rng: np.random.Generator) -> Array:
    """Smooth vectors round the loop, of about 1, in `most` waves, float64 (count, BEADS, 3)."""
    angle = 2 * np.pi * np.arange(BEADS) / BEADS
    numbers = np.arange(1, most + 1)[:, None, None]
    phase = rng.uniform(0, 2 * np.pi, (count, most, 1, 3))
    size = rng.normal(size=(count, most, 1, 3)) * np.sqrt(2 / most)
    summed: Array = (size * np.cos(numbers * angle[:, None] + phase)).sum(axis=1)
    return summed


def look(picture: NDArray[np.uint8]) -> Seen:
    """A picture made ready, uint8 (SIZE, SIZE, 3)."""
    return Seen(picture, decode(picture))


def first_axis(pixels: Pixels) -> Array:
    """Beads' middles by their colours alone, stragglers left out, float64 (BEADS, 2), pixels."""
    anywhere = np.full((BEADS, 2), np.nan)
    axis = joined(gathered(*pixels, anywhere, 1.0), _LEAST)
    for gate in (10.0, 5.0):
        smooth = 0.25 * (np.roll(axis, 1, 0) + 2 * axis + np.roll(axis, -1, 0))
        axis = joined(gathered(*pixels, smooth, gate), _LEAST)
    return axis


def told_of(seen: Seen, guess: Array, heights: bool) -> NDArray[np.float32]:
    """What a network is told of a picture and a guess (BEADS, 3): float32 (INPUTS, BEADS).

    The last four are for how the guess moved there.
    """
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
