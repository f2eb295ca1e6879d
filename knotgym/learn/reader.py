"""The reader: networks that turn a picture of a rope into bead positions, heights included.

Two bead networks work on what the colours tell (`colour_reading`).

- `join` reads a picture without any prior guess. A picture shows heights only by foreshortened
  chords, which leave their sign open, and by crossings. So the network returns several readings
  that share x and y, each with its own heights and a log-probability.
- `correct` refines a guess: a reading, or the engine's prediction from before the picture was
  taken. So heights that the picture doesn't show persist from earlier steps.

Positions are in metres, z up, the rope's middle at the origin.

After a change run what `shape_hypotheses` says; weights that ship must still load.
"""

from collections import OrderedDict
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from knotgym.common import Array
from knotgym.learn.colour_reading import (
    BEADS,
    SIZE,
    Pixels,
    bead_moments,
    crossing_votes,
    decode,
    enforce_votes,
    interpolated_axis,
)
from knotgym.photos import inference
from knotgym.rendering import PictureConfig, bead_colours

INPUTS = 19  # input channels of both networks, see `_network_inputs`
READINGS = 8  # of one picture, with the same x and y and different heights
PIXEL = 1 / PictureConfig().pixels_per_metre  # width of a pixel, metres
_COLOURS = bead_colours(BEADS).astype(np.float64)
# Chosen without comparison, as the scales below. The networks that ship were trained with them: a
# change needs the reader trained again (`knotgym train`).
_GATE = 4.0  # standard deviation of the distance of a bead's pixels from a guess, pixels
_LEAST = 0.3  # weight of a bead that the axis must pass through
# Scales that bring the networks' inputs and outputs to about 1: positions and offsets in pixels,
# heights and moves in metres.
_AXIS_SCALE, _OFF_SCALE, _HEIGHT_SCALE, _MOVE_SCALE = 32.0, 3.0, 0.05, 0.02
# Error of a reading's x and y that `perturb` imitates: size in metres, and waves round the loop.
_OFF, _OFF_WAVES = 0.0012, 40
_APART = 0.009  # height difference of strands that cross, at least, metres
_LIFTED = 5  # beads on either side of a crossing that are raised or lowered with it
_CHORD = 1.33 / BEADS / PIXEL  # distance of neighbouring vertices, pixels


