"""Paint a photo of a rope, with the answers, and measure whether it can be read.

The rope is painted in two layers. Cut half-way between visits, it falls into arcs that each visit
one crossing; arcs that go over are the upper layer, arcs that go under are the lower one. Arcs of a
layer don't cross, so that the nearest piece at a pixel is all that is needed of each layer.

After a change run `pytest tests/photos/test_photo.py`: answers must be those of an outside
computation, at every size.
"""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.common import Ids, Stream
from knotgym.photos import photo_kernels as kernels
from knotgym.photos import view_kernels as views
from knotgym.photos.photo_look import (
    LOOKS,
    PHONE,
    SURFACES,
    WEAVES,
    Legibility,
    Photo,
    Rng,
    drawn_dyes,
)
from knotgym.rendering import Appearance, Drawn, levels_of, smooth_curve
from knotgym.topology import (
    CROSSING,
    Crossings,
    RopesCode,
    Symmetry,
    canonical,
    find_crossings,
    find_ropes_crossings,
)

Array = NDArray[Any]

_TAPE = (200, 30, 36)  # RGB, of the bead before the base
_EASES = (0.25, 0.1)  # see `smooth_curve`
ALL = np.empty((0, 2), np.int64)  # pixels, where some may be named


@dataclass(frozen=True, eq=False)
class Shot(Drawn):
    """A photo with its answers.

    Attributes:
        points: float64 (beads, 3), metres, in the camera's axes; what is computed from a rope seen
            from above, such as `find_crossings` and PD codes, is of this camera's view.
        crossings: of the points.
        line: float32 (beads, 3), x and y of the rope's axis at each vertex, px, and its height
            towards the camera above the centre of mass, metres.
        strands: uint8 (size, size), 0 where no rope is visible, else the edge of the PD code: edge
            k leads to visit k, and edge 1 passes the base. 1 everywhere without crossings.
        ropes: axes of the open ropes that are seen, from end to end or to the picture's edge,
            float32 (n, 3), px; none if the rope is closed and wholly seen.
        others: axes of the pieces of other ropes beside it, from the picture's edge on, float64
            (n, 2), px.
        met: numbers of the crossings that are seen.
        contrast, order, region: measured, see `Legibility`; infinity where nothing is to measure.
    """

    points: Array
    crossings: Crossings
    line: Array
    strands: NDArray[np.uint8]
    ropes: list[Array]
    others: list[Array]
    met: Ids
    contrast: float
    order: float
    region: float

    @property
    def legible(self) -> bool:
        """Whether a person can decide every crossing."""
        limits = LOOKS[self.look.look].limits
        return self.region > 0 and shows(limits, self.contrast, self.order)

    @property
    def seen(self) -> Ids:
        return self.met

    @property
    def code(self) -> RopesCode:
        """What the picture shows: the code of the closed rope, or of all open ones."""
        if not self.ropes:
            return RopesCode.of(self.crossings.code)
        return find_ropes_crossings([rope * (1, -1, 1) for rope in self.ropes], False).code

    @property
    def columns(self) -> dict[str, Any]:
        """The columns of photos."""
        names, visible = ("x", "y", "width", "height"), range(1, max(2 * len(self.pixels), 1) + 1)
        boxes = [cv2.boundingRect((self.strands == k).view(np.uint8)) for k in visible]
        shared, look = vars(Appearance()), dict(vars(self.look))
        phone = {name: look.pop(name) for name in PHONE} | {"cuts": list(self.look.cuts)}
        photo = {name: value for name, value in look.items() if name not in shared}
        photo |= {"ground": list(self.look.ground), "rope_width": 2 * self.look.radius}
        photo |= {name: getattr(self, name) for name in ("contrast", "order", "region")}
        return {
            "canonical_code": str(canonical(self.crossings.code, Symmetry.DIAGRAM)),
            "strands": self.strands,
            "boxes": [{"strand": k, **dict(zip(names, box, strict=True))}
                      for k, box in zip(visible, boxes, strict=True)],
            "line": self.line.ravel().tolist(),
            "photo": photo,
            **({"ropes_code": str(self.code), "phone": phone} if self.look.free else {}),
        }  # fmt: skip


