"""Pictures of a rope: the loop that draws it, and one that counts the regions between strands.

For the camera and the colours see `camera`. Bead i is a capsule from points[i] to points[(i + 1) %
beads]. Colours are flat, without light or shadow. Depth is that of the rope's axis where it is
seen; under the perspective camera it is distance along the line of sight.

A pixel's coverage is what its distance to the rope's axis says of a pixel-wide box across the rope:
1 up to half a pixel inside the edge, 0 half a pixel outside. Pieces that follow each other along
the rope and touch the same pixel are one strand there; it counts once, in the colour of the piece
on top. Strands are blended from the highest to the lowest, each by the height of its axis where it
is seen.

Arithmetic is + - * / and sqrt alone, without fastmath, so that the same numbers give the same bytes
on every processor. Pixel (row, column) has its centre at (column + 0.5, row + 0.5).

After a change run `pytest tests/rendering tests/quality` and `python benchmarks/truth.py`: pictures
must be a ray tracer's but for edges, and the strand on top the one labelled over.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Ids, inlined, inner, kernel
from knotgym.rendering.camera import (
    DEFAULT,
    PictureConfig,
    bead_colours,
    checked_points,
    in_picture,
    require,
    seen_from,
)

Array = NDArray[Any]

# less would change no level of the colours in use, and only the depth of a pixel
_LEAST_COVER = 1.0 / 64.0
# A strand of rope at a pixel: the strand there that was found before, or -1; the pixel; the first
# and the last piece that touched it, and the piece on top; its coverage, the rank of the piece on
# top, and the height of the axis there.
_PLACES = [(name, np.int64) for name in ("before", "pixel", "first", "last", "top")]
_STRAND = np.dtype([*_PLACES, *((name, np.float64) for name in ("cover", "rank", "height"))])
_OUTSIDE = -1e12  # rank of a piece whose edge alone covers the pixel, less its distance, pixels


def draw(
    points: ArrayLike,
    config: PictureConfig = DEFAULT,
    *,
    colours: NDArray[np.uint8] | None = None,
    out: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """Draw a rope, or m with the same number of beads; the same arguments give the same bytes.

    Args:
        points: float64, shape (beads, 3) or (m, beads, 3), metres, world frame, finite; at least 3
            beads; m may be 0.
        config: camera, size and background of the picture.
        colours: uint8, shape (beads, 3), RGB; by default the published ones, see `bead_colours`.
        out: uint8, contiguous, of the shape below for m ropes, or wider, to whose left the ropes
            are drawn; what is right of them stays. None for a new array.

    Returns:
        uint8, shape (views * size, size, 3) or (m, views * size, size, 3), RGB, row 0 at the top
        (largest y), the first view on top; 4 channels with depth; or `out`. Parts of the rope
        outside a view are cut off.

    Raises:
        InvalidInput: points or colours have the wrong shape, or points are not finite.
        Failed: config.renderer is "mujoco" and OpenGL is not available.
    """
    checked = checked_points(points, 2, 3)
    images = _draw_all(checked.reshape(-1, *checked.shape[-2:]), config, colours, out)
    return images if checked.ndim == 3 else images[0]


def _draw_all(
    points: Array,
    config: PictureConfig,
    colours: NDArray[np.uint8] | None,
    out: NDArray[np.uint8] | None,
) -> NDArray[np.uint8]:
    frames, beads = points.shape[:2]
    colours = bead_colours(beads) if colours is None else np.asarray(colours)
    fits = colours.shape == (beads, 3) and colours.dtype == np.uint8
    require(fits, f"colours must be uint8 of shape {(beads, 3)}", (colours.dtype, colours.shape))
    views, size = len(config.views), config.size
    if out is None:
        out = np.empty((frames, views * size, size, config.channels), dtype=np.uint8)
    # `reshape` below would copy a strided array, and the background be written to the copy
    require(out.flags.c_contiguous, "out must be contiguous", out.strides)
    ropes = np.stack([seen_from(view, points) for view in config.views], axis=1)
    ropes, squares = ropes.reshape(-1, beads, 3), out.reshape(-1, size, *out.shape[2:])
    if config.renderer == "mujoco":
        # imported only here, because the module searches for OpenGL
        from knotgym.rendering import mujoco_renderer

        for square, rope in zip(squares, ropes, strict=True):
            square[:, :size] = mujoco_renderer.draw(rope, colours, config)
        return out
    # whole rows: NumPy assigns three channels at a time forty times more slowly
    row = np.tile(np.array((*config.background, 0)[: config.channels], dtype=np.uint8), size)
    out.reshape(*out.shape[:2], out.shape[2] * config.channels)[:, :, : row.size] = row
    paint(*in_picture(ropes, config), colours, np.empty((0, 5)), squares)
    return out


@kernel
def paint(
    ropes: Array, depths: tuple[float, float], colours: Array, bands: Array, out: Array
) -> None:
    """Paint m closed ropes of n pieces; piece i leads from vertex i to the next.

    Args:
        ropes: (m, n, 4), vertices in the picture: x, y, height towards the camera and radius, in
            pixels; pieces that begin or end at NaN are left out.
        depths: height that a fourth channel shows as 128, and the span between its levels 1 and
            255, pixels.
        colours: uint8 (n, 3), of the pieces.
        bands: (b, 5), stretches of the rope that cut what lies below them: place of the middle,
            and half the length, both in pieces; radius, pixels; height up to which strands are cut,
            pixels; pieces on either side of the stretch that aren't cut. For single ropes.
        out: uint8 (m, size, width, 3 or 4), already the background; output, in the left `size`
            columns.
    """
    size = out.shape[1]
    newest = np.empty(size * size, np.int64)  # strand of each pixel, -1 for none
    newest[:] = -1
    strands = np.empty(4096, _STRAND)
    for k in range(len(ropes)):
        count, strands = _stamp(ropes[k], newest, strands, size)
        for b in range(len(bands)):
            _cut(ropes[k], bands[b], newest, strands, size)
        _blend(count, newest, strands, colours, depths, out[k])
        for strand in range(count):
            newest[strands[strand].pixel] = -1


@inlined
def _stamp(rope: Array, newest: Array, strands: Array, size: int) -> Any:
    """Find the strands of a rope at all pixels; return their number, and them."""
    count, n = 0, len(rope)
    for i in range(n):
        j = (i + 1) % n
        x, y, z, r = rope[i, 0], rope[i, 1], rope[i, 2], rope[i, 3]
        dx, dy, dz, dr = rope[j, 0] - x, rope[j, 1] - y, rope[j, 2] - z, rope[j, 3] - r
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
        while count + (bottom - top) * (right - left) > len(strands):
            strands = _doubled(strands)
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
                strand = newest[pixel]
                while strand >= 0 and strands[strand].last < i - 1:
                    strand = strands[strand].before
                if strand < 0:
                    one = strands[count]
                    one.before, one.pixel, one.first = newest[pixel], pixel, i
                    one.cover, one.rank = 0.0, -np.inf
                    newest[pixel] = strand = count
                    count += 1
                one = strands[strand]
                one.last, one.cover = i, max(one.cover, cover)
                if rank > one.rank:
                    one.top, one.rank, one.height = i, rank, z + t * dz
    return count, strands


@inner
def _range(start: float, step: float, reach: float, size: int) -> tuple[int, int]:
    """Return the first and the last but one pixel that a piece reaches along an axis."""
    low, high = min(start, start + step) - reach, max(start, start + step) + reach
    # clipped as floats: an integer can't hold what is far outside
    return int(min(max(low, 0.0), size)), int(min(max(high + 1.0, 0.0), size))


@inlined
def _doubled(strands: Array) -> Array:
    """Return the strands with room for twice as many."""
    more = np.empty(2 * len(strands), _STRAND)
    for strand in range(len(strands)):  # assigning slices would take seconds to compile
        more[strand] = strands[strand]
    return more


@inlined
def _cut(rope: Array, band: Array, newest: Array, strands: Array, size: int) -> None:
    """Cut what lies below a band, see `paint`: cover it less."""
    n, (middle, half, radius, level, spared) = len(rope), band
    start, stop = int(np.ceil(middle - half - 0.5)), int(np.floor(middle + half - 0.5)) + 1
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for i in range(start, stop + 1):
        x, y = rope[i % n, 0], rope[i % n, 1]
        low_x, high_x, low_y, high_y = min(low_x, x), max(high_x, x), min(low_y, y), max(high_y, y)
    left, right = _range(low_x, high_x - low_x, radius + 0.5, size)
    top, bottom = _range(low_y, high_y - low_y, radius + 0.5, size)
    for row in range(top, bottom):
        for column in range(left, right):
            strand = newest[row * size + column]
            if strand < 0:
                continue
            nearest = np.inf
            for i in range(start, stop):
                x, y, j = rope[i % n, 0], rope[i % n, 1], (i + 1) % n
                px, py, dx, dy = column + 0.5 - x, row + 0.5 - y, rope[j, 0] - x, rope[j, 1] - y
                t = (px * dx + py * dy) / max(dx * dx + dy * dy, 1e-12)
                t = min(max(t, 0.0), 1.0)
                ex, ey = px - t * dx, py - t * dy
                nearest = min(nearest, ex * ex + ey * ey)
            left_over = min(max(np.sqrt(nearest) - radius + 0.5, 0.0), 1.0)
            while strand >= 0:
                one = strands[strand]
                off = abs(one.top + 0.5 - middle)
                if one.height <= level and min(off, n - off) > half + spared:
                    one.cover *= left_over
                strand = one.before


@inlined
def _close(newest: int, strands: Array, n: int) -> None:
    """Join the strands of a pixel that end with the last piece of the rope and begin with piece 0.

    The strand of piece 0 gets all; the other covers nothing from then on.
    """
    last = first = newest
    while last >= 0 and strands[last].last != n - 1:
        last = strands[last].before
    while first >= 0 and strands[first].first != 0:
        first = strands[first].before
    if min(last, first) < 0 or first == last:
        return
    begin, end = strands[first], strands[last]
    begin.cover = max(begin.cover, end.cover)
    if end.rank > begin.rank:
        begin.top, begin.rank, begin.height = end.top, end.rank, end.height
    end.cover, end.height = 0.0, -np.inf


@inlined
def _falling(newest: int, strands: Array, order: Array) -> int:
    """Sort the strands of a pixel into `order`, the highest first; return how many there are."""
    count, strand = 0, newest
    while strand >= 0:
        at = count
        while at > 0 and strands[order[at - 1]].height < strands[strand].height:
            order[at] = order[at - 1]
            at -= 1
        order[at] = strand
        count += 1
        strand = strands[strand].before
    return count


@inlined
def _blend(
    count: int, newest: Array, strands: Array, colours: Array, depths: Any, image: Array
) -> None:
    """Blend the strands of each pixel, the highest first, over its background."""
    size, order = len(image), np.empty(len(colours), np.int64)
    for strand in range(count):
        pixel = strands[strand].pixel
        if newest[pixel] != strand:
            continue
        depth, order[0] = 1, strand
        if strands[strand].before >= 0:
            _close(strand, strands, len(order))
            depth = _falling(strand, strands, order)
        red = green = blue = 0.0
        left = 1.0
        for at in range(depth):
            one = strands[order[at]]
            share, i = left * one.cover, one.top
            red += share * colours[i, 0]
            green += share * colours[i, 1]
            blue += share * colours[i, 2]
            left -= share
        # in place: a view of the pixel would take longer than what is done with it
        row, column = pixel // size, pixel % size
        image[row, column, 0] = np.uint8(red + left * image[row, column, 0] + 0.5)
        image[row, column, 1] = np.uint8(green + left * image[row, column, 1] + 0.5)
        image[row, column, 2] = np.uint8(blue + left * image[row, column, 2] + 0.5)
        if image.shape[2] == 4 and left < 1.0:
            nearer = min(max(0.5 + (strands[order[0]].height - depths[0]) / depths[1], 0.0), 1.0)
            image[row, column, 3] = np.uint8(1 + np.rint(254.0 * nearer))


@inner
def count_regions(canvas: Array, columns: int) -> tuple[int, float]:
    """Count the regions of 0, connected by sides and corners; return the least area, pixels, too.

    Args:
        canvas: uint8 (rows, a multiple of 8), contiguous.
        columns: how many of its columns count.
    """
    rows, eights = len(canvas), canvas.view(np.uint64)
    most = columns // 2 + 1  # runs of a row
    runs = np.empty((2, most, 3), np.int64)  # begin, end and number: of the last row and of this
    # a run's region: that of its leader, whose own is itself
    leaders, dots, count, above = np.empty(rows * most, np.int64), np.empty(rows * most), 0, 0
    for row in range(rows):
        before, here, found, column, reached = runs[row % 2], runs[1 - row % 2], 0, 0, 0
        while column < columns:
            if canvas[row, column]:
                column += 1
                continue
            begin = column
            while column < columns and not canvas[row, column]:
                # most of a picture is no rope: eight pixels are looked at as one number
                clear = column & 7 == 0 and column + 8 <= columns and eights[row, column >> 3] == 0
                column += 8 if clear else 1
            run = here[found]
            run[0], run[1], run[2] = begin, column, count
            leaders[count], dots[count] = count, column - begin
            while reached < above and before[reached, 1] < begin:
                reached += 1
            k = reached
            while k < above and before[k, 0] <= column:
                one, other = _leader(leaders, before[k, 2]), _leader(leaders, count)
                if one != other:
                    leaders[other] = one
                    dots[one] += dots[other]
                k += 1
            count, found = count + 1, found + 1
        above = found
    regions, least = 0, np.inf
    for k in range(count):
        if leaders[k] == k:
            regions, least = regions + 1, min(least, dots[k])
    return regions, least


@inner
def _leader(leaders: Ids, run: int) -> int:
    while leaders[run] != run:
        leaders[run] = leaders[leaders[run]]
        run = leaders[run]
    return run
