"""Pictures of the rope as a camera shows it: one colour, on a table, with the answers.

`photograph` tilts the rope as a camera would see it and draws an appearance from a generator until
a person can decide every crossing (`LIMITS`); `take` makes the same picture again from the points
and the appearance. The camera is orthographic. From `tilted` on, points are in its axes: x right, y
up, z towards the camera. The Gauss code, the crossings and all answers are what it sees.

The rope is painted in two layers. Cut half-way between visits, it falls into arcs that each visit
one crossing; arcs that go over are the upper layer, arcs that go under are the lower one. Arcs of a
layer don't cross, so that the nearest piece at a pixel is all that is needed of each layer.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.common.streams import Stream, generator
from knotgym.rendering import photo_kernels as kernels
from knotgym.rendering.appearance import Appearance
from knotgym.rendering.appearance_config import TILT
from knotgym.rendering.camera import DEFAULT, RGB
from knotgym.rendering.strand_spacing import strand_spacing
from knotgym.topology.crossings import Crossings, find_crossings

Array = NDArray[Any]

SURFACES = ("cloth", "wood", "gradient", "noise")
BACKGROUNDS = (*SURFACES, "clutter", "ropes")
WIDTHS = (3.0, 12.0)  # of the rope, px
_TRIES = 12  # cameras
_DYES = (4, 14, 30, 48, 130, 205, 222, 280, 335)  # hues of dyed ropes, degrees
TAPE = (200, 30, 36)  # RGB, of the bead before the base


class Legibility(NamedTuple):
    """What a picture must show for a person to decide every crossing.

    Lengths are in pixels of pictures up to 256 pixels large, and grow with larger ones.

    Attributes:
        crossings: maximum.
        angle: smallest angle at a crossing, degrees.
        gap: background between strands that don't cross, px.
        region: smallest region enclosed by the rope, less half a gap at its border, square px.
        contrast: colour difference of rope and background (CIELAB, a and b at half weight), on all
            but a twentieth of the rope.
        order: the same, between the over strand at a crossing and the under strand beside it, at
            every crossing.
    """

    crossings: int = 12
    angle: float = 30.0
    gap: float = 2.0
    region: float = 14.0
    contrast: float = 18.0
    order: float = 14.0


LIMITS = Legibility()


@dataclass(frozen=True, kw_only=True)
class Photo(Appearance):
    """Appearance of a photo; with the points it determines every byte.

    `first` and `last` are the colours of the two strands of the rope, `background` is one of the
    two of the surface. Angles are in degrees, px256 are pixels of a 256-pixel picture.

    Attributes:
        colours: "photo".
        right, down: position of the rope's centre of mass relative to the picture's middle, px.
        tilt: angle between the line of sight and the vertical.
        heading: direction in which the camera leans, seen from above.
        marked: whether tape marks the base bead, white, and the bead before it, red.
        twisted: whether the rope is laid of two strands.
        pitch: length of one turn of the twist, widths of the rope.
        gloss: strength of the highlight.
        surface: one of SURFACES.
        grain: size of its pattern, px256; grain_turn: direction of it.
        ground: RGB, the other colour of the surface.
        clutter, others, occluders: flat shapes below the rope, pieces of other ropes, which touch
            nothing, and things on the rope, which hide no crossing.
        light_turn, light_height: direction that light comes from.
        ambient: share of light without direction.
        shadow: share of light that shadows take.
        falloff: change of light across the picture, a share.
        warmth: gain of red over blue, a share.
        exposure: gain.
        jpeg: quality; 100 for none.
    """

    colours: str = "photo"
    right: float = 0.0
    down: float = 0.0
    tilt: float = 0.0
    heading: float = 0.0
    marked: bool = False
    twisted: bool = False
    pitch: float = 3.0
    gloss: float = 0.1
    surface: str = "gradient"
    grain: float = 5.0
    grain_turn: float = 0.0
    ground: RGB = (40, 44, 52)
    clutter: int = 0
    others: int = 0
    occluders: int = 0
    light_turn: float = 225.0
    light_height: float = 50.0
    ambient: float = 0.5
    shadow: float = 0.7
    falloff: float = 0.0
    warmth: float = 0.0
    exposure: float = 1.0
    jpeg: int = 100

    @property
    def kind(self) -> str:
        """The kind of background, one of BACKGROUNDS."""
        return "ropes" if self.others else "clutter" if self.clutter else self.surface

    @property
    def scale(self) -> float:
        """Pixels per metre."""
        return self.zoom * self.size / DEFAULT.view

    @property
    def radius(self) -> float:
        """Radius of the rope, px."""
        return DEFAULT.rope_radius * self.width * self.scale


@dataclass(frozen=True, eq=False)
class Shot:
    """A photo with its answers.

    Attributes:
        image: uint8 (size, size, 3), RGB.
        look: its appearance.
        points: float64 (beads, 3), metres, in the camera's axes; what is computed from a rope seen
            from above, such as `find_crossings` and PD codes, is of this camera's view.
        crossings: of the points.
        pixels: float64 (nx, 2), x and y of the crossings, px, in order of labels.
        line: float32 (beads, 3), x and y of the rope's axis at each vertex, px, and its height
            towards the camera above the centre of mass, metres.
        strands: uint8 (size, size), 0 where no rope is visible, else the edge of the PD code: edge
            k leads to visit k, and edge 1 passes the base. 1 everywhere without crossings.
        contrast, order, region: measured, see `Legibility`; infinity where nothing is to measure.
    """

    image: NDArray[np.uint8]
    look: Photo
    points: Array
    crossings: Crossings
    pixels: Array
    line: Array
    strands: NDArray[np.uint8]
    contrast: float
    order: float
    region: float

    @property
    def legible(self) -> bool:
        """Whether a person can decide every crossing."""
        shown = self.contrast >= LIMITS.contrast and self.order >= LIMITS.order
        return self.region > 0 and shown


def photograph(
    points: Array,
    size: int,
    rng: np.random.Generator,
    *,
    tilt: float = TILT,
    marked: bool | None = None,
) -> Shot | None:
    """Draw a camera and an appearance until the picture is legible.

    Args:
        points: float64 (beads, 3), metres.
        size: side of the picture, pixels.
        tilt: largest tilt of the camera, degrees.
        marked: whether tape marks the base; None to draw it.

    Returns:
        None if no camera of several shows a legible picture.
    """
    for _ in range(_TRIES):
        lean, heading = drawn_camera(rng, tilt)
        seen = _Rope(tilted(points, lean, heading), size)
        shot = _drawn(seen, size, rng, lean, heading, marked)
        if shot is not None:
            return shot
    return None


def drawn_photo(
    points: Array, size: int, rng: np.random.Generator, tilt: float, heading: float, *, marked: bool
) -> Shot:
    """Draw a photo of points in the camera's axes that `clearest` shows to be legible.

    Args:
        tilt, heading: of the camera, degrees.
        marked: whether tape marks the base, where no crossing hides it.
    """
    rope = _Rope(points, size)
    for attempt in range(_TRIES):
        wanted = marked and attempt < _TRIES // 2
        shot = _drawn(rope, size, rng, tilt, heading, wanted)
        if shot is not None:
            return shot
    return clearest(points, size, tilt, heading)


def clearest(points: Array, size: int, tilt: float = 0.0, heading: float = 0.0) -> Shot:
    """Take the plainest photo: a narrow white rope on a dark surface, as large as the picture."""
    rope = _Rope(points, size)
    look = _framed(rope, size, 0.0, 1.0, np.zeros(2), tilt, heading)
    width = WIDTHS[0] / (2 * DEFAULT.rope_radius * look.scale)
    return take(points, replace(look, width=width, first=(235, 230, 220), last=(235, 230, 220)))


def drawn_camera(rng: np.random.Generator, tilt: float = TILT) -> tuple[float, float]:
    """Draw tilt and heading, degrees, evenly over the directions up to a tilt."""
    lean = math.degrees(math.acos(rng.uniform(math.cos(math.radians(tilt)), 1.0)))
    return lean, float(rng.uniform(0.0, 360.0))


def tilted(points: Array, tilt: float, heading: float) -> Array:
    """Return points (n, 3) in the axes of a camera that leans by `tilt` towards `heading`.

    >>> tilted(np.array([[0.0, 0.0, 1.0]]), 90.0, 0.0).round(9).tolist()  # seen from the right
    [[-1.0, 0.0, 0.0]]
    """
    t, h, (x, y, z) = math.radians(tilt), math.radians(heading), points.T
    c, s = math.cos(h), math.sin(h)
    # the direction of leaning is foreshortened, the one across it stays
    along, across = c * x + s * y, c * y - s * x
    along, height = math.cos(t) * along - math.sin(t) * z, math.sin(t) * along + math.cos(t) * z
    return np.stack([c * along - s * across, s * along + c * across, height], axis=1)


def projected(offset: Array, turn: float, scale: float) -> Array:
    """Return x and y down in the picture, and height, (n, 3), of positions in the camera's axes."""
    x, y, z = offset.T
    c, s = math.cos(turn) * scale, math.sin(turn) * scale
    return np.stack([c * x + s * y, s * x - c * y, scale * z], axis=1)