class PhotoRope:
    """The smooth rope, centred, and its crossings; `parts` pieces for each bead."""

    def __init__(self, points: Array, size: int, crossings: Crossings | None = None) -> None:
        # a copy: the photo's answers hold it, and callers may change theirs
        self.points, self.size = np.array(points, dtype=np.float64), size
        self.parts = min(-(-size // 128), 3)
        self.crossings = crossings or find_crossings(self.points)
        flat = self.points - self.points.mean(axis=0)
        self.curve, self.shown = smooth_curve(flat, self.crossings.code, self.parts, _EASES)
        self.kept = np.ones(len(self.curve), bool)
        self.table = self.shown.table.copy()  # numba compiles again for read-only arrays

    def cut(self, cuts: Sequence[float], squeeze: float) -> "PhotoRope":
        """Squeeze the rope, and take away the pieces between shares of the vertices, two each."""
        if not cuts and squeeze == 1:
            return self
        rope, n = copy(self), len(self.curve)
        rope.kept, rope.curve = self.kept.copy(), self.curve * (squeeze, 1.0, 1.0)
        for begin, end in zip(cuts[::2], cuts[1::2], strict=True):
            rope.kept[np.arange(round(begin * n), round(end * n)) % n] = False
        return rope

    def extent(self, turn: float, scale: float) -> tuple[tuple[float, float], ...]:
        """Return the least and the largest x, and y down, of what is kept in the picture."""
        turned = math.cos(turn) * scale, math.sin(turn) * scale
        return views.extent(self.curve, self.kept, *turned)


class PhotoView:
    """The rope in a picture: its axis in pixels, and the nearest pieces at every pixel.

    Attributes:
        curve, along, walked, seen, met, visits, order, lengths, sines, after, apart: as
            `view_kernels.trace` finds them; base_spacing is its `base`.
        places: float64 (nx, 2), of the upper and the lower strand of crossings that are seen.
        square, place: as `photo_kernels.stamp` finds them, after `stamp`.
        inner, outer: pixels (n, 2), x and y, on the rope, and on the background beside each; after
            `stamp`.
        middles, spots: as `view_kernels.crossing_pixels` finds them, after `stamp`.
    """

    def __init__(self, rope: PhotoRope, look: Photo) -> None:
        self.rope, self.size = rope, look.size
        self.unit = max(look.size / 256, 1.0)
        self.limits, self.free = LOOKS[look.look].limits, look.free
        turned = math.cos(look.turn) * look.scale, math.sin(look.turn) * look.scale
        placed = look.scale, 0.5 * look.size + look.right, 0.5 * look.size + look.down
        traced = views.trace(
            rope.curve, rope.kept, rope.table, (*turned, *placed), look.size, self.free
        )
        self.curve, self.along, self.walked, self.seen, self.met, *of_visits = traced
        self.visits, self.order, self.lengths, self.sines, *measured = of_visits
        self.after, self.apart, self.base_spacing = measured
        self.places = rope.table[self.met, : CROSSING.under_place + 1]
        self.whole = bool(self.seen.all())
        self.runs = [] if self.whole else _runs(self.seen)

    def stamp(self, radius: float) -> None:
        """Find the nearest pieces of a rope of this radius, px, and the pixels to measure."""
        self.radius = radius
        self.square = np.full((2, self.size, self.size), kernels.FAR, np.float32)
        self.place = np.empty_like(self.square)
        flags = kernels.layers(self.visits, self.order < len(self.met), len(self.curve))
        kernels.stamp(self.curve, self.after, flags, _reach(radius), self.square, self.place)
        line = self.curve, self.along
        self.inner, self.outer = views.beside(*line, self.seen, self.square, radius)
        pixels = views.crossing_pixels(*line, self.sines, self.places, radius, self.size)
        self.middles, self.spots = pixels

    def region(self, width: float) -> float:
        """Return the smallest region beside a rope of this width, px; 0 if it isn't legible."""
        limits = self.limits
        gap = limits.gap * self.unit
        if (
            (self.sines < math.sin(math.radians(limits.angle))).any()
            or self.apart < 1.5 * width + gap
            or views.is_folded(self.along, self.walked, self.seen, width)
            or not (self._has_room(width, gap) if self.free else self._is_apart(width, gap))
        ):
            return 0.0
        radius = 0.5 * width
        near = min((radius + 0.5 * gap) ** 2, _reach(radius) ** 2)
        count, area, canvas = views.regions(self.curve, self.after, near, radius, self.size)
        # By Euler a closed curve with nx crossings has nx + 2 faces; with fewer, the rope fills
        # one, with more, it cuts one in two. Open ropes have fewer, the parts of a drawing more, of
        # which the frame and the ropes that it cuts are one.
        faces = len(self.met) + 2
        if not self.whole:
            framed = np.pad(canvas, 1, constant_values=1)
            parts = cv2.connectedComponents(framed, connectivity=4, ltype=cv2.CV_16U)[0] - 1
            faces += parts - 2 + sum(self._leaves(run) for run in self.runs) - len(self.runs)
        least = min(area, float(self.size**2)) / self.unit**2
        return least if count == faces and least >= limits.region else 0.0

    def _is_apart(self, width: float, gap: float) -> bool:
        """Return whether a gap is between strands, but for those of one bend or crossing."""
        most = width + gap
        apart = views.nearest_strand(self.curve, self.rope.table, 4.5 * width, most)
        return bool(apart >= most)

    def _leaves(self, run: Ids) -> int:
        """Return how many ends of a rope are where the picture's edge cuts it."""
        return int(self.rope.kept[run[0] - 1]) + int(self.rope.kept[run[-1]])

    def away(self, vertex: int) -> Array:
        """Return the lengths along the rope to a vertex, px."""
        half = 0.5 * self.walked[-1]
        away = (self.walked[:-1] - self.walked[vertex] + half) % self.walked[-1] - half
        return np.abs(away)

    def _has_room(self, width: float, gap: float) -> bool:
        """Return whether crossings, ends and the picture's edge leave each other room."""
        flat = self.curve[:, :2].astype(np.float64)
        # half of the length over which strands of this width lie on each other at a crossing
        half = 0.5 * width * (1 + np.sqrt(1 - self.sines**2)) / self.sines
        halves = np.concatenate([half, half])[self.order]
        steps = np.diff(self.lengths, append=self.lengths[:1] + self.walked[-1])
        if (steps < halves + np.roll(halves, -1) + gap).any():
            return False
        if self.whole:
            return True
        owner, least = np.full(len(flat), -1), max(3 * width, 24 * self.unit)
        for k, run in enumerate(self.runs):
            owner[run] = k
            if np.hypot(*np.diff(flat[run], axis=0).T).sum() < least:
                return False
        nearest = np.full(len(flat), np.inf)
        for k, run in enumerate(self.runs):
            for tip in run[[0, -1]]:
                away = self.away(tip)
                nearest = np.minimum(nearest, away)
                mine = (owner == k) & (away < 2.5 * width)
                touched = np.hypot(*(flat - flat[tip]).T) < 1.2 * width + gap
                if (touched & (owner >= 0) & ~mine).any():
                    return False
        # what is half seen at the edge is a rope that leaves there, and doesn't come back at once
        hidden = self.rope.kept & (owner < 0)
        grazes = np.maximum(-flat, flat - self.size).max(axis=1) < 0.5 * width + gap
        back = any(grazes[run].all() for run in _runs(hidden))
        return (
            bool(self.runs) and not back and not (grazes & hidden & (nearest > 2.5 * width)).any()
        )

    def coloured(self, look: Photo, ground: Array, rng: Rng) -> Photo:
        """Choose the first of 24 colours that stands out from the ground, or the best.

        Beside the rope, the ground is in the light on one side, in the rope's shadow on the other.
        """
        x, y = self.outer[::3].T
        dyes = drawn_dyes(rng, 24)
        # Less than shading leaves of a dye on average (of 80 photos: 0.81 with the grooves of a
        # twist, else 0.92), so that what fits here nearly always fits in the picture: 110 of 129
        # views are legible with their first appearance. The same holds for 6 and 2.6 below.
        rope = _lab((0.66 if look.twisted else 0.8) * dyes)
        behind = ground[y, x].astype(np.float64)
        lit, shaded = _lab(behind), _lab((1 - 0.55 * look.shadow) * behind)
        apart = [_lengths(rope[:, None] - one) for one in (lit, shaded)]
        contrast = np.min([_low_of(lengths) for lengths in apart], axis=0)
        # where the rope is dark, shadows don't show which strand is over
        limits = self.limits
        fits = (contrast > limits.contrast + 6) & (rope[:, 0] * look.shadow > 2.6 * limits.order)
        best = int(np.argmax(fits)) if fits.any() else int(np.argmax(contrast + rope[:, 0]))
        first = second = dyes[best]
        if look.twisted and rng.random() < 0.3:
            second = first * rng.uniform(0.6, 0.9)
        return replace(look, first=levels_of(first), last=levels_of(second))


def _runs(seen: NDArray[np.bool_]) -> list[Ids]:
    """Return the vertices of each run of pieces round a closed curve; none if all are seen."""
    start = int(np.argmin(seen))
    turned = np.roll(seen, -start) & ~seen.all()
    changes = np.flatnonzero(np.diff(turned.astype(int), append=0)) + 1
    pairs = zip(changes[::2], changes[1::2], strict=True)
    return [(np.arange(begin, end + 1) + start) % len(seen) for begin, end in pairs]


def _reach(radius: float) -> float:
    """Return how far from its axis the rope and its shadows reach, px."""
    return 1.8 * radius + 1.5


def ground_of(look: Photo, dots: Ids = ALL) -> tuple[Array, Array, Rng]:
    """Paint the surface with its clutter, or some pixels of it.

    Returns:
        The picture, the random texture of all patterns, and what draws all else in the photo.
    """
    rng = Stream.IMAGE_GRAIN.generator(look.seed)
    # drawn for gradients too, so that what follows is the same on every surface
    texture = rng.random((64, 64), dtype=np.float32)
    small = min(look.size, 256)  # surfaces are no finer than that
    cell = look.grain * small / 256
    lean = math.radians(look.heading) - look.turn  # in the picture, y up
    c, s, tilt = math.cos(lean), math.sin(lean), math.cos(math.radians(look.tilt))
    # a surface seen at a slant is shortened along the leaning, so its pattern is, too
    flat = np.array([[c / tilt, -s / tilt], [s, c]])  # along the leaning, stretched; across it
    turn = math.radians(look.grain_turn) + lean
    axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    axes = axes @ flat / cell
    # a gradient has its middle in the middle of the picture; other patterns begin anywhere
    start = rng.uniform(0, 64, 2) * (look.surface != "gradient") - axes.sum(axis=1) * small / 2
    picture = np.empty((small, small, 3), np.uint8)
    ends = [np.array(colours, np.float32) for colours in (look.background, look.ground)]
    kind = SURFACES.index(look.surface)
    placed = np.column_stack([axes, start]).astype(np.float32)
    kernels.surface(picture, kind, texture, placed, *ends, dots if small == look.size else ALL)
    if small < look.size:
        picture = np.asarray(cv2.resize(picture, (look.size, look.size)))
    if look.clutter:
        middles = rng.uniform(0, look.size, (look.clutter, 2))
        reach = rng.uniform(0.04, 0.2, look.clutter) * look.size
        mixed = 0.5 * (ends[0] + ends[1]) + 0.5 * (drawn_dyes(rng, look.clutter) - 128)
        _lay(picture, look, middles, reach, np.clip(mixed, 0, 255), rng)
    return picture, texture, rng


def _lay(
    picture: Array, look: Photo, middles: Array, reach: Array, colours: Array,
    rng: Rng
) -> Array:  # fmt: skip
    """Lay polygons and discs on a picture; return where they are, uint8 (size, size)."""
    sides, outlines = 12, np.empty((len(middles), 13, 3), np.float32)
    outlines[:, 0] = np.column_stack([middles, reach])
    for outline, far in zip(outlines, reach, strict=True):
        corners = (3, 4, 4, 5, 6, 12)[rng.integers(6)]
        angles = rng.uniform(0, 2 * np.pi) + 2 * np.pi * (np.arange(sides) % corners) / corners
        # A regular polygon's sides are cos(pi / corners) of its reach from the middle; with twelve,
        # 0.97, it passes for a disc.
        off = far * (math.cos(math.pi / corners) if corners < 12 else 0.97)
        slim = np.where(np.arange(sides) % corners % 2, rng.uniform(0.5, 1.0), 1.0)
        outline[1:] = np.column_stack([np.cos(angles), np.sin(angles), off * slim])
    light, hidden = look.light, np.zeros(picture.shape[:2], np.uint8)
    shift = (-0.012 * look.size * light[:2]).astype(np.float32)
    kernels.shapes(picture, hidden, outlines, colours.astype(np.float32), shift, 0.5 * look.shadow)
    return hidden


def painted(view: PhotoView, look: Photo, region: float, rng: Rng | None = None) -> Shot:
    """Paint the rope and what lies beside and on it on the ground, and measure the picture.

    Args:
        view: stamped with the radius of the rope.
        look: the appearance.
        region: as `PhotoView.region` measured it.
        rng: draws the rope's colours, and a picture that can't be read is not exposed; None to
            leave those of the appearance.
    """
    rope, (picture, texture, grain) = view.rope, ground_of(look)
    if rng is not None:
        look = view.coloured(look, picture, rng)
    strands, others = _compose(view, look, picture, texture, grain)
    if look.occluders:
        # what is covered is visible no more
        strands[_occlude(view, look, picture, grain) > 0] = 0
    if look.blur > 0.2:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), look.blur))
    contrast, order = _contrasts(view, picture)
    line = view.curve[:: rope.parts].copy()
    line[:, 2] = rope.curve[:: rope.parts, 2]
    ropes = [view.curve[run] for run in view.runs]
    answers = view.middles, rope.points, rope.crossings, line, strands, ropes, others, view.met
    if rng is None or shows(view.limits, contrast, order):
        picture = _exposed(picture, look)
    return Shot(picture, look, *answers, contrast, order, region)


