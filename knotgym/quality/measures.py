"""Computation of quality measures: how readable a state's picture is, and how twisted the rope.

`limits` defines the measures, their units and the limits for curated states. Most measures are
computed in one compiled call for many ropes, from crossings that are known already; the rope
beside which regions are counted is drawn by OpenCV. Arithmetic is that of C's mathematical library,
without fastmath, so that a measure is the same fresh and from the cache, alone and beside others.

After a change run `pytest tests/quality` and `knotgym dataset verify` on the sets that ship: the
measures that they store are computed again and must be the same.
"""

import hashlib
import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from knotgym.common import Array, Ids, Stream, inner, kernel
from knotgym.quality.limits import Quality
from knotgym.rendering import PictureConfig, count_regions
from knotgym.rope import Rope
from knotgym.topology import (
    CROSSING,
    CodeArrays,
    Crossings,
    find_crossings,
    strand_spacing,
    visited,
)

# Two points of the drawn rope belong to different strands if the shortest path between them along
# the drawing is longer than this many pixels; a path may turn at crossings.
WALK = 12.0
# 64 draws put the 95 % interval of a share of 0.95 at 0.87 to 0.98; each costs a labelled curve.
NOISE_DRAWS = 64
# of the canvas on which regions are drawn: dots to a pixel, pixels of border that keep the outside
# connected, and binary places of a dot's fractions
_FINE, _BORDER, _END = 3, 4, 4


def measure(
    points: ArrayLike,
    crossings: Crossings | None = None,
    config: PictureConfig | None = None,
    *,
    quick: bool = False,
) -> Quality:
    """Measure a configuration, float64 (beads, 3), metres.

    Args:
        points: not modified.
        crossings: crossings of the points, if already known.
        config: picture in which to measure, from above; the usual one of such a rope if None.
        quick: leave out excess_crossing_number, which takes half of the time.

    Returns:
        All measures but noise_survival, which is computed by the function of that name; NaN for
        measures left out.
    """
    known = find_crossings(points) if crossings is None else crossings
    rows = measure_all(np.asarray(points, dtype=np.float64)[None], [known], config, quick=quick)
    return rows[0]


def measure_all(
    points: Array,
    crossings: Sequence[Crossings],
    config: PictureConfig | None = None,
    *,
    quick: bool = False,
) -> list[Quality]:
    """Measure configurations, float64 (n, beads, 3), metres, as `measure` does one."""
    if not len(points):
        return []
    config = PictureConfig.of(points.shape[1]) if config is None else config
    lens = config.pixels_per_metre, float(config.size), config.rope_radius
    measured, counts = np.empty((len(points), 11)), np.array([each.nx for each in crossings])
    visits = np.concatenate([each.visits for each in crossings])
    table = np.concatenate([each.table for each in crossings])
    seen = np.empty((*points.shape[:2], 2))
    # a writable copy, because numba would compile the kernels again for a read-only array
    _measure_rows(np.array(points, order="C"), counts, visits, table, lens, quick, seen, measured)
    for pixels, crossed, row in zip(seen, counts, measured, strict=True):
        count, least = _regions(pixels, 2 * lens[0] * lens[2])
        row[4] = least if count == crossed + 2 else 0.0
    return [Quality(*row) for row in measured.tolist()]


def _regions(pixels: Array, width: float) -> tuple[int, float]:
    """Count the regions beside a closed band; return the smallest area, too, square pixels.

    Dots that touch by a side or a corner are of one region.

    Args:
        pixels: float64 (beads, 2), the middle of the band.
        width: of the band, pixels.
    """
    border = _BORDER + int(width / 2)
    low = np.floor(pixels.min(axis=0)) - border
    wide, high = ((np.ceil(pixels.max(axis=0)) + border - low) * _FINE).astype(int)
    canvas = np.zeros((high, (wide + 7) & ~7), dtype=np.uint8)
    dots = np.rint((pixels - low) * _FINE * (1 << _END)).astype(np.int32)
    # Background is 8-connected, so that a line of one dot would leak diagonally; two dots don't.
    thick = max(2, round(width * _FINE))
    cv2.polylines(canvas, [dots[:, None]], True, 1, thick, cv2.LINE_8, _END)
    count, least = _counted(canvas, wide)
    return count, least / _FINE**2