def take(points: Array, look: Photo) -> Shot:
    """Take the photo of points (beads, 3) in the camera's axes with an appearance."""
    rope = _Rope(points, look.size)
    rng = generator(Stream.IMAGE_GRAIN, look.seed)
    view, (texture, ground) = _View(rope, look), _ground(look, rng)
    region = view.region(2 * look.radius)
    if not region:
        view.stamp(look.radius)
    shot = _painted(rope, view, look, region, texture, ground, rng)
    return replace(shot, image=_exposed(shot.image, look))


def episode_look(points: Array, size: int, number: int) -> Photo:
    """Draw an appearance in which every state of an episode can be shown.

    The camera is vertical and tape marks the base, so that picture and code agree. The scale is
    that of `PictureConfig`, the rope as thick as it is, and nothing lies on it.

    Args:
        points: float64 (beads, 3), metres; the rope's colour stands out from the ground beside it.
        size: side of the picture, pixels.
        number: of the appearance.
    """
    rng = generator(Stream.EPISODE_LOOK, 0, number)
    look = replace(_looks(Photo(size=size), rng), marked=True, occluders=0)
    ground = _ground(look, generator(Stream.IMAGE_GRAIN, look.seed))[1]
    view = _View(_Rope(points, size), look)
    view.stamp(look.radius)
    return _coloured(look, view, ground, rng)