def is_clear(view: PhotoView, look: Photo) -> bool:
    """Whether an appearance without clutter shows a rope, which is stamped, with its order."""
    # only the pixels that are measured are painted
    pixels = np.concatenate([view.inner, view.outer, view.spots.reshape(-1, 2)])
    dots = views.distinct(pixels, view.size)
    picture, texture, grain = ground_of(look, dots)
    _compose(view, look, picture, texture, grain, dots)
    return shows(view.limits, *_contrasts(view, picture))


def shows(limits: Legibility, contrast: float, order: float) -> bool:
    """Whether rope and background, and the strands at crossings, differ enough."""
    return contrast >= limits.contrast and order >= limits.order


def _compose(
    view: PhotoView, look: Photo, picture: Array, texture: Array, rng: Rng, dots: Ids = ALL
) -> tuple[Array, list[Array]]:
    """Paint the rope on a picture, or on some pixels; return the strands that are visible, and the
    axes of pieces of other ropes.
    """
    n, strands = len(view.curve), np.zeros(picture.shape[:2], np.uint8)
    colours = np.empty((n, 2, 3), np.float32)
    colours[:, 0], colours[:, 1] = look.first, look.last
    if look.marked:
        colours[: view.rope.parts], colours[-view.rope.parts :] = 240, _TAPE
    for k, run in enumerate(view.runs if look.mixed else ()):
        colours[run] = np.roll(colours[run[0]], k, axis=-1)
    # whipping, or the tape that joins a closed rope
    tips = [int(tip) for run in view.runs for tip in run[[0, -1]]] or [0]
    for tip in tips if look.whipping else ():
        colours[view.away(tip) < look.whipping * 2 * view.radius] = 255 - 0.9 * colours[tip, 0]
    curve, after, others = view.curve, view.after, list[Array]()
    if look.others:
        curve, after, colours, others = _with_others(view, look, colours, rng)
    tangent, length = views.shape(curve, after)
    weave = WEAVES.index(look.weave) if look.weave else int(look.twisted)
    turns = max(round(length[n] / (2 * look.pitch * view.radius)), 1)  # whole, to have no seam
    grown = 3.0 * view.radius * n / length[n]
    lamp = view.radius, look.gloss, look.ambient, look.shadow, *look.light
    kernels.compose(
        picture, strands, view.visits, view.square, view.place, curve, after,
        tangent, (length * turns / length[n]).astype(np.float32), colours,
        np.array(lamp, np.float32), weave, texture, grown, n, dots
    )  # fmt: skip
    return strands, others