class BeadNetwork(nn.Module):
    """A residual network from per-bead inputs to per-bead outputs, at half resolution inside."""

    def __init__(self, inputs: int, outputs: int, width: int, dilations: tuple[int, ...]) -> None:
        super().__init__()
        # names of modules are keys of stored weights, so a rename breaks checkpoints
        # kernel 6 and stride 2 need two beads of padding on either side to halve the beads exactly
        self.inward = nn.Conv1d(inputs, width, 6, 2, 2, padding_mode="circular")
        self.blocks = nn.ModuleList(
            nn.ModuleList([_circular(width, width, dilation), nn.Conv1d(width, width, 1)])
            for dilation in dilations
        )
        self.outward = nn.ConvTranspose1d(width, width // 2, 2, stride=2)
        # at full resolution, past the blocks
        self.beside = _circular(inputs, width // 2)
        self.last = _circular(width // 2, outputs)

    def forward(self, beads: Tensor) -> Tensor:
        """Map float32 (n, inputs, beads) to float32 (n, outputs, beads)."""
        x = self.inward(beads)
        for mix, after in self.blocks:
            x = x + after(functional.relu(mix(functional.relu(x))))
        # the skip connection `beside` brings back what halving the resolution lost
        y = self.outward(functional.relu(x)) + self.beside(beads)
        return self.last(functional.relu(y))


def _circular(inputs: int, outputs: int, dilation: int = 1) -> nn.Module:
    """Make a convolution of kernel 3 with circular padding, which keeps the number of beads."""
    padded = nn.Conv1d(inputs, outputs, 3, 1, dilation, dilation, padding_mode="circular")
    return nn.Sequential(OrderedDict(convolution=padded))  # the name is part of stored keys


def _initialize(network: BeadNetwork, seed: int) -> BeadNetwork:
    """Reset a network's weights in place from a seed, independently of torch's global generator."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in network.parameters():
        if parameter.dim() > 1:
            # variance 1 / (3 fan-in), that of torch's default initialization, but normal; biases 0
            fan = parameter[0].numel()
            with torch.no_grad():
                parameter.normal_(0.0, (1.0 / (3.0 * fan)) ** 0.5, generator=generator)
        else:
            nn.init.zeros_(parameter)
    return network


class Seen(NamedTuple):
    """A picture, uint8 (SIZE, SIZE, 3), and its decoded pixels."""

    picture: NDArray[np.uint8]
    pixels: Pixels


class Reader(nn.Module):
    """The two networks, and the readings that combine them with the crossings' colours."""

    def __init__(self, width: int = 48, seed: int = 0) -> None:
        """Create networks with fresh weights, which the seed determines."""
        super().__init__()
        # `join`: x and y, READINGS heights and READINGS logits; `correct`: x, y and height
        sizes = (2 + 2 * READINGS, 3)
        made = [BeadNetwork(INPUTS, outputs, width, 2 * (1, 2, 4, 8)) for outputs in sizes]
        self.join, self.correct = (
            _initialize(network, 2 * seed + k) for k, network in enumerate(made)
        )

    def signature(self) -> Tensor:
        """Return what both networks make of a ring in the rope's colours."""
        y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
        bead = (np.arctan2(y, x) / (2 * np.pi) * BEADS).astype(np.int64) % BEADS
        ring = np.abs(np.hypot(x, y) - 0.3 * SIZE) < 2
        seen = [look(np.where(ring[..., None], _COLOURS[bead], 0).astype(np.uint8))]
        vertices, log_probabilities = self.joined(seen)
        guess = vertices[:, 0].detach().double().numpy()
        corrected = self.corrected(seen, guess, 0.1 * guess)
        moved = corrected - vertices[:, 0]
        # metres, which are small, beside logarithms
        parts = 9 * vertices[0, :, ::30], 99 * moved[0, ::10], log_probabilities
        return torch.cat([part.flatten() for part in parts])

    def joined(self, seen: list[Seen]) -> tuple[Tensor, Tensor]:
        """Read n pictures by the first network.

        Returns:
            Readings, float32 (n, READINGS, BEADS, 3), metres, and log-probabilities, float32
            (n, READINGS).
        """
        axes = np.stack([_first_axis(reading.pixels) for reading in seen])
        guesses = np.zeros((len(seen), BEADS, 3))
        # colours locate the middles of beads; vertex i lies between beads i - 1 and i
        guesses[..., :2] = PIXEL * 0.5 * (axes + np.roll(axes, 1, axis=1))
        out = self._run(self.join, seen, guesses)
        across = torch.from_numpy(guesses[..., :2]).float() + _OFF_SCALE * PIXEL * out[..., :2]
        heights = _HEIGHT_SCALE * out[..., 2 : 2 + READINGS].transpose(1, 2)
        both = across[:, None].expand(-1, READINGS, -1, -1)
        vertices = torch.cat([both, heights[..., None]], dim=3)
        # one logit per reading: the mean over its beads
        log_probabilities = torch.log_softmax(out[..., 2 + READINGS :].mean(dim=1), dim=1)
        return vertices - vertices.mean(dim=2, keepdim=True), log_probabilities

    def corrected(self, seen: list[Seen], guesses: Array, moves: Array | None = None) -> Tensor:
        """Correct n guesses by the second network; return float32 (n, BEADS, 3), metres.

        Args:
            seen: n pictures.
            guesses: float64 (n, BEADS, 3), what each picture may show, metres.
            moves: float64 (n, BEADS, 3), by how much the engine moved the vertices to get
                there, metres; where the picture disagrees, heights can be inferred. 0 for a guess
                without a past.
        """
        out = self._run(self.correct, seen, guesses, moves)
        scales = torch.tensor([_OFF_SCALE * PIXEL, _OFF_SCALE * PIXEL, _HEIGHT_SCALE])
        vertices = torch.from_numpy(guesses).float() + out * scales
        return vertices - vertices.mean(dim=1, keepdim=True)

    def read(self, picture: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Read a rope that was not seen before.

        Returns:
            Readings, float64 (READINGS, BEADS, 3), metres, the most likely first, and their
            probabilities, float64 (READINGS,).
        """
        seen = look(picture)
        with inference():
            vertices, log_probabilities = self.joined([seen])
        order = torch.argsort(-log_probabilities[0], stable=True)
        return self.follow(picture, vertices[0, order].double().numpy()), (
            log_probabilities[0, order].double().exp().numpy()
        )

    def follow(
        self, picture: NDArray[np.uint8], predicted: Array, moves: Array | None = None
    ) -> Array:
        """Correct predictions (n, BEADS, 3) by a picture; `moves` as in `corrected`."""
        seen = [look(picture)] * len(predicted)
        with inference():
            vertices = self.corrected(seen, predicted, moves).double().numpy()
        _enforce_crossings(vertices, picture)
        return vertices

    def perturb(
        self, picture: NDArray[np.uint8], ropes: Array, count: int, rng: np.random.Generator
    ) -> Array:
        """Perturb readings of a picture by as much as readings err.

        Args:
            picture: uint8 (SIZE, SIZE, 3).
            ropes: float64 (n, BEADS, 3), readings of it, metres.
            count: copies of each.
            rng: draws the perturbations.

        Returns:
            float64 (n count, BEADS, 3), the copies of a reading one after the other.
        """
        vertices = np.repeat(ropes, count, axis=0)
        vertices[..., :2] += _OFF * waves(len(vertices), _OFF_WAVES, rng)[..., :2]
        _enforce_crossings(vertices, picture)
        return vertices

    def _run(
        self, network: BeadNetwork, seen: list[Seen], guesses: Array, moves: Array | None = None
    ) -> Tensor:
        """Run a network on pictures and guesses; return float32 (n, BEADS, outputs)."""
        heights = network is self.correct
        pairs = zip(seen, guesses, strict=True)
        inputs = np.stack([_network_inputs(*pair, heights) for pair in pairs])
        if moves is not None:
            inputs[:, 15:18] = moves.transpose(0, 2, 1) / _MOVE_SCALE
            inputs[:, 18] = (moves != 0).any(axis=2)
        return network(torch.from_numpy(inputs)).transpose(1, 2)


def _enforce_crossings(vertices: Array, picture: NDArray[np.uint8]) -> None:
    """Make ropes (n, BEADS, 3) cross as the picture's colours say, in place."""
    for rope in vertices:
        pixels = np.column_stack([rope[:, :2] / PIXEL, rope[:, 2]])
        enforce_votes(rope, crossing_votes(picture, pixels, _COLOURS), _APART, _LIFTED)


def waves(count: int, most: int, rng: np.random.Generator) -> Array:
    """Draw smooth random vector fields round the loop, with unit variance.

    Args:
        count: fields.
        most: highest number of waves round the loop; all from 1 on have equal variance.
        rng: draws phases and amplitudes.

    Returns:
        float64 (count, BEADS, 3).
    """
    angle = 2 * np.pi * np.arange(BEADS) / BEADS
    numbers = np.arange(1, most + 1)[:, None, None]
    phase = rng.uniform(0, 2 * np.pi, (count, most, 1, 3))
    # a cosine has variance 1/2, so each of `most` amplitudes has variance 2 / most
    size = rng.normal(size=(count, most, 1, 3)) * np.sqrt(2 / most)
    return (size * np.cos(numbers * angle[:, None] + phase)).sum(axis=1)


def look(picture: NDArray[np.uint8]) -> Seen:
    """Decode a picture, uint8 (SIZE, SIZE, 3)."""
    return Seen(picture, decode(picture))


def _first_axis(pixels: Pixels) -> Array:
    """Locate the middles of beads by colour alone, without outliers; float64 (BEADS, 2), pixels."""
    anywhere = np.full((BEADS, 2), np.nan)
    axis = interpolated_axis(bead_moments(*pixels, anywhere, 1.0), _LEAST)
    # Blends of other hues put stray pixels far from their bead. Twice, smooth the axis and gather
    # again with a narrower gate around it.
    for gate in (10.0, 5.0):
        smooth = 0.25 * (np.roll(axis, 1, 0) + 2 * axis + np.roll(axis, -1, 0))
        axis = interpolated_axis(bead_moments(*pixels, smooth, gate), _LEAST)
    return axis


def _network_inputs(seen: Seen, guess: Array, heights: bool) -> NDArray[np.float32]:
    """Compute the input channels of a network.

    Args:
        seen: a picture.
        guess: float64 (BEADS, 3), what it may show, metres.
        heights: whether the guess has heights.

    Returns:
        float32 (INPUTS, BEADS); channels 15 to 18, the guess's moves, are left 0.
    """
    axis = guess[:, :2] / PIXEL
    middles = 0.5 * (axis + np.roll(axis, -1, axis=0))
    moments = bead_moments(*seen.pixels, middles, _GATE)
    there = moments[:, 0] > 1e-3
    inputs = np.zeros((INPUTS, BEADS), dtype=np.float32)
    # 0-1   the guess; 2-3  offset of the bead's pixels from it; 4-5  how much of the bead is seen,
    # and whether; 6-8  the pixels' covariance
    inputs[0:2] = axis.T / _AXIS_SCALE
    inputs[2:4] = (there[:, None] * (moments[:, 1:3] - middles)).T / _OFF_SCALE
    inputs[4] = np.log1p(moments[:, 0])
    inputs[5] = there
    inputs[6:9] = moments[:, 3:6].T / 4.0
    # 9     slope of the chord, |dz| / length: all chords are equally long, so the shorter one
    # looks, the steeper it is; whether up or down doesn't show
    step = np.roll(axis, -1, axis=0) - axis
    inputs[9] = np.sqrt(np.maximum(0.0, 1 - (step**2).sum(axis=1) / _CHORD**2))
    # 10-11 at the two beads of a crossing: the vote of the colours, and the height difference of
    # the guess
    votes = crossing_votes(seen.picture, np.column_stack([axis, guess[:, 2]]), _COLOURS)
    for first, second, vote in votes:
        one, other = int(first) % BEADS, int(second) % BEADS
        inputs[10, one] += vote
        inputs[10, other] -= vote
        gap = (guess[one, 2] - guess[other, 2]) / _HEIGHT_SCALE
        inputs[11, one] += gap
        inputs[11, other] -= gap
    # 12-13 the guess's heights, and whether it has any; 14  marks the white bead
    inputs[12] = guess[:, 2] / _HEIGHT_SCALE
    inputs[13] = heights
    inputs[14, 0] = 1.0
    return inputs