class _Rope:
    """The smooth rope, centred, and its crossings; `parts` pieces for each bead."""

    def __init__(self, points: Array, size: int) -> None:
        self.points, self.parts = points, min(-(-size // 128), 3)
        self.crossings, flat = find_crossings(points), points - points.mean(axis=0)
        n, t = len(points), (np.arange(self.parts) / self.parts)[:, None]
        before, after = np.arange(-1, n - 1), np.append(np.arange(1, n), 0)
        # vertices are eased towards their neighbours, as no rope bends at a point; less, or along
        # the polygon, where that would change the code
        for ease, bent in ((0.25, 1.0), (0.1, 1.0), (0.0, 1.0), (0.0, 0.0)):
            here = flat
            for _ in range(2 if ease else 0):
                here = here + ease * (here[before] + here[after] - 2 * here)
            step = here[after] - here
            slope = step - 0.5 * bent * (step - step[before])
            end = step + bent * (slope[after] - step)
            # the cubic through here and the next vertex, with these slopes at its ends
            square, cube = 3 * step - 2 * slope - end, slope + end - 2 * step
            parts = [one[:, None] for one in (here, slope, square, cube)]
            self.curve = (parts[0] + t * (parts[1] + t * (parts[2] + t * parts[3]))).reshape(-1, 3)
            self.shown = find_crossings(self.curve)
            if self.shown.code == self.crossings.code:
                return


class _View:
    """The rope in a picture: its axis in pixels, and the nearest pieces at every pixel.

    Attributes:
        curve: float32 (n, 3), x and y, and height in px.
        visits: float64 (2 nx,), sorted places of the visits, in pieces.
        square, place: as `photo_kernels.stamp` finds them, after `stamp`.
    """

    def __init__(self, rope: _Rope, look: Photo) -> None:
        self.unit, self.size, shown = max(look.size / 256, 1.0), look.size, rope.shown
        middle = 0.5 * look.size + np.array([look.right, look.down, -0.5 * look.size])
        curve = projected(rope.curve, look.turn, look.scale) + middle
        self.curve = curve.astype(np.float32)
        self.after = np.append(np.arange(1, len(self.curve)), 0)
        self.over, self.under = shown.over_place, shown.under_place
        places = np.concatenate([self.over, self.under])
        order = np.argsort(places)
        self.visits, self.goes_over = places[order], order < len(self.over)
        flat = self.curve[:, :2]
        step = flat[self.after] - flat
        self.along = step + step[self.after - 2]  # about twice the direction at each point
        self.along /= np.sqrt((self.along**2).sum(axis=1))[:, None]
        walked = np.append(0.0, np.cumsum(np.sqrt((step**2).sum(axis=1))))
        self.walked = walked
        visits = np.interp(self.visits, np.arange(len(walked)), walked)
        # lengths between consecutive visits; between the base and the nearest visit
        self.apart = np.diff(visits, append=visits[:1] + walked[-1]).min(initial=np.inf)
        self.base_spacing = np.minimum(visits, walked[-1] - visits).min(initial=np.inf)
        a, b = self.along[np.array([self.over, self.under]).astype(np.int64) % len(flat)]
        self.sines = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])

    def stamp(self, radius: float) -> None:
        """Find the nearest pieces of a rope of this radius, px."""
        self.radius = radius
        self.square = np.full((2, self.size, self.size), kernels.FAR, np.float32)
        self.place = np.empty_like(self.square)
        flags = kernels.layers(self.visits, self.goes_over, len(self.curve))
        kernels.stamp(self.curve, self.after, flags, _reach(radius), self.square, self.place)

    def region(self, width: float) -> float:
        """Draw a rope of this width, px; return its smallest region, 0 if it isn't legible."""
        gap = LIMITS.gap * self.unit
        if (self.sines < math.sin(math.radians(LIMITS.angle))).any():
            return 0.0
        if self.apart < 1.5 * width + gap:
            return 0.0
        # a fold whose arms touch can't be told from a small kink
        length = self.walked[-1]
        further = np.searchsorted(self.walked, (self.walked[:-1] + 2.0 * width) % length) - 1
        if ((self.along * self.along[further]).sum(axis=1) < -0.85).any():
            return 0.0
        # strands that touch but belong to one bend or crossing, at most so long, can be told apart
        flat = self.curve[:, :2].astype(np.float64)
        if strand_spacing(flat, self.over, self.under, 4.5 * width) < width + gap:
            return 0.0
        self.stamp(0.5 * width)
        near = (self.radius + 0.5 * gap) ** 2
        low = np.maximum(self.curve[:, :2].min(axis=0) - self.radius - 4, 0).astype(int)
        high = (self.curve[:, :2].max(axis=0) + self.radius + 5).astype(int)
        square = self.square[:, low[1] : high[1], low[0] : high[0]]
        free = ((square[0] > near) & (square[1] > near)).view(np.uint8)
        areas = cv2.connectedComponentsWithStats(free, connectivity=8, ltype=cv2.CV_16U)[2][1:, -1]
        least = float(areas.min()) / self.unit**2
        return least if len(areas) == len(self.over) + 2 and least >= LIMITS.region else 0.0

    def at(self, places: Array) -> Array:
        """Return x and y (n, 2) of places along the curve."""
        index = np.floor(places).astype(np.int64)
        n, part = len(self.curve), (places - index)[:, None]
        return (1 - part) * self.curve[index % n, :2] + part * self.curve[(index + 1) % n, :2]

    def beside(self) -> tuple[Array, Array]:
        """Return pixels (n, 2), x and y, on the rope, and on the background beside each."""
        inner = self.curve[::2, :2]
        off = (self.radius + 1.5) * self.along[::2, ::-1] * np.array([-1, 1], np.float32)
        inner, outer = np.concatenate([inner, inner]), np.concatenate([inner - off, inner + off])
        inner, outer = inner.astype(np.int64), outer.astype(np.int64)
        x, y = np.clip(outer, 0, self.size - 1).T
        free = self.square[:, y, x].min(axis=0) > (self.radius + 1) ** 2
        free &= (x == outer[:, 0]) & (y == outer[:, 1])
        return inner[free], outer[free]


