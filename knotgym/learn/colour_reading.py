"""Read from a picture's colours, bead by bead, where the rope is; compiled, nothing is learned.

The rope's hue encodes the position along it. A pixel that one strand covers, wholly or in part, has
that strand's hue; a pixel of two strands is greyer than either and gets less weight. Averaging the
pixels of each bead's hue gives its position, a weight (0 where the bead is covered) and a spread.
Where the axis through these beads crosses itself, the colour at the crossing tells which strand is
over.

Coordinates are pixels from the picture's middle, x right, y up. Positions along the rope are in
beads: the middle of bead i is at i, and BEADS is 0 again.

After a change run what `shape_hypotheses` says.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, inner, kernel
from knotgym.topology import CROSSING, scan

BEADS = 100
SIZE = 128  # width and height of a picture, pixels
_DARK = 30.0  # grey level up to which a pixel is background
# A pixel contributes to the beads within 2 of its position, weighted by a Gaussian of this standard
# deviation, in beads.
_NEIGHBOURS, _SPREAD = 2, 0.7
_UNSURE = 0.1  # |vote| below which a crossing stays as it is
# Channel c of hue h is 0.5 + 0.5 sin(h + _TURN[c]) (`rendering.camera.bead_colours`), which is
# linear in (grey, sine, cosine) = (0.5, 0.5 sin h, 0.5 cos h): grey + sine cos(_TURN[c]) + cosine
# sin(_TURN[c]). _UNMIX inverts that for RGB / 255. A pixel covered in part scales all three.
_TURN = 2 * np.pi * np.array([0.0, 0.33, 0.67])
_UNMIX = np.linalg.inv(np.stack([np.ones(3), np.cos(_TURN), np.sin(_TURN)], axis=1))


class Pixels(NamedTuple):
    """The n bright pixels of a picture.

    Attributes:
        at: float64 (n, 2), pixels.
        along: float64 (n,), position along the rope that the hue encodes, beads.
        weight: float64 (n,), in [0, 1], how surely a single strand is seen.
    """

    at: Array
    along: Array
    weight: Array


def decode(picture: NDArray[np.uint8]) -> Pixels:
    """Decode the bright pixels of a picture, uint8 (SIZE, SIZE, 3)."""
    brightest = np.maximum(np.maximum(picture[..., 0], picture[..., 1]), picture[..., 2])
    rows, columns = np.nonzero(brightest > _DARK)
    colours = picture[rows, columns] / 255.0 @ _UNMIX.T
    wave = np.hypot(colours[:, 1], colours[:, 2])
    # 1 for a pure hue, covered wholly or not; less where strands of two hues blend
    purity = wave / np.maximum(colours[:, 0], 1e-6)
    along = np.arctan2(colours[:, 1], colours[:, 2]) / (2 * np.pi) * BEADS % BEADS
    weight = np.minimum(2 * wave, 1.0) * np.clip((purity - 0.85) / 0.1, 0.0, 1.0)
    # pixel centres; image rows count downwards
    at = np.stack([columns + 0.5 - SIZE / 2, SIZE / 2 - rows - 0.5], axis=1)
    return Pixels(at, along, weight)


@kernel
def bead_moments(at: Array, along: Array, weight: Array, axis: Array, gate: float) -> Array:
    """Gather the pixels of each bead: their weight, mean and covariance.

    Args:
        at, along, weight: fields of `Pixels`.
        axis: float64 (BEADS, 2), expected bead positions, pixels; NaN for a bead without one.
        gate: standard deviation of the Gaussian that weighs pixels by their distance from the
            expected position, pixels.

    Returns:
        float64 (BEADS, 6): weight, x, y, and the covariances xx, xy, yy; 0 for an unseen bead.
    """
    sums = np.zeros((BEADS, 6))
    for k in range(len(along)):
        if weight[k] <= 0:
            continue
        middle = int(np.floor(along[k] + 0.5))
        x, y = at[k]
        for bead in range(middle - _NEIGHBOURS, middle + _NEIGHBOURS + 1):
            i = bead % BEADS
            count = weight[k] * np.exp(-0.5 * ((along[k] - bead) / _SPREAD) ** 2)
            if not np.isnan(axis[i, 0]):
                off = (x - axis[i, 0]) ** 2 + (y - axis[i, 1]) ** 2
                count *= np.exp(-0.5 * off / gate**2)
            sums[i, 0] += count
            sums[i, 1] += count * x
            sums[i, 2] += count * y
            sums[i, 3] += count * x * x
            sums[i, 4] += count * x * y
            sums[i, 5] += count * y * y
    # sums to means, then second moments to covariances: E[xy] - E[x] E[y]
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


@kernel
def interpolated_axis(moments: Array, least: float) -> Array:
    """Return bead positions (BEADS, 2), interpolated between beads of weight at least `least`."""
    axis = np.zeros((BEADS, 2))
    seen = np.flatnonzero(moments[:, 0] >= least)
    if len(seen) == 0:
        return axis
    for k in range(len(seen)):
        start, end = seen[k], seen[(k + 1) % len(seen)]
        # beads from start to end round the loop, in [1, BEADS]; BEADS if only one bead is seen
        gap = (end - start - 1) % BEADS + 1
        for step in range(gap):
            fraction = step / gap
            i = (start + step) % BEADS
            axis[i] = (1 - fraction) * moments[start, 1:3] + fraction * moments[end, 1:3]
    return axis


@kernel
def crossing_votes(picture: NDArray[np.uint8], vertices: Array, colours: Array) -> Array:
    """Decide by colour which strand is over at each crossing of an axis.

    Args:
        picture: uint8 (SIZE, SIZE, 3).
        vertices: float64 (BEADS, 3), x and y in pixels; heights are ignored.
        colours: float64 (BEADS, 3), RGB of the beads.

    Returns:
        float64 (n, 3): positions of the two strands along the rope, beads, and a vote in [-1, 1]:
        1 if the first is certainly over, -1 if the second is.
    """
    # with all heights equal, which strand `scan` calls the upper one is arbitrary
    flat = vertices.copy()
    flat[:, 2] = 0.0
    _, _, table = scan(flat)
    votes = np.zeros((len(table), 3))
    for row in range(len(table)):
        votes[row, 0] = table[row, CROSSING.over_place]
        votes[row, 1] = table[row, CROSSING.under_place]
        x, y = table[row, CROSSING.x] + SIZE / 2, SIZE / 2 - table[row, CROSSING.y]
        total = 0.0
        # 3 x 3 pixels, each weighed by exp(-(d / 0.6)^2) of its distance d from the crossing
        for r in range(int(y) - 1, int(y) + 2):
            for c in range(int(x) - 1, int(x) + 2):
                if 0 <= r < SIZE and 0 <= c < SIZE:
                    square = (c + 0.5 - x) ** 2 + (r + 0.5 - y) ** 2
                    total += np.exp(-square / 0.36) * (
                        _colour_distance(picture[r, c], colours, votes[row, 1])
                        - _colour_distance(picture[r, c], colours, votes[row, 0])
                    )
        # a total of 100 grey levels gives a vote of 0.76
        votes[row, 2] = np.tanh(total / 100.0)
    return votes


@kernel
def enforce_votes(vertices: Array, votes: Array, least: float, reach: int) -> None:
    """Raise and lower strands, in place, until every crossing agrees with its vote.

    Args:
        vertices: float64 (BEADS, 3).
        votes: as `crossing_votes` returns them.
        least: height difference of the strands at a crossing, at least; in the unit of heights.
        reach: beads on either side that move along, with a raised-cosine profile.
    """
    # Moving one strand may undo a crossing nearby, so all are visited four times.
    for _ in range(4):
        for row in range(len(votes)):
            if abs(votes[row, 2]) < _UNSURE:
                continue
            sign = 1.0 if votes[row, 2] > 0 else -1.0
            gap = _height(vertices, votes[row, 0]) - _height(vertices, votes[row, 1])
            short = least - sign * gap
            if short <= 0:
                continue
            # half of what is missing by raising the upper strand, half by lowering the other
            for strand in range(2):
                middle = votes[row, strand]
                up = sign * short * (0.5 if strand == 0 else -0.5)
                for bead in range(int(middle) - reach, int(middle) + reach + 2):
                    fraction = 0.5 + 0.5 * np.cos(np.pi * (bead - middle) / (reach + 1))
                    vertices[bead % BEADS, 2] += up * fraction


@inner
def _height(vertices: Array, along: float) -> float:
    """Interpolate the height at a position along the rope."""
    bead = int(along)
    part = along - bead
    return float((1 - part) * vertices[bead % BEADS, 2] + part * vertices[(bead + 1) % BEADS, 2])


@inner
def _colour_distance(seen: NDArray[np.uint8], colours: Array, along: float) -> float:
    """Return the least RGB distance of a pixel from the beads around a position of the rope."""
    # three beads, because the axis may be off along the rope by a fraction of a bead
    best = np.inf
    for step in range(-1, 2):
        bead = (int(np.floor(along)) + step) % BEADS
        square = 0.0
        for channel in range(3):
            square += (seen[channel] - colours[bead, channel]) ** 2
        best = min(best, square)
    return float(np.sqrt(best))