def base_spacing(points: Array, crossings: Crossings, bases: ArrayLike) -> Array:
    """Return the distance along the drawing from base beads to the nearest crossing, pixels.

    Args:
        points: float64 (beads, 3), metres.
        crossings: those of the points.
        bases: base bead k is the one between the vertices bases[k] and bases[k] + 1; a crossing on
            it gives 0.

    Returns:
        float64 (bases,).
    """
    config = PictureConfig()
    lens = config.pixels_per_metre, float(config.size), config.rope_radius
    places, which = crossings.table.copy(), np.asarray(bases, np.int64)
    return _base_spacings(np.array(points, order="C"), places, lens, which)


def noise_survival(
    points: ArrayLike,
    scale: float = Quality.RESET_NOISE,
    rng: np.random.Generator | None = None,
    draws: int = NOISE_DRAWS,
) -> float:
    """Return the fraction of draws of reset noise that keep the Gauss code and chirality.

    Args:
        points: float64 (beads, 3), metres.
        scale: of the noise, see `Quality.RESET_NOISE`.
        rng: generator of the noise; by default one that is seeded with a digest of the points, so
            that the fraction can be computed again from them alone.
        draws: number of draws.
    """
    p = np.asarray(points, dtype=np.float64)[None]
    if rng is None:
        seed = int.from_bytes(hashlib.sha256(p.tobytes()).digest()[:7], "little")
        rng = Stream.NOISE_SURVIVAL.generator(seed)
    varied = Rope.noised(p, scale, [rng] * draws)
    codes = CodeArrays.read(np.concatenate([p, varied]))
    each = np.hstack([codes.visits, codes.signs])
    return float((each[1:] == each[0]).all(axis=1).mean())


@kernel
def _counted(canvas: Array, columns: int) -> tuple[int, float]:
    return count_regions(canvas, columns)


@kernel
def _measure_rows(
    points: Array,
    counts: Ids,
    visits: Ids,
    table: Array,
    lens: Any,
    quick: bool,
    seen: Array,
    out: Array,
) -> None:
    """Compute all measures but `smallest_region` and the last of many ropes.

    Args:
        points: float64 (n, beads, 3), metres.
        counts: int64 (n,), crossings of each.
        visits: int64, (2 counts[0] + 2 counts[1] + ...,), those of `Crossings`, rope by rope.
        table: float64 (counts[0] + counts[1] + ..., 7), likewise.
        lens: pixels per metre; side of the picture, pixels; radius of the rope, metres.
        quick: leave out the excess crossing number.
        seen: float64 (n, beads, 2), the ropes in the picture, pixels; output.
        out: float64 (n, 11), measures in the order of `Quality`'s fields; output.
    """
    scale, size, thick = lens
    last = 0
    for rope in range(len(points)):
        first, last = last, last + counts[rope]
        laid, crossed, measured = points[rope], table[first:last], out[rope]
        pixels = seen[rope] = _in_picture(laid, scale, size)
        along, places, at = visited(pixels, crossed)
        low, high = size, 0.0
        for i in range(len(pixels)):
            for axis in range(2):
                low, high = min(low, pixels[i, axis]), max(high, pixels[i, axis])
        angle, apart, clear, writhe = 90.0, size, 4 * thick, 0.0
        for k in range(len(crossed)):
            crossing = crossed[k]
            angle = min(
                angle, _angle(laid, crossing[CROSSING.over_place], crossing[CROSSING.under_place])
            )
            clear = min(clear, crossing[CROSSING.over_z] - crossing[CROSSING.under_z])
            writhe += crossing[CROSSING.sign]
            for j in range(k):
                x = scale * crossing[CROSSING.x] - scale * crossed[j, CROSSING.x]
                y = scale * crossing[CROSSING.y] - scale * crossed[j, CROSSING.y]
                apart = min(apart, np.sqrt(x * x + y * y))
        measured[0], measured[1] = angle, apart
        measured[2] = min(size, _base_spacing(along, places, at, 0))
        measured[3] = strand_spacing(pixels, along, at, WALK, size)
        measured[5] = _smallest_face(pixels, visits[2 * first : 2 * last], places, crossed)
        measured[6] = min(low, size - high) - scale * thick
        measured[7] = 1000 * clear
        measured[8] = np.nan if quick else _average_crossing_number(laid) - len(crossed)
        measured[9], measured[10] = _total_curvature(laid), writhe