def _reach(radius: float) -> float:
    """Return how far from its axis the rope and its shadows reach, px."""
    return 1.8 * radius + 1.5


def _drawn(
    rope: _Rope, size: int, rng: np.random.Generator, tilt: float, heading: float,
    marked: bool | None,
) -> Shot | None:  # fmt: skip
    """Draw frame and appearance of one view; None if it isn't legible."""
    if rope.shown.nx > LIMITS.crossings:
        return None
    turn, fill = rng.uniform(-math.pi, math.pi), rng.uniform(0.7, 1.0)
    look = _framed(rope, size, turn, fill, rng.uniform(-1.0, 1.0, 2), tilt, heading)
    view, widest = _View(rope, look), rng.uniform(*WIDTHS)
    # a rope that is illegible at its narrowest isn't looked at any further
    region = view.region(least := WIDTHS[0])
    for width in (widest, max(least, 0.6 * widest), least) if region else ():
        if region := view.region(width):
            break
    if not region:
        return None
    wanted = bool(rng.random() < 0.2) if marked is None else marked
    hidden = view.base_spacing < 1.5 * width
    if marked and hidden:
        return None
    width /= 2 * DEFAULT.rope_radius * look.scale
    look = replace(look, width=width, marked=wanted and not hidden)
    for _ in range(4):
        look = _looks(look, rng)
        grain = generator(Stream.IMAGE_GRAIN, look.seed)
        texture, ground = _ground(look, grain)
        look = _coloured(look, view, ground, rng)
        shot = _painted(rope, view, look, region, texture, ground, grain)
        if shot.legible:
            return replace(shot, image=_exposed(shot.image, look))
        if look.others:
            view.stamp(look.radius)
    return None