def _exposed(picture: Array, look: Photo) -> Array:
    """Add what the lamp and the camera do to a picture, which is changed."""
    gain = look.exposure * np.array([1 + 0.5 * look.warmth, 1.0, 1 - 0.5 * look.warmth])
    slope = np.array([*look.falloff * look.light[:2], look.corners], np.float32)
    kernels.expose(picture, gain.astype(np.float32), slope, look.noise, look.seed)
    if look.jpeg < 100:
        quality = [cv2.IMWRITE_JPEG_QUALITY, look.jpeg]
        _, packed = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), quality)
        picture = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR_RGB))
    return picture


def _with_others(
    view: PhotoView, look: Photo, colours: Array, rng: Rng
) -> tuple[Array, Array, Array, list[Array]]:
    """Lay pieces of other ropes that come in from the picture's edge and touch nothing."""
    curve, after, size, seen = view.curve, view.after, look.size, list[Array]()
    space = 2 * view.radius + 9.0 * view.unit  # between axes, px
    first = _lab(np.array([look.first], np.float64))
    for _ in range(look.others):
        dyes = drawn_dyes(rng, 8)
        dye = dyes[int(np.argmax(np.linalg.norm(_lab(dyes) - first, axis=1) > 15))]
        side, start = rng.integers(4), rng.uniform(0.1, 0.9)
        x, y = ((start, 0.0), (1.0, start), (start, 1.0), (0.0, start))[side]
        bends = np.cumsum(0.3 * rng.uniform(-1, 1, 60)) * 0.3 + rng.uniform(-0.6, 0.6)
        angles = math.pi / 2 * (1 + side) + np.cumsum(0.08 * bends)
        steps = 0.014 * size * np.column_stack([np.cos(angles), np.sin(angles)])
        # it begins outside the picture
        path = np.array([x, y]) * size - 2 * steps[0] + np.cumsum(steps, axis=0)
        apart = np.linalg.norm(path[:, None] - curve[None, :, :2], axis=2).min(axis=1)
        # up to the first point that is too near anything; the 0 behind the last is for paths that
        # never are
        path = path[: int(np.argmax(np.append(apart, 0.0) < space))]
        if len(path) < 8:
            continue
        n, last = len(curve), len(curve) + len(path)
        inside = np.all((path >= 0) & (path < size), axis=1)
        seen += [path[run[:-1]] for run in _runs(inside)]
        curve = np.concatenate([curve, np.column_stack([path, np.zeros(len(path))])])
        curve = curve.astype(np.float32)
        after = np.concatenate([after, np.arange(n + 1, last), [last - 1]])
        colours = np.concatenate([colours, np.tile(dye, (len(path), 2, 1)).astype(np.float32)])
    # only the new pieces are stamped; where they and the rope are near, nearest wins
    new = np.where(np.arange(len(curve)) < len(view.curve), np.arange(len(curve)), after)
    flags = np.full(len(curve), kernels.UNDER, np.uint8)
    kernels.stamp(curve, new, flags, _reach(view.radius), view.square, view.place)
    return curve, after, colours, seen


