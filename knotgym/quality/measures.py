"""Computation of quality measures: how readable a state's picture is, and how twisted the rope.

`limits` defines the measures, their units and the limits for curated states.

After a change run `pytest tests/quality` and `knotgym dataset verify` on the sets that ship: the
measures that they store are computed again and must be the same.
"""

import hashlib
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from knotgym.common import Array, Stream, inner, kernel
from knotgym.quality.limits import RESET_NOISE, Quality
from knotgym.rendering import PictureConfig, project
from knotgym.rope import Rope
from knotgym.topology import Crossings, GaussCode, faces, find_crossings, label_many

# Two points of the drawn rope belong to different strands if the shortest path between them along
# the drawing is longer than this many pixels; a path may turn at crossings.
WALK = 12.0
# 64 draws put the 95 % interval of a share of 0.95 at 0.87 to 0.98; each costs a labelled curve.
NOISE_DRAWS = 64


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
        config: picture in which to measure; the usual one of such a rope if None.
        quick: leave out excess_crossing_number, which takes half of the time.

    Returns:
        All measures but noise_survival, which is computed by the function of that name; NaN for
        measures left out.
    """
    # a writable copy, because numba would compile the kernels again for a read-only array
    p = np.array(points, dtype=np.float64, order="C")
    crossings = find_crossings(p) if crossings is None else crossings
    config = PictureConfig.of(len(p)) if config is None else config
    size = float(config.size)
    pixels = np.ascontiguousarray(project(p, config))
    chord = np.roll(p, -1, axis=0) - p
    unit = chord / np.linalg.norm(chord, axis=1)[:, None]
    cosines = np.clip((unit * np.roll(unit, -1, axis=0)).sum(axis=1), -1, 1)
    bends = np.array([*map(math.acos, cosines.tolist())])  # NumPy's rounds by processor
    radius = config.rope_radius * config.pixels_per_metre
    regions = _regions(pixels, 2 * radius)
    at = crossings.position * config.pixels_per_metre
    apart = np.linalg.norm(at[:, None] - at[None, :], axis=2)[np.triu_indices(crossings.nx, 1)]
    visits = zip(crossings.over_place, crossings.under_place, strict=True)
    angles = np.array([_angle(p, over, under) for over, under in visits])
    spacing = crossings.strand_spacing(pixels, WALK)
    excess = float("nan") if quick else _average_crossing_number(p) - crossings.nx
    clearance = 1000 * float((crossings.over_z - crossings.under_z).min(initial=np.inf))
    return Quality(
        crossing_angle=float(angles.min(initial=90.0)),
        crossing_spacing=float(apart.min(initial=size)),
        base_spacing=float(base_spacing(p, crossings, config=config)[0]),
        strand_spacing=min(size, spacing),
        smallest_region=float(regions.min()) if len(regions) == crossings.nx + 2 else 0.0,
        smallest_face=float(_faces(pixels, crossings).min()),
        margin=float(min(pixels.min(), size - pixels.max()) - radius),
        clearance=min(clearance, 1000.0 * config.rope_radius * 4),
        excess_crossing_number=excess,
        total_curvature=float(bends.sum() / (2 * np.pi)),
        writhe=float(crossings.sign.sum()),
    )


def base_spacing(
    points: Array,
    crossings: Crossings,
    bases: Sequence[int] = (0,),
    config: PictureConfig | None = None,
) -> Array:
    """Return the distance along the drawing from base beads to the nearest crossing, pixels.

    Args:
        points: float64 (beads, 3), metres.
        crossings: those of the points.
        bases: base bead k is the one between the vertices bases[k] and bases[k] + 1; a crossing on
            it gives 0.
        config: picture in which to measure; the usual one if None.

    Returns:
        float64 (bases,).
    """
    config, beads = PictureConfig() if config is None else config, len(points)
    if not crossings.nx:
        return np.full(len(bases), float(config.size))
    pixels, found = project(points, config), np.empty(len(bases))
    lengths = np.linalg.norm(np.roll(pixels, -1, axis=0) - pixels, axis=1)
    visits = np.concatenate([crossings.over_place, crossings.under_place])
    for row, base in enumerate(bases):
        walked = np.cumsum(np.concatenate([[0.0], lengths[base:], lengths[:base]]))
        at = np.interp((visits - base) % beads, np.arange(beads + 1), walked)
        # forwards from the end of the base bead, and backwards from its start
        found[row] = max(0.0, min((at - walked[1]).min(), walked[-1] - at.max()))
    return np.minimum(found, config.size)


def noise_survival(
    points: ArrayLike,
    scale: float = RESET_NOISE,
    rng: np.random.Generator | None = None,
    draws: int = NOISE_DRAWS,
) -> float:
    """Return the fraction of draws of reset noise that keep the Gauss code and chirality.

    Args:
        points: float64 (beads, 3), metres.
        scale: of the noise, see `RESET_NOISE`.
        rng: generator of the noise; by default one that is seeded with a digest of the points, so
            that the fraction can be computed again from them alone.
        draws: number of draws.
    """
    p = np.asarray(points, dtype=np.float64)[None]
    if rng is None:
        seed = int.from_bytes(hashlib.sha256(p.tobytes()).digest()[:7], "little")
        rng = Stream.NOISE_SURVIVAL.generator(seed)
    varied = Rope.noised(np.repeat(p, draws, axis=0), scale, [rng] * draws)
    codes = label_many(np.concatenate([p, varied]))
    return float(np.mean([code == codes[0] for code in codes[1:]]))


def _angle(points: Array, over: float, under: float) -> float:
    """Return the angle in the picture between two crossing strands, degrees in [0, 90].

    Args:
        points: float64 (beads, 3), metres.
        over, under: positions of the two strands along the rope, beads.
    """
    beads = len(points)

    def _at(visit: float) -> Array:
        bead = int(np.floor(visit))
        here, after = points[bead % beads, :2], points[(bead + 1) % beads, :2]
        return np.asarray(here + (visit - bead) * (after - here))

    # directions over two beads, because a single bead's direction jumps at joints
    a, b = (_at(visit + 1) - _at(visit - 1) for visit in (over, under))
    # written out, because the last bit of `a @ b` depends on the processor
    cross, dot = a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]
    return math.degrees(math.atan2(abs(cross), abs(dot)))  # NumPy's rounds by processor


def _faces(pixels: Array, crossings: Crossings) -> Array:
    """Return the areas of all faces of the curve, the outer one included, square pixels."""
    # Shoelace formula: a face's area is half the sum of p x dp round its boundary. The sum is taken
    # once along the whole curve, and cut at the visits into the edges between them; inside a bead
    # it grows linearly.
    after = np.roll(pixels, -1, axis=0)
    swept = pixels[:, 0] * after[:, 1] - pixels[:, 1] * after[:, 0]
    until = np.concatenate([[0.0], np.cumsum(swept)])
    if not crossings.nx:
        return np.full(2, abs(until[-1]) / 2)
    visits = np.sort(np.concatenate([crossings.over_place, crossings.under_place]))
    bead = np.minimum(visits.astype(np.int64), len(pixels) - 1)
    at = until[bead] + (visits - bead) * swept[bead]
    edges = np.append(at[1:], at[0] + until[-1]) - at
    return np.asarray(np.abs(_borders(crossings.code) @ edges) / 2)


@lru_cache(maxsize=10_000)
def _borders(code: GaussCode) -> Array:
    """Return the incidence of edges and faces of a code's diagram.

    Returns:
        float64 (nx + 2, 2 nx): 1 where the face is to the left of the edge, -1 where it is to the
        right, 0 otherwise (or if both).
    """
    boundaries = faces(code)
    incidence = np.zeros((len(boundaries), 2 * code.nx))
    for row, darts in enumerate(boundaries):
        for dart in darts:
            incidence[row, dart // 2] += -1 if dart % 2 else 1
    return incidence


def _regions(pixels: Array, width: float) -> Array:
    """Return the areas of the background's connected regions, square pixels.

    The rope is drawn as a closed band of the given width, pixels, with `fine` dots to a pixel.
    """
    fine = 3
    # a border of 4 pixels keeps the outside connected
    low = np.floor(pixels.min(axis=0)) - 4
    high = np.ceil(pixels.max(axis=0)) + 4 - low
    canvas = np.ones((int(high[1] * fine), int(high[0] * fine)), dtype=np.uint8)
    corners = np.round((pixels - low) * fine * 16).astype(np.int32)  # 4 fractional bits
    # Background is 8-connected, so that a line of one dot would leak diagonally; two dots don't.
    cv2.polylines(canvas, [corners[:, None]], True, 0, max(2, round(width * fine)), cv2.LINE_8, 4)
    label = cv2.connectedComponentsWithStatsWithAlgorithm
    _, _, stats, _ = label(canvas, 8, cv2.CV_16U, cv2.CCL_BBDT)
    return np.asarray(stats[1:, cv2.CC_STAT_AREA] / fine**2)


@kernel
def _average_crossing_number(points: Array) -> float:
    """Return the number of crossings averaged over all directions of view.

    Source: Banchoff's solid angles, in the form of Klenin and Langowski, 2000 (method 1a).
    """
    # Two segments cross in the picture for directions in a solid angle W and its opposite, which
    # together are 2 W / (4 pi) of the sphere. Neighbours never cross.
    beads = len(points)
    total = 0.0
    for i in range(beads):
        a, b = points[i], points[(i + 1) % beads]
        for j in range(i + 2, beads if i > 0 else beads - 1):
            c, d = points[j], points[(j + 1) % beads]
            total += _solid_angle(a, b, c, d)
    return total / (2 * np.pi)


@inner
def _solid_angle(a: Array, b: Array, c: Array, d: Array) -> float:
    """Return the solid angle of directions in which segments ab and cd appear to cross."""
    # The directions from ab to cd fill a spherical quadrilateral with the corners c - a, d - a,
    # d - b, c - b; its sides have the normals n0 to n3, and its area is the sum of the arcsines of
    # the products of successive normals (the angles less pi / 2 each).
    n0, n1 = _normal(c - a, d - a), _normal(d - a, d - b)
    n2, n3 = _normal(d - b, c - b), _normal(c - b, c - a)
    return abs(_arcsine(n0, n1) + _arcsine(n1, n2) + _arcsine(n2, n3) + _arcsine(n3, n0))


@inner
def _normal(a: Array, b: Array) -> tuple[float, float, float]:
    """Return the unit vector along a x b, or zeros if a and b are parallel."""
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    size = np.sqrt(x * x + y * y + z * z)
    # below `least` the direction is rounding error; collinear points must add nothing
    aa, bb = a[0] * a[0] + a[1] * a[1] + a[2] * a[2], b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
    least = 1e-12 * np.sqrt(aa * bb)
    return (x / size, y / size, z / size) if size > least else (0.0, 0.0, 0.0)


@inner
def _arcsine(a: Any, b: Any) -> float:
    return np.arcsin(min(1.0, max(-1.0, a[0] * b[0] + a[1] * b[1] + a[2] * b[2])))