def _framed(
    rope: _Rope, size: int, turn: float, fill: float, place: Array, tilt: float, heading: float
) -> Photo:
    """Choose zoom and position: the rope fills a share of the picture's side, `place` of the rest.

    Args:
        fill: at most 1.
        place: (2,), right and down, from -1 to 1.
    """
    flat = projected(rope.curve, turn, size / DEFAULT.view)[:, :2]
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = size - WIDTHS[1] - 2.0
    zoom = fill * room / float((high - low).max())
    right, down = 0.5 * (room - zoom * (high - low)) * place - 0.5 * zoom * (low + high)
    frame: dict[str, Any] = {"zoom": zoom, "right": float(right), "down": float(down)}
    return Photo(size=size, turn=turn, tilt=tilt, heading=heading, **frame)


def _looks(look: Photo, rng: np.random.Generator) -> Photo:
    """Draw everything but the frame and the rope's colours."""
    kind = BACKGROUNDS[rng.integers(len(BACKGROUNDS))]
    surface = kind if kind in SURFACES else SURFACES[rng.integers(len(SURFACES))]
    if surface == "wood":
        first = _hsv(rng.uniform(18, 36), rng.uniform(0.3, 0.65), rng.uniform(0.3, 0.9))
        last = first * rng.uniform(0.55, 0.8)
    else:
        first = _hsv(rng.uniform(0, 360), 0.65 * rng.random() ** 1.6, rng.uniform(0.15, 0.95))
        last = first * rng.uniform(0.5, 0.92)
    grains = {"cloth": (2.5, 6.0), "wood": (5.0, 14.0), "gradient": (256, 256), "noise": (8, 60)}
    count = {"clutter": (2, 9), "ropes": (1, 5)}
    return replace(
        look,
        background=_levels(first),
        ground=_levels(last),
        surface=surface,
        grain=float(rng.uniform(*grains[surface])),
        grain_turn=float(rng.uniform(0, 360)),
        clutter=int(rng.integers(*count["clutter"])) if kind == "clutter" else 0,
        others=int(rng.integers(*count["ropes"])) if kind == "ropes" else 0,
        occluders=int(rng.integers(1, 3)) if rng.random() < 0.25 else 0,
        twisted=bool(rng.random() < 0.5),
        pitch=float(rng.uniform(2.4, 4.5)),
        gloss=float(rng.uniform(0, 0.35)),
        light_turn=float(rng.uniform(0, 360)),
        light_height=float(rng.uniform(35, 75)),
        ambient=float(rng.uniform(0.35, 0.65)),
        shadow=float(rng.uniform(0.6, 0.9)),
        falloff=float(rng.uniform(0, 0.35)),
        warmth=float(rng.uniform(-0.12, 0.18)),
        exposure=float(rng.uniform(0.8, 1.15)),
        blur=float(rng.uniform(0, 0.9)) * look.size / 256,
        noise=float(rng.uniform(0, 8)),
        jpeg=int(rng.integers(45, 101)),
        seed=int(rng.integers(2**62)),
    )