def _occlude(view: PhotoView, look: Photo, picture: Array, rng: Rng) -> Array:
    """Lay things on single straight strands; return where they are."""
    flat, n, chosen = view.curve[:, :2], len(view.curve), list[tuple[int, float]]()
    # eight places are tried for each thing; if none is fit, there are fewer
    for _ in range(8 * look.occluders):
        k, reach = int(rng.integers(n)), float(rng.uniform(1.2, 2.0)) * view.radius + 3.0
        clear = 1.5 * (reach + view.radius + 3.0)
        near = np.flatnonzero(_lengths(flat - flat[k]) < clear)
        apart = np.abs(near - k)
        apart = np.minimum(apart, n - apart)
        taken = [abs(k - other) < n // 20 for other, _ in chosen]
        base = min(k, n - k) < n // 20 and look.marked
        # all that is near is this strand, and it is straight
        far = int(clear * n / view.walked[-1]) + 1
        bend = (view.along[k - far] * view.along[(k + far) % n]).sum()
        if apart.max() < 1.5 * far and bend > 0.8 and not any(taken) and not base:
            chosen.append((k, reach))
        if len(chosen) == look.occluders:
            break
    ks, reaches = [k for k, _ in chosen], np.array([far for _, far in chosen])
    colours = drawn_dyes(rng, len(ks)) * rng.uniform(0.4, 1.0, (len(ks), 1))
    return _lay(picture, look, flat[ks].astype(np.float64), reaches, colours, rng)


def _contrasts(view: PhotoView, shown: Array) -> tuple[float, float]:
    """Measure contrast and order of a picture without noise; see `Legibility`."""
    m, pixels = len(view.inner), (view.inner, view.outer, view.spots.reshape(-1, 2))
    x, y = np.concatenate(pixels).T
    seen = _lab(shown[y, x])
    rope, behind, seen = seen[:m], seen[m : 2 * m], seen[2 * m :].reshape(9, -1, 3)
    # averaged along the rope, so that a twist's grooves don't count as its colour
    rope = cv2.blur(rope, (1, 5))
    contrast = float(_low_of(_lengths(rope - behind)))
    if not len(view.met):
        return contrast, math.inf
    apart = _lengths(seen[3:] - seen[:3].mean(axis=0)).reshape(2, 3, -1)
    return contrast, float(apart.max(axis=1).min())


def _lab(colours: Array) -> Array:
    """Return CIELAB (n, 3) of RGB levels (n, 3), with a and b at half weight."""
    # OpenCV keeps L, which is 0 to 100, in 0 to 255
    levels = np.minimum(np.maximum(colours, 0), 255).astype(np.uint8)
    return cv2.cvtColor(levels[None], cv2.COLOR_RGB2LAB)[0] * np.array([100 / 255, 0.5, 0.5])


def _lengths(vectors: Array) -> Array:
    """Return the lengths of vectors along the last axis, which NumPy is slow to sum over."""
    return np.sqrt(sum(np.square(vectors[..., k]) for k in range(vectors.shape[-1])))


def _low_of(values: Array) -> Array:
    """Return the value that a twentieth of the last axis is below."""
    # a twentieth may be dark, such as specks and ends of clutter; only one order statistic, so no
    # sort
    k = values.shape[-1] // 20
    return np.partition(values, k, axis=-1)[..., k]
