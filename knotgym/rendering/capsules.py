"""The loop that draws ropes: capsules by distance, the highest strand of each pixel in front.

A pixel's coverage is what its distance to the rope's axis says of a pixel-wide box across the rope:
1 up to half a pixel inside the edge, 0 half a pixel outside. Pieces that follow each other along
the rope and touch the same pixel are one strand there; it counts once, in the colour of the piece
on top. Strands are blended from the highest to the lowest, each by the height of its axis where it
is seen.

Arithmetic is + - * / and sqrt alone, without fastmath, so that the same numbers give the same bytes
on every processor. Pixel (row, column) has its centre at (column + 0.5, row + 0.5).

After a change run `pytest tests/rendering` and `python benchmarks/truth.py`: pictures must be a ray
tracer's but for edges, and the strand on top the one labelled over.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from knotgym.common import inner

# less would change no level of the colours in use, and only the depth of a pixel
_LEAST_COVER = 1.0 / 64.0
_OUTSIDE = -1e12  # rank of a piece whose edge alone covers the pixel, less its distance, pixels


class Depths(NamedTuple):
    """Heights as levels of a fourth channel: 128 at `middle`, 1 and 255 half a `span` from it."""

    middle: float
    span: float


@njit(cache=True, nogil=True)
def paint(
    pixels: NDArray[np.float64],
    height: NDArray[np.float64],
    radius: NDArray[np.float64],
    colours: NDArray[np.uint8],
    depths: Depths,
    bands: NDArray[np.float64],
    out: NDArray[np.uint8],
    size: int,
) -> None:
    """Paint m closed ropes of n pieces; piece i leads from vertex i to the next.

    Args:
        pixels: (m, n, 2), vertices in the picture; pieces that begin or end at NaN are left out.
        height: (m, n), towards the camera, in pixels.
        radius: (m, n), pixels.
        colours: uint8 (n, 3), of the pieces.
        depths: in pixels; used if the picture has a fourth channel.
        bands: (b, 5), stretches of the rope that cut what lies below them: place of the middle,
            and half the length, both in pieces; radius, pixels; height up to which strands are cut,
            pixels; pieces on either side of the stretch that aren't cut. For single ropes.
        out: uint8 (m, size, width, 3 or 4), already the background; output, in the left `size`
            columns.
        size: side of the picture.
    """
    ropes, n = height.shape
    # Strands are kept in lists: `first` has each pixel's newest strand or -1, `of` the strand
    # before, the pixel, the first and the last piece that touched it, and the piece on top; `seen`
    # its coverage, the rank of the piece on top, and the height of the axis there.
    first = np.full(size * size, -1, np.int32)
    of, seen = np.empty((4096, 5), np.int32), np.empty((4096, 3))
    order = np.empty(n, np.int64)
    for k in range(ropes):
        count, of, seen = _stamp(pixels[k], height[k], radius[k], first, of, seen, size)
        for b in range(len(bands)):
            _cut(pixels[k], bands[b], first, of, seen, size)
        _blend(count, first, of, seen, order, colours, depths, out[k], size)
        for strand in range(count):
            first[of[strand, 1]] = -1


@inner
def _stamp(
    pixels: NDArray[np.float64],
    height: NDArray[np.float64],
    radius: NDArray[np.float64],
    first: NDArray[np.int32],
    of: NDArray[np.int32],
    seen: NDArray[np.float64],
    size: int,
) -> Any:
    """Find the strands of a rope at all pixels; return their number, `of` and `seen`."""
    count, n = 0, len(height)
    for i in range(n):
        j = (i + 1) % n
        x, y, z, r = pixels[i, 0], pixels[i, 1], height[i], radius[i]
        dx, dy, dz, dr = pixels[j, 0] - x, pixels[j, 1] - y, height[j] - z, radius[j] - r
        if not dx * dx + dy * dy < np.inf:
            continue
        square = max(dx * dx + dy * dy, 1e-12)
        inverse = 1.0 / square
        # how much farther up the piece its highest point above a pixel is than its nearest, in
        # pieces and for each pixel of the sphere's height there
        lean = dz / np.sqrt(square * (square + dz * dz))
        full, reach = min(1.0, 2.0 * max(r, r + dr)), max(r, r + dr) + 0.5
        top, bottom = _range(y, dy, reach, size)
        left, right = _range(x, dx, reach, size)
        # here, as arrays that are replaced in the inner loop are slow
        while count + (bottom - top) * (right - left) > len(of):
            of, seen = _doubled(of), _doubled(seen)
        # half of what a row cuts out of the piece, however far it went on; beside that all is free
        slope, wide = (dx / dy, reach * np.sqrt(square) / abs(dy)) if dy != 0.0 else (0.0, np.inf)
        for row in range(top, bottom):
            py = row + 0.5 - y
            start = max(left, int(max(x + py * slope - wide, 0.0)))
            stop = min(right, int(min(x + py * slope + wide, size)) + 1)
            for column in range(start, stop):
                px = column + 0.5 - x
                along = (px * dx + py * dy) * inverse
                t = min(max(along, 0.0), 1.0)
                ex, ey, here = px - t * dx, py - t * dy, r + t * dr
                away, least = ex * ex + ey * ey, here + 0.5 - _LEAST_COVER
                if not away < least * least:
                    continue
                distance = np.sqrt(away)
                cover, rank = min(here + 0.5 - distance, full), _OUTSIDE - distance
                if distance < here:
                    # the upper surface of a capsule is that of the spheres along its axis
                    ex, ey = px - along * dx, py - along * dy
                    rise = np.sqrt(max(here * here - ex * ex - ey * ey, 0.0))
                    t = min(max(along + rise * lean, 0.0), 1.0)
                    ex, ey = px - t * dx, py - t * dy
                    rank = z + t * dz + np.sqrt(max(here * here - ex * ex - ey * ey, 0.0))
                pixel = row * size + column
                strand = first[pixel]
                while strand >= 0 and of[strand, 3] < i - 1:
                    strand = of[strand, 0]
                if strand < 0:
                    strand = count
                    count += 1
                    of[strand, 0], of[strand, 1], of[strand, 2] = first[pixel], pixel, i
                    seen[strand, 0], seen[strand, 1] = 0.0, -np.inf
                    first[pixel] = strand
                of[strand, 3] = i
                seen[strand, 0] = max(seen[strand, 0], cover)
                if rank > seen[strand, 1]:
                    of[strand, 4], seen[strand, 1], seen[strand, 2] = i, rank, z + t * dz
    return count, of, seen


@inner
def _range(start: float, step: float, reach: float, size: int) -> tuple[int, int]:
    """Return the first and the last but one pixel that a piece reaches along an axis."""
    low, high = min(start, start + step) - reach, max(start, start + step) + reach
    # clipped as floats: an integer can't hold what is far outside
    return int(min(max(low, 0.0), size)), int(min(max(high + 1.0, 0.0), size))


@inner
def _doubled(rows: Any) -> Any:
    """Return an array with room for twice as many rows."""
    wider = np.empty((2 * len(rows), rows.shape[1]), rows.dtype)
    wider[: len(rows)] = rows
    return wider


@inner
def _cut(
    pixels: NDArray[np.float64],
    band: NDArray[np.float64],
    first: NDArray[np.int32],
    of: NDArray[np.int32],
    seen: NDArray[np.float64],
    size: int,
) -> None:
    """Cut what lies below a band, see `paint`: cover it less."""
    n, (middle, half, radius, level, spared) = len(pixels), band
    start, stop = int(np.ceil(middle - half - 0.5)), int(np.floor(middle + half - 0.5)) + 1
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for i in range(start, stop + 1):
        x, y = pixels[i % n]
        low_x, high_x, low_y, high_y = min(low_x, x), max(high_x, x), min(low_y, y), max(high_y, y)
    left, right = _range(low_x, high_x - low_x, radius + 0.5, size)
    top, bottom = _range(low_y, high_y - low_y, radius + 0.5, size)
    for row in range(top, bottom):
        for column in range(left, right):
            strand = first[row * size + column]
            if strand < 0:
                continue
            nearest = np.inf
            for i in range(start, stop):
                px, py = column + 0.5 - pixels[i % n, 0], row + 0.5 - pixels[i % n, 1]
                dx = pixels[(i + 1) % n, 0] - pixels[i % n, 0]
                dy = pixels[(i + 1) % n, 1] - pixels[i % n, 1]
                t = (px * dx + py * dy) / max(dx * dx + dy * dy, 1e-12)
                t = min(max(t, 0.0), 1.0)
                ex, ey = px - t * dx, py - t * dy
                nearest = min(nearest, ex * ex + ey * ey)
            left_over = min(max(np.sqrt(nearest) - radius + 0.5, 0.0), 1.0)
            while strand >= 0:
                off = abs(of[strand, 4] + 0.5 - middle)
                if seen[strand, 2] <= level and min(off, n - off) > half + spared:
                    seen[strand, 0] *= left_over
                strand = of[strand, 0]


@inner
def _close(newest: int, of: NDArray[np.int32], seen: NDArray[np.float64], n: int) -> None:
    """Join the strands of a pixel that end with the last piece of the rope and begin with piece 0.

    The strand of piece 0 gets all; the other covers nothing from then on.
    """
    end = newest
    while end >= 0 and of[end, 3] != n - 1:
        end = of[end, 0]
    begin = newest
    while begin >= 0 and of[begin, 2] != 0:
        begin = of[begin, 0]
    if end < 0 or begin < 0 or begin == end:
        return
    seen[begin, 0] = max(seen[begin, 0], seen[end, 0])
    if seen[end, 1] > seen[begin, 1]:
        of[begin, 4], seen[begin, 1], seen[begin, 2] = of[end, 4], seen[end, 1], seen[end, 2]
    seen[end, 0], seen[end, 2] = 0.0, -np.inf


@inner
def _falling(
    newest: int, of: NDArray[np.int32], seen: NDArray[np.float64], order: NDArray[np.int64]
) -> int:
    """Sort the strands of a pixel into `order`, the highest first; return how many there are."""
    count, strand = 0, newest
    while strand >= 0:
        at = count
        while at > 0 and seen[order[at - 1], 2] < seen[strand, 2]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = strand
        count += 1
        strand = of[strand, 0]
    return count


@inner
def _blend(
    count: int,
    first: NDArray[np.int32],
    of: NDArray[np.int32],
    seen: NDArray[np.float64],
    order: NDArray[np.int64],
    colours: NDArray[np.uint8],
    depths: Depths,
    image: NDArray[np.uint8],
    size: int,
) -> None:
    """Blend the strands of each pixel, the highest first, over its background."""
    for newest in range(count):
        if first[of[newest, 1]] != newest:
            continue
        strands, order[0] = 1, newest
        if of[newest, 0] >= 0:
            _close(newest, of, seen, len(order))
            strands = _falling(newest, of, seen, order)
        red = green = blue = 0.0
        left = 1.0
        for at in range(strands):
            share, i = left * seen[order[at], 0], of[order[at], 4]
            red += share * colours[i, 0]
            green += share * colours[i, 1]
            blue += share * colours[i, 2]
            left -= share
        # in place: a view of the pixel would take longer than what is done with it
        row, column = of[newest, 1] // size, of[newest, 1] % size
        image[row, column, 0] = np.uint8(red + left * image[row, column, 0] + 0.5)
        image[row, column, 1] = np.uint8(green + left * image[row, column, 1] + 0.5)
        image[row, column, 2] = np.uint8(blue + left * image[row, column, 2] + 0.5)
        if image.shape[2] == 4 and left < 1.0:
            nearer = min(max(0.5 + (seen[order[0], 2] - depths.middle) / depths.span, 0.0), 1.0)
            image[row, column, 3] = np.uint8(1 + np.rint(254.0 * nearer))