def _ground(look: Photo, rng: np.random.Generator) -> tuple[Array, Array]:
    """Paint the surface with its clutter; return the random texture of all patterns, too."""
    texture = rng.random((64, 64), dtype=np.float32)
    small = min(look.size, 256)  # surfaces are no finer than that
    cell = look.grain * small / 256
    lean = math.radians(look.heading) - look.turn  # in the picture, y up
    c, s, tilt = math.cos(lean), math.sin(lean), math.cos(math.radians(look.tilt))
    flat = np.array([[c / tilt, -s / tilt], [s, c]])  # along the leaning, stretched; across it
    turn = math.radians(look.grain_turn) + lean
    axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    axes = axes @ flat / cell
    start = rng.uniform(0, 64, 2) * (look.surface != "gradient") - axes.sum(axis=1) * small / 2
    picture = np.empty((small, small, 3), np.uint8)
    ends = [np.array(one, np.float32) for one in (look.background, look.ground)]
    kind = SURFACES.index(look.surface)
    kernels.surface(
        picture, kind, texture, np.column_stack([axes, start]).astype(np.float32), *ends
    )
    if small < look.size:
        picture = np.asarray(cv2.resize(picture, (look.size, look.size)))
    if look.clutter:
        middles = rng.uniform(0, look.size, (look.clutter, 2))
        reach = rng.uniform(0.04, 0.2, look.clutter) * look.size
        mixed = 0.5 * (ends[0] + ends[1]) + 0.5 * (_dyes(rng, look.clutter) - 128)
        _lay(picture, look, middles, reach, np.clip(mixed, 0, 255), rng)
    return texture, picture


def _lay(
    picture: Array, look: Photo, middles: Array, reach: Array, colours: Array,
    rng: np.random.Generator,
) -> Array:  # fmt: skip
    """Lay polygons and discs on a picture; return where they are, uint8 (size, size)."""
    sides, outlines = 12, np.empty((len(middles), 13, 3), np.float32)
    outlines[:, 0] = np.column_stack([middles, reach])
    for outline, far in zip(outlines, reach, strict=True):
        corners = (3, 4, 4, 5, 6, 12)[rng.integers(6)]
        angles = rng.uniform(0, 2 * np.pi) + 2 * np.pi * (np.arange(sides) % corners) / corners
        off = (
            far
            * (math.cos(math.pi / corners) if corners < 12 else 0.97)
            * np.where(np.arange(sides) % corners % 2, rng.uniform(0.5, 1.0), 1.0)
        )
        outline[1:] = np.column_stack([np.cos(angles), np.sin(angles), off])
    light, hidden = _light(look), np.zeros(picture.shape[:2], np.uint8)
    shift = (-0.012 * look.size * light[:2]).astype(np.float32)
    kernels.shapes(picture, hidden, outlines, colours.astype(np.float32), shift, 0.5 * look.shadow)
    return hidden


def _coloured(look: Photo, view: _View, ground: Array, rng: np.random.Generator) -> Photo:
    """Choose the first of 24 colours that stands out from the ground beside the rope, or the best.

    The ground is in the light on one side, in the rope's shadow on the other.
    """
    _, (x, y) = (one.T for one in view.beside())
    dyes = _dyes(rng, 24)
    rope = _lab((0.66 if look.twisted else 0.8) * dyes)
    behind = ground[y[::3], x[::3]].astype(np.float64)
    lit, shaded = _lab(behind), _lab((1 - 0.55 * look.shadow) * behind)
    apart = [_length(rope[:, None] - one) for one in (lit, shaded)]
    contrast = np.min([_low(one) for one in apart], axis=0)
    # where the rope is dark, shadows don't show which strand is over
    fits = (contrast > LIMITS.contrast + 6) & (rope[:, 0] * look.shadow > 2.6 * LIMITS.order)
    best = int(np.argmax(fits)) if fits.any() else int(np.argmax(contrast + rope[:, 0]))
    second = dyes[best] * (rng.uniform(0.6, 0.9) if look.twisted and rng.random() < 0.3 else 1.0)
    return replace(look, first=_levels(dyes[best]), last=_levels(second))