@kernel
def _base_spacings(points: Array, table: Array, lens: Any, bases: Ids) -> Array:
    along, places, at = visited(_in_picture(points, lens[0], lens[1]), table)
    spacings = np.empty(len(bases))
    for row in range(len(bases)):
        spacings[row] = min(lens[1], _base_spacing(along, places, at, bases[row]))
    return spacings


@inner
def _in_picture(points: Array, scale: float, size: float) -> Array:
    """Project a rope: float64 (beads, 2), x right and y down, pixels; as `project` does."""
    beads, x, y = len(points), 0.0, 0.0
    for i in range(beads):
        x, y = x + points[i, 0], y + points[i, 1]
    x, y, pixels = x / beads, y / beads, np.empty((beads, 2))
    for i in range(beads):
        pixels[i, 0] = 0.5 * size + scale * (points[i, 0] - x)
        pixels[i, 1] = 0.5 * size - scale * (points[i, 1] - y)
    return pixels


@inner
def _base_spacing(along: Array, places: Array, at: Array, base: int) -> float:
    """Return the way along the drawing from a base bead to the nearest visit; 0 if that is on it.

    The arrays are those of `visited`.
    """
    beads, least = len(along) - 1, np.inf
    for k in range(len(places)):
        if 0.0 <= (places[k] - base) % beads <= 1.0:
            return 0.0
        # forwards from the end of the base bead, and backwards from its start
        ahead, behind = at[k] - along[base + 1], along[base] - at[k]
        least = min(least, ahead + along[beads] * (ahead < 0))
        least = min(least, behind + along[beads] * (behind < 0))
    return least


@inner
def _angle(points: Array, over: float, under: float) -> float:
    """Return the angle in the picture between two crossing strands, degrees in [0, 90].

    Args:
        points: float64 (beads, 3), metres.
        over, under: positions of the two strands along the rope, beads.
    """
    # directions over two beads, because a single bead's direction jumps at joints
    ax, ay = _at(points, over + 1)
    x, y = _at(points, over - 1)
    ax, ay = ax - x, ay - y
    bx, by = _at(points, under + 1)
    x, y = _at(points, under - 1)
    bx, by = bx - x, by - y
    return math.degrees(math.atan2(abs(ax * by - ay * bx), abs(ax * bx + ay * by)))


@inner
def _at(points: Array, place: float) -> tuple[float, float]:
    """Return x and y of a place along the rope."""
    bead = int(np.floor(place))
    part, i, j = place - bead, bead % len(points), (bead + 1) % len(points)
    x = points[i, 0] + part * (points[j, 0] - points[i, 0])
    return x, points[i, 1] + part * (points[j, 1] - points[i, 1])


@inner
def _total_curvature(points: Array) -> float:
    """Return the total turning of a rope's direction, full turns."""
    beads, total = len(points), 0.0
    a, b = points[beads - 1], points[0]
    x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    size = np.sqrt(x * x + y * y + z * z)
    for i in range(beads):
        a, b = points[i], points[(i + 1) % beads]
        u, v, w = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        length = np.sqrt(u * u + v * v + w * w)
        cosine = (x / size) * (u / length) + (y / size) * (v / length) + (z / size) * (w / length)
        total += math.acos(min(1.0, max(-1.0, cosine)))
        x, y, z, size = u, v, w, length
    return total / (2 * math.pi)


