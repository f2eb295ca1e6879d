"""A rope drawn from a Gauss code, without physics and without search.

The code's planar map is packed with circles (`circle_packing`), which draws it; the drawing is
eased until it reads well (`easing`); strands are lifted where they cross, and the curve is cut into
beads. The outer face, how roomy each face is, the base bead's place and the turn are drawn at
random: one code has many drawings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knotgym.common.configuration import check_numbers
from knotgym.common.errors import KnotgymError
from knotgym.drawing.circle_packing import packed
from knotgym.drawing.easing import EasingConfig, Integers, eased
from knotgym.drawing.planar_map import planar_map
from knotgym.rope.model import Array, InvalidCurve, Rope
from knotgym.topology.crossings import label
from knotgym.topology.diagrams import drawn, faces
from knotgym.topology.gauss import GaussCode

MOST_CROSSINGS = 16  # 100 beads have 3 for each edge then


class UndrawnCode(KnotgymError, RuntimeError):
    """This drawing of a code isn't one that a rope can lie in; another one may be."""


class TooManyCrossings(KnotgymError, ValueError):
    """A code with more crossings than the rope has room for."""

    def __init__(self, nx: int) -> None:
        super().__init__(
            f"a rope of this length is drawn with {MOST_CROSSINGS} crossings at most, got a code"
            f" with {nx}"
        )


@dataclass(frozen=True, kw_only=True)
class DrawingConfig:
    """How a code is drawn.

    Attributes:
        uneven: standard deviation of the logarithm of a face's share.
        outer: power of a face's number of edges that its chance to lie outside goes with.
        height: metres between the strands at a crossing.
        base: metres along the rope from the base bead to a crossing, at least, where there is
            room.
        easing: of the flat drawing.
    """

    uneven: float = 0.25
    outer: float = 3.0
    height: float = 0.014
    base: float = 0.03
    easing: EasingConfig = EasingConfig()

    def __post_init__(self) -> None:
        check_numbers(self, positive=("height",), non_negative=("uneven", "outer", "base"))


def drawn_curve(
    code: GaussCode,
    rng: np.random.Generator,
    rope: Rope | None = None,
    config: DrawingConfig | None = None,
) -> Array:
    """Draw a code once.

    Args:
        code: planar; one without chirality gets the first there is.
        rng: every draw comes from it.
        rope: the usual one if None.
        config: how.

    Returns:
        float64 (beads, 3), metres, a configuration of the rope that shows the code.

    Raises:
        NotPlanar: no closed curve shows the code.
        TooManyCrossings: it has more crossings than the rope has room for.
        UndrawnCode: this drawing came out too tight; the next may not.
    """
    rope, config, code = rope or Rope(), config or DrawingConfig(), drawn(code)
    if code.nx > MOST_CROSSINGS:
        raise TooManyCrossings(code.nx)
    if code.nx:
        flat, visits = _flat(code, rng, config)
        curve = _lifted(flat, visits, code, rng, rope.config.length, config)
    else:
        curve = rope.loop() * (1, rng.choice((-1, 1)), 1)
    turn = rng.uniform(0, 2 * np.pi)
    turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    curve[:, :2] = curve[:, :2] @ turned
    try:
        points = rope.from_curve(curve)
    except InvalidCurve as error:
        raise UndrawnCode(f"this drawing of {code.chiral!r} is too tight: {error}") from error
    if label(points) != code:
        raise UndrawnCode(f"this drawing of {code.chiral!r} shows {label(points).chiral!r}")
    return points


def _flat(
    code: GaussCode, rng: np.random.Generator, config: DrawingConfig
) -> tuple[Array, Integers]:
    """The flat curve, float64 (n, 2), of length 1, and where on it the visits are, int64."""
    sizes = np.array([len(walk) for walk in faces(code)], dtype=np.float64)
    chances = sizes**config.outer
    outer = int(rng.choice(len(sizes), p=chances / chances.sum()))
    shares = np.exp(config.uneven * rng.normal(size=len(sizes)))
    shares[outer] = 0.0
    of = planar_map(code, outer)
    at = packed(of.triangles, of.rim, of.nodes)[: of.walk.max() + 1]
    at, walk = eased(at, of.walk, of.left, of.right, shares, config.easing)
    visits = np.arange(2 * code.nx) * (len(walk) // (2 * code.nx))
    flat = at[walk]
    return flat / _steps(flat).sum(), visits


def _lifted(
    flat: Array,
    visits: Integers,
    code: GaussCode,
    rng: np.random.Generator,
    length: float,
    config: DrawingConfig,
) -> Array:
    """The curve in space, float64 (n + 1, 3), metres, from the base bead on.

    Between two visits its height goes from that of one to that of the other along a cosine.
    """
    flat = flat * length
    place = np.concatenate([[0.0], np.cumsum(_steps(flat))])
    ends = np.append(place[visits], place[-1])
    tops = np.sign(np.append(code.visits, code.visits[0])) * config.height / 2
    edge = np.repeat(np.arange(len(visits)), len(flat) // len(visits))
    share = (place[:-1] - ends[edge]) / np.diff(ends)[edge]
    z = tops[edge] + np.diff(tops)[edge] * (1 - np.cos(np.pi * share)) / 2
    curve = np.column_stack([flat, z])
    room = min(0.45 * (ends[-1] - ends[-2]), config.base)
    base = rng.uniform(ends[-2] + room, ends[-1] - room)
    before = int(np.searchsorted(place, base)) - 1
    onwards = (base - place[before]) / (place[before + 1] - place[before])
    after = curve[(before + 1) % len(curve)]
    start = curve[before] + onwards * (after - curve[before])
    return np.concatenate([start[None], np.roll(curve, -(before + 1), axis=0)])


def _steps(flat: Array) -> Array:
    """Lengths of a closed polyline's segments."""
    return np.asarray(np.linalg.norm(np.roll(flat, -1, axis=0) - flat, axis=1))
