"""Draw a rope from a Gauss code, without simulation and without search.

A circle packing of the code's planar map gives a straight-line drawing (`circle_packing`), which is
relaxed until it is easy to read (`layout_relaxation`). Then the strands are lifted or lowered where
they cross, and the curve is cut into beads. The outer face, the relative sizes of the faces, the
position of the base bead and the rotation are random, so one code has many drawings.

After a change run `pytest tests/drawing`, then `knotgym generate --no-demonstrations --nx 0-4
--every-code 1`: all 401 codes must be drawn.
"""

import math

import numpy as np

from knotgym.common import Array, Failed, Ids, InvalidInput
from knotgym.drawing.circle_packing import pack_circles, planar_map, sin_cos
from knotgym.drawing.drawing_config import DrawingConfig
from knotgym.drawing.layout_relaxation import relax_layout
from knotgym.rope import Rope
from knotgym.topology import GaussCode, faces, label, with_chirality

# Of 40 random codes drawn once on 100 beads, 18 fit with 6.25 beads per edge (8 crossings), 9 with
# 5, 4 with 4.2 and none with 3.6: with fewer than three nothing is worth trying.
_LEAST_BEADS = 3  # per edge
_LOG_2 = 0.6931471803691238, 1.9082149292705877e-10  # log 2 as a sum of two floats


def drawn_curve(
    code: GaussCode,
    rng: np.random.Generator,
    rope: Rope | None = None,
    config: DrawingConfig | None = None,
) -> Array:
    """Draw a code once.

    Args:
        code: a planar code; without chirality it gets one from `diagrams.with_chirality`.
        rng: source of all randomness.
        rope: the rope to draw; `Rope()` if None.
        config: settings; `DrawingConfig()` if None.

    Returns:
        float64 (beads, 3), metres, a configuration of the rope that shows the code.

    Raises:
        InvalidInput: no closed curve shows the code.
        InvalidInput: there are fewer than three beads for each edge of the code.
        Failed: this drawing is too tight for the rope or shows another code; try again.
    """
    rope, config, code = rope or Rope(), config or DrawingConfig(), with_chirality(code)
    if 2 * code.nx * _LEAST_BEADS > rope.config.beads:
        raise InvalidInput(
            f"a rope of {rope.config.beads} beads is long enough for"
            f" {rope.config.beads // (2 * _LEAST_BEADS)} crossings at most, got a code with"
            f" {code.nx}"
        )
    if code.nx:
        flat, visits = _flat(code, rng, config)
        curve = _lifted(flat, visits, code, rng, rope.config.length, config)
    else:
        # the plain loop in either direction
        curve = rope.loop() * (1, rng.choice((-1, 1)), 1)
    turn = rng.uniform(0, 2 * np.pi)
    (sine, cosine), (x, y) = sin_cos(turn), curve.T[:2].copy()
    # written out, because `@` rounds by processor
    curve[:, 0], curve[:, 1] = cosine * x - sine * y, sine * x + cosine * y
    with Failed.instead(f"this drawing of {code.chiral!r} is too tight", InvalidInput):
        points = rope.from_curve(curve)
    if label(points) != code:
        raise Failed(f"this drawing of {code.chiral!r} shows {label(points).chiral!r}")
    return points


def _flat(code: GaussCode, rng: np.random.Generator, config: DrawingConfig) -> tuple[Array, Ids]:
    """Draw the code in the plane.

    Returns:
        flat: float64 (n, 2), a closed polyline of length 1.
        visits: int64 (2 nx,), its vertices that are the visits.
    """
    sizes = [len(walk) for walk in faces(code)]
    # a large face outside leaves the small ones room to grow inside
    # Python's powers, because NumPy's round by processor
    chances = np.array([size**config.outer for size in sizes])
    outer = int(rng.choice(len(sizes), p=chances / chances.sum()))
    drawn = config.uneven * rng.normal(size=len(sizes))
    shares = np.array([_exp(exponent) for exponent in drawn.tolist()])
    shares[outer] = 0.0
    of = planar_map(code, outer)
    # the nodes on the rope come first; those inside the faces have done their work
    at = pack_circles(of.triangles, of.rim, of.nodes)[: of.walk.max() + 1]
    at, walk = relax_layout(at, of.walk, of.left, of.right, shares)
    visits = np.arange(2 * code.nx) * (len(walk) // (2 * code.nx))
    flat = at[walk]
    return flat / _steps(flat).sum(), visits


def _lifted(
    flat: Array,
    visits: Ids,
    code: GaussCode,
    rng: np.random.Generator,
    length: float,
    config: DrawingConfig,
) -> Array:
    """Lift the flat curve, and choose the base point on the edge that leads to visit 0.

    Between two visits the height follows half a cosine wave from one visit's height to the other's.

    Returns:
        float64 (n + 1, 3), metres, starting at the base point.
    """
    flat = flat * length
    arc = np.concatenate([[0.0], np.cumsum(_steps(flat))])  # metres along the rope from visit 0
    ends = np.append(arc[visits], arc[-1])
    # both strands leave the plane by half the height, so the rope stays level on average
    tops = np.sign(np.append(code.visits, code.visits[0])) * config.height / 2
    # all edges have the same number of segments; `share` runs from 0 to 1 along each
    edge = np.repeat(np.arange(len(visits)), len(flat) // len(visits))
    share = (arc[:-1] - ends[edge]) / np.diff(ends)[edge]
    cosines = np.array([sin_cos(np.pi * part)[1] for part in share.tolist()])
    z = tops[edge] + np.diff(tops)[edge] * (1 - cosines) / 2
    curve = np.column_stack([flat, z])
    # 0.45: on a short edge, the base point stays in the middle tenth
    room = min(0.45 * (ends[-1] - ends[-2]), config.base)
    base = rng.uniform(ends[-2] + room, ends[-1] - room)
    before = int(np.searchsorted(arc, base)) - 1
    onwards = (base - arc[before]) / (arc[before + 1] - arc[before])
    after = curve[(before + 1) % len(curve)]
    start = curve[before] + onwards * (after - curve[before])
    return np.concatenate([start[None], np.roll(curve, -(before + 1), axis=0)])


def _steps(flat: Array) -> Array:
    """Return the segment lengths of a closed polyline."""
    return np.asarray(np.linalg.norm(np.roll(flat, -1, axis=0) - flat, axis=1))


def _exp(x: float) -> float:
    """Return the exponential of a number; libraries round it each in its own way."""
    twos = round(x / math.log(2))
    x = x - twos * _LOG_2[0] - twos * _LOG_2[1]
    series = 1.0
    for k in range(16, 0, -1):
        series = 1 + x / k * series
    return math.ldexp(series, twos)
