"""What a picture says of a rope by its colours alone, bead by bead; compiled, nothing is learned.

A pixel that one strand covers, wholly or in part, has that strand's hue: its place along the rope.
A pixel of two strands is greyer than either, and counts the less. Pixels gathered by their places
give each bead a middle, a weight (none where it is covered) and a spread. Where the axis so found
crosses itself, the colour at the crossing tells which strand is over.

Coordinates are pixels from the picture's middle, x right, y up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from knotgym.topology.crossing_kernel import OVER_PLACE, UNDER_PLACE, X, Y, scan

Array = NDArray[np.float64]

BEADS = 100
SIZE = 128  # pixels of a picture's side
SEEN = 8  # numbers that `gathered` tells of a bead
_DARK = 30.0  # levels below which a pixel is background
_REACH = 2  # beads away from a pixel's place that it counts for
_UNSURE = 0.1  # of a crossing that is left as it is
_SPREAD = 0.7  # beads; how it counts less for them
_TURN = 2 * np.pi * np.array([0.0, 0.33, 0.67])
# RGB / 255 = BASIS (grey, sine, cosine), of a place half as long as the pixel is covered
_UNMIX = np.linalg.inv(np.stack([np.ones(3), np.cos(_TURN), np.sin(_TURN)], axis=1))


class Pixels(NamedTuple):
    """The n bright pixels of a picture.

    Attributes:
        at: float64 (n, 2).
        place: float64 (n,), beads; the middle of bead i is i.
        weight: float64 (n,), in [0, 1]: covered by one strand.
    """

    at: Array
    place: Array
    weight: Array


def decode(picture: NDArray[np.uint8]) -> Pixels:
    """The pixels of a picture uint8 (SIZE, SIZE, 3) that show a rope."""
    brightest = np.maximum(np.maximum(picture[..., 0], picture[..., 1]), picture[..., 2])
    rows, columns = np.nonzero(brightest > _DARK)
    colours = picture[rows, columns] / 255.0 @ _UNMIX.T
    wave = np.hypot(colours[:, 1], colours[:, 2])
    purity = wave / np.maximum(colours[:, 0], 1e-6)
    place = np.arctan2(colours[:, 1], colours[:, 2]) / (2 * np.pi) * BEADS % BEADS
    weight = np.minimum(2 * wave, 1.0) * np.clip((purity - 0.85) / 0.1, 0.0, 1.0)
    at = np.stack([columns + 0.5 - SIZE / 2, SIZE / 2 - rows - 0.5], axis=1)
    return Pixels(at, place, weight)


@njit(cache=True, nogil=True)
def gathered(at: Array, place: Array, weight: Array, axis: Array, gate: float) -> Array:
    """What the pixels say of every bead, near where it is thought to be.

    Args:
        at, place, weight: of `Pixels`.
        axis: float64 (BEADS, 2), where each bead's middle is thought to be; NaN for anywhere.
        gate: pixels off it at which a pixel counts exp(-1/2).

    Returns:
        float64 (BEADS, 6): weight, x, y, and the variances xx, xy, yy; 0 where nothing is seen.
    """
    sums = np.zeros((BEADS, 6))
    for k in range(len(place)):
        if weight[k] <= 0:
            continue
        middle = int(np.floor(place[k] + 0.5))
        x, y = at[k]
        for bead in range(middle - _REACH, middle + _REACH + 1):
            i = bead % BEADS
            count = weight[k] * np.exp(-0.5 * ((place[k] - bead) / _SPREAD) ** 2)
            if not np.isnan(axis[i, 0]):
                off = (x - axis[i, 0]) ** 2 + (y - axis[i, 1]) ** 2
                count *= np.exp(-0.5 * off / gate**2)
            sums[i, 0] += count
            sums[i, 1] += count * x
            sums[i, 2] += count * y
            sums[i, 3] += count * x * x
            sums[i, 4] += count * x * y
            sums[i, 5] += count * y * y
    for i in range(BEADS):
        total = sums[i, 0]
        if total < 1e-3:
            sums[i] = 0.0
            continue
        sums[i, 1:] /= total
        x, y = sums[i, 1], sums[i, 2]
        sums[i, 3] -= x * x
        sums[i, 4] -= x * y
        sums[i, 5] -= y * y
    return sums


@njit(cache=True, nogil=True)
def joined(sums: Array, least: float) -> Array:
    """An axis (BEADS, 2) through the beads of weight at least `least`, straight between them."""
    axis = np.zeros((BEADS, 2))
    seen = np.flatnonzero(sums[:, 0] >= least)
    if len(seen) == 0:
        return axis
    for k in range(len(seen)):
        start, end = seen[k], seen[(k + 1) % len(seen)]
        gap = (end - start - 1) % BEADS + 1
        for step in range(gap):
            share = step / gap
            i = (start + step) % BEADS
            axis[i] = (1 - share) * sums[start, 1:3] + share * sums[end, 1:3]
    return axis


@njit(cache=True, nogil=True)
def votes(picture: NDArray[np.uint8], vertices: Array, colours: Array) -> Array:
    """Which strand is over at each crossing of an axis, as the colours there say.

    Args:
        picture: uint8 (SIZE, SIZE, 3).
        vertices: float64 (BEADS, 3), of which the heights are left out.
        colours: float64 (BEADS, 3), of the beads.

    Returns:
        float64 (n, 3): places, beads, of two strands, and how sure it is that the first is over, in
        [-1, 1].
    """
    flat = vertices.copy()
    flat[:, 2] = 0.0
    _, _, table = scan(flat)
    found = np.zeros((len(table), 3))
    for row in range(len(table)):
        found[row, 0], found[row, 1] = table[row, OVER_PLACE], table[row, UNDER_PLACE]
        x, y = table[row, X] + SIZE / 2, SIZE / 2 - table[row, Y]
        total = 0.0
        for r in range(int(y) - 1, int(y) + 2):
            for c in range(int(x) - 1, int(x) + 2):
                if 0 <= r < SIZE and 0 <= c < SIZE:
                    apart = (c + 0.5 - x) ** 2 + (r + 0.5 - y) ** 2
                    total += np.exp(-apart / 0.36) * (
                        _distance(picture[r, c], colours, found[row, 1])
                        - _distance(picture[r, c], colours, found[row, 0])
                    )
        found[row, 2] = np.tanh(total / 100.0)
    return found


@njit(cache=True, nogil=True)
def settle(vertices: Array, found: Array, least: float, reach: int) -> None:
    """Lift and lower strands, in place, until each crossing is as the colours say.

    Args:
        vertices: float64 (BEADS, 3).
        found: as `votes` tells it.
        least: by which the upper strand shall be higher.
        reach: beads to either side that are moved along, less and less.
    """
    for _ in range(4):
        for row in range(len(found)):
            if abs(found[row, 2]) < _UNSURE:
                continue
            sign = 1.0 if found[row, 2] > 0 else -1.0
            gap = _height(vertices, found[row, 0]) - _height(vertices, found[row, 1])
            short = least - sign * gap
            if short <= 0:
                continue
            for strand in range(2):
                place = found[row, strand]
                up = sign * short * (0.5 if strand == 0 else -0.5)
                for bead in range(int(place) - reach, int(place) + reach + 2):
                    share = 0.5 + 0.5 * np.cos(np.pi * (bead - place) / (reach + 1))
                    vertices[bead % BEADS, 2] += up * share


@njit(cache=True, nogil=True)
def _height(vertices: Array, place: float) -> float:
    bead = int(place)
    share = place - bead
    return float((1 - share) * vertices[bead % BEADS, 2] + share * vertices[(bead + 1) % BEADS, 2])


@njit(cache=True, nogil=True)
def _distance(seen: NDArray[np.uint8], colours: Array, place: float) -> float:
    best = np.inf
    for step in range(-1, 2):
        bead = (int(np.floor(place)) + step) % BEADS
        apart = 0.0
        for channel in range(3):
            apart += (seen[channel] - colours[bead, channel]) ** 2
        best = min(best, apart)
    return float(np.sqrt(best))