def _painted(
    rope: _Rope, view: _View, look: Photo, region: float, texture: Array, picture: Array,
    rng: np.random.Generator,
) -> Shot:  # fmt: skip
    """Paint the rope and what lies beside and on it on the ground, and measure the picture."""
    n, strands = len(view.curve), np.zeros(picture.shape[:2], np.uint8)
    beside = view.beside()
    colours = np.empty((n, 2, 3), np.float32)
    colours[:, 0], colours[:, 1] = look.first, look.last
    if look.marked:
        colours[: rope.parts], colours[-rope.parts :] = 240, TAPE
    curve, after = view.curve, view.after
    if look.others:
        curve, after, colours = _with_others(view, look, colours, rng)
    step = curve[np.maximum(after, 0)] - curve
    step[after < 0] = 0
    length = np.append(0.0, np.cumsum(np.sqrt((step**2).sum(axis=1))))
    turns = max(round(length[n] / (2 * look.pitch * view.radius)), 1)  # whole, to have no seam
    tangent = step.copy()
    np.add.at(tangent, np.maximum(after, 0), step)
    tangent /= np.maximum(np.sqrt((tangent**2).sum(axis=1)), 1e-6)[:, None]
    light = _light(look)
    grown = 3.0 * view.radius * n / length[n]
    kernels.compose(
        picture, strands, view.visits, view.square, view.place, curve, after,
        tangent.astype(np.float32),
        (length * turns / length[n]).astype(np.float32), colours, view.radius, look.twisted,
        look.gloss, look.ambient, look.shadow, light.astype(np.float32), texture, grown, n,
    )  # fmt: skip
    if look.occluders:
        strands[_occlude(view, look, picture, rng) > 0] = 0
    if look.blur > 0.2:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), look.blur))
    contrast, order = _contrasts(view, picture, *beside)
    line = view.curve[:: rope.parts].copy()
    line[:, 2] = rope.curve[:: rope.parts, 2]
    answers = rope.points, rope.crossings, view.at(view.over), line, strands
    return Shot(picture, look, *answers, contrast, order, region)


def _exposed(picture: Array, look: Photo) -> Array:
    """Add what the lamp and the camera do to a picture, which is changed."""
    light = _light(look)
    gain = look.exposure * np.array([1 + 0.5 * look.warmth, 1.0, 1 - 0.5 * look.warmth])
    slope = (look.falloff * light[:2]).astype(np.float32)
    kernels.expose(picture, gain.astype(np.float32), slope, look.noise, look.seed)
    if look.jpeg < 100:
        quality = [cv2.IMWRITE_JPEG_QUALITY, look.jpeg]
        _, packed = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), quality)
        picture = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR_RGB))
    return picture