@inner
def _smallest_face(pixels: Array, visits: Ids, places: Array, table: Array) -> float:
    """Return the smallest area of a face of the curve, the outer one included, square pixels."""
    # Shoelace formula: a face's area is half the sum of p x dp round its boundary. The sum is taken
    # once along the whole curve, and cut at the visits into the edges between them; inside a bead
    # it grows linearly.
    beads, count = len(pixels), len(visits)
    until, at, position = np.empty(beads + 1), np.empty(count), np.empty((count, 2), np.int64)
    until[0] = 0.0
    for i in range(beads):
        j = (i + 1) % beads
        swept = pixels[i, 0] * pixels[j, 1] - pixels[i, 1] * pixels[j, 0]
        until[i + 1] = until[i] + swept
    if not count:
        return abs(until[beads]) / 2
    for k in range(count):
        label, under = abs(visits[k]) - 1, int(visits[k] < 0)
        place = places[2 * label + under]
        bead = min(int(place), beads - 1)
        at[k] = until[bead] + (place - bead) * (until[bead + 1] - until[bead])
        position[label, under] = k
    # dart 2 k is edge k, from visit k to the next, walked forwards; dart 2 k + 1 is walked back
    onwards = np.empty(2 * count, np.int64)
    for label in range(len(table)):
        for under in range(2):
            here, there = position[label, under], position[label, 1 - under]
            # of a positive crossing the lower strand leads to the left, as seen along the upper one
            left = (table[label, CROSSING.sign] > 0) != (under == 1)
            outwards, back = 2 * there, 2 * ((there - 1) % count) + 1
            # a left turn, arriving forwards and arriving backwards
            onwards[2 * ((here - 1) % count)] = outwards if left else back
            onwards[2 * here + 1] = back if left else outwards
    smallest = np.inf
    for first in range(2 * count):
        dart, area = first, 0.0
        while onwards[dart] >= 0:
            k = dart // 2
            swept = at[k + 1] - at[k] if k + 1 < count else at[0] + until[beads] - at[k]
            area += -swept if dart % 2 else swept
            onwards[dart], dart = -1, onwards[dart]
            if dart == first:
                smallest = min(smallest, abs(area) / 2)
    return smallest


@inner
def _average_crossing_number(points: Array) -> float:
    """Return the number of crossings averaged over all directions of view.

    Source: Banchoff's solid angles, in the form of Klenin and Langowski, 2000 (method 1a).
    """
    # Two segments cross in the picture for directions in a solid angle W and its opposite, which
    # together are 2 W / (4 pi) of the sphere. Neighbours never cross. The directions from ab to cd
    # fill a spherical quadrilateral with the corners c - a, d - a, d - b, c - b; its area is the
    # sum of the arcsines of the products of successive normals of its sides (the angles less
    # pi / 2 each). A side's normal is that of the plane through a vertex and an edge, or opposite.
    beads, total = len(points), 0.0
    normals = np.empty((beads, beads, 3))
    for i in range(beads):
        for j in range(beads):
            _put_normal(points, i, j, normals[i, j])
    for i in range(beads):
        b = (i + 1) % beads
        for j in range(i + 2, beads if i > 0 else beads - 1):
            d = (j + 1) % beads
            n0, n1, n2, n3 = normals[i, j], normals[d, i], normals[b, j], normals[j, i]
            angle = _arcsine(n0, n1) - _arcsine(n1, n2) + _arcsine(n2, n3) - _arcsine(n3, n0)
            total += abs(angle)
    return total / (2 * math.pi)


@inner
def _put_normal(points: Array, vertex: int, edge: int, out: Array) -> None:
    """Put the unit normal of a vertex and an edge, or zeros if they are on one line."""
    p, q, r = points[vertex], points[edge], points[(edge + 1) % len(points)]
    a, b, c = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    u, v, w = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    x, y, z = b * w - c * v, c * u - a * w, a * v - b * u
    size = np.sqrt(x * x + y * y + z * z)
    # below `least` the direction is rounding error; collinear points must add nothing
    least = 1e-12 * np.sqrt((a * a + b * b + c * c) * (u * u + v * v + w * w))
    if size > least:
        out[0], out[1], out[2] = x / size, y / size, z / size
    else:
        out[0] = out[1] = out[2] = 0.0


@inner
def _arcsine(a: Any, b: Any) -> float:
    return np.arcsin(min(1.0, max(-1.0, a[0] * b[0] + a[1] * b[1] + a[2] * b[2])))