def _with_others(
    view: _View, look: Photo, colours: Array, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Lay pieces of other ropes that come in from the picture's edge and touch nothing."""
    curve, after, size = view.curve, view.after, look.size
    space = 2 * view.radius + 9.0 * view.unit  # between axes, px
    own = _lab(np.array([look.first], np.float64))
    for _ in range(look.others):
        dyes = _dyes(rng, 8)
        dye = dyes[int(np.argmax(np.linalg.norm(_lab(dyes) - own, axis=1) > 15))]
        side, start = rng.integers(4), rng.uniform(0.1, 0.9)
        x, y = ((start, 0.0), (1.0, start), (start, 1.0), (0.0, start))[side]
        bends = np.cumsum(0.3 * rng.uniform(-1, 1, 60)) * 0.3 + rng.uniform(-0.6, 0.6)
        angles = math.pi / 2 * (1 + side) + np.cumsum(0.08 * bends)
        steps = 0.014 * size * np.column_stack([np.cos(angles), np.sin(angles)])
        path = np.array([x, y]) * size - 2 * steps[0] + np.cumsum(steps, axis=0)
        apart = np.linalg.norm(path[:, None] - curve[None, :, :2], axis=2).min(axis=1)
        path = path[: int(np.argmax(np.append(apart, 0.0) < space))]
        if len(path) < 8:
            continue
        n, last = len(curve), len(curve) + len(path)
        curve = np.concatenate([curve, np.column_stack([path, np.zeros(len(path))])])
        curve = curve.astype(np.float32)
        after = np.concatenate([after, np.arange(n + 1, last), [-1]])
        colours = np.concatenate([colours, np.tile(dye, (len(path), 2, 1)).astype(np.float32)])
    new = np.where(np.arange(len(curve)) < len(view.curve), -1, after)
    flags = np.full(len(curve), kernels.UNDER, np.uint8)
    kernels.stamp(curve, new, flags, _reach(view.radius), view.square, view.place)
    return curve, after, colours


def _occlude(view: _View, look: Photo, picture: Array, rng: np.random.Generator) -> Array:
    """Lay things on single straight strands; return where they are."""
    flat, n, chosen = view.curve[:, :2], len(view.curve), list[tuple[int, float]]()
    for _ in range(8 * look.occluders):
        k, reach = int(rng.integers(n)), float(rng.uniform(1.2, 2.0)) * view.radius + 3.0
        clear = 1.5 * (reach + view.radius + 3.0)
        near = np.flatnonzero(_length(flat - flat[k]) < clear)
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
    colours = _dyes(rng, len(ks)) * rng.uniform(0.4, 1.0, (len(ks), 1))
    return _lay(picture, look, flat[ks].astype(np.float64), reaches, colours, rng)


def _contrasts(view: _View, shown: Array, inner: Array, outer: Array) -> tuple[float, float]:
    """Measure contrast and order of a picture without noise; see `Legibility`."""
    rope, behind = (_lab(shown[at[:, 1], at[:, 0]]) for at in (inner, outer))
    # averaged along the rope, so that a twist's grooves don't count as its colour
    rope = cv2.blur(rope, (1, 5))
    contrast = float(_low(_length(rope - behind)))
    if not len(view.over):
        return contrast, math.inf
    middle = view.at(view.over)
    pieces = np.array([view.over, view.under]).astype(np.int64) % len(view.curve)
    along, across = view.along[pieces]
    sine = view.sines[:, None]
    spots = [middle + share * view.radius * along for share in (-0.5, 0.0, 0.5)]
    for side in (-1, 1):  # the under strand disappears on both sides
        spots += [middle + side * (view.radius + off) / sine * across for off in (0.4, 1.0, 1.6)]
    x, y = np.clip(np.concatenate(spots), 0, view.size - 1).astype(np.int64).T
    seen = _lab(shown[y, x]).reshape(9, -1, 3)
    apart = _length(seen[3:] - seen[:3].mean(axis=0)).reshape(2, 3, -1)
    return contrast, float(apart.max(axis=1).min())


def _light(look: Photo) -> Array:
    """Return the direction towards the light, (3,); y points down."""
    turn, height = math.radians(look.light_turn), math.radians(look.light_height)
    flat = math.cos(height)
    return np.array([flat * math.cos(turn), flat * math.sin(turn), math.sin(height)])


def _dyes(rng: np.random.Generator, count: int) -> Array:
    """Draw RGB colours of ropes (count, 3), none so dark that it hides shadows and edges."""
    natural = rng.random(count) < 0.45  # hemp, cotton, sisal, nylon
    hue = np.array(_DYES)[rng.integers(len(_DYES), size=count)] + rng.uniform(-12, 12, count)
    saturation, value = rng.random(count), rng.random(count)
    # greens and violets are seldom pure
    most = np.where((80 < hue) & (hue < 190) | (hue > 250), 0.6, 0.88)
    hue = np.where(natural, rng.uniform(22, 48, count), hue)
    saturation = np.where(natural, 0.03 + 0.45 * saturation, 0.25 + (most - 0.25) * saturation)
    value = np.where(natural, 0.6 + 0.4 * value, 0.55 + 0.43 * value)
    return _hsv(hue[:, None], saturation[:, None], value[:, None])


def _hsv(hue: Any, saturation: Any, value: Any) -> Array:
    """Return the RGB, 0 to 255, of a hue in degrees."""
    part = (hue / 60.0 + np.array([5.0, 3.0, 1.0])) % 6.0
    return 255 * value * (1 - saturation * np.clip(np.minimum(part, 4 - part), 0, 1))


def _levels(colour: Array) -> RGB:
    red, green, blue = np.rint(np.clip(colour, 0, 255)).astype(int).tolist()
    return red, green, blue


def _lab(colours: Array) -> Array:
    """Return CIELAB (n, 3) of RGB levels (n, 3), with a and b at half weight."""
    levels = np.clip(colours, 0, 255).astype(np.uint8)
    return cv2.cvtColor(levels[None], cv2.COLOR_RGB2LAB)[0] * np.array([100 / 255, 0.5, 0.5])


def _length(vectors: Array) -> Array:
    """Return the lengths of vectors along the last axis."""
    return np.sqrt((vectors**2).sum(axis=-1))


def _low(values: Array) -> Array:
    """Return the value that a twentieth of the last axis is below."""
    k = values.shape[-1] // 20
    return np.partition(values, k, axis=-1)[..., k]
