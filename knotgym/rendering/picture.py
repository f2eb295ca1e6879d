"""The picture of a rope: where the camera stands, how the beads are coloured, and how they are
drawn.

The camera looks straight down z at the rope's centre of mass. Pixel coordinates are continuous, x
to the right and y down: pixel (row, column) covers [column, column + 1) x [row, row + 1), so its
centre lies at (column + 0.5, row + 0.5). Image right is world +x, image up is world +y. Bead i is a
capsule from points[i] to points[(i + 1) % beads]. Colours are flat: no light, no shadow. Source:
arXiv 2505.18028 (camera, colours).
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.errors import KnotgymError
from knotgym.rendering.rasterizer import EDGE, SHIFT, polygons

if TYPE_CHECKING:
    from knotgym.topology.crossings import Crossings

RGB = tuple[int, int, int]

_NEAR = 0.01  # metres; nothing nearer to the perspective camera is seen


class PictureError(KnotgymError, ValueError):
    """A picture was asked for that cannot be drawn."""


def _require(met: bool, rule: str, given: object) -> None:
    if not met:
        raise PictureError(f"{rule}, got {given!r}")


def _is_int(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _rgb(name: str, value: Any) -> RGB:
    levels = tuple(value) if isinstance(value, tuple | list) else ()
    _require(
        len(levels) == 3 and all(_is_int(level) and 0 <= level <= 255 for level in levels),
        f"{name} must be three levels from 0 to 255",
        value,
    )
    return levels[0], levels[1], levels[2]


@dataclass(frozen=True, kw_only=True)
class PictureConfig:
    """What a picture shows; together with the points it determines every byte of it.

    Attributes:
        size: pixels, both sides, 16 to 4096.
        view: metres that a side of the orthographic picture shows.
        camera: "orthographic" (parallel to z, so that the picture shows the crossings that the
            Gauss code names) or "perspective" (published).
        camera_height: metres of the perspective camera above the centre of mass.
        fovy: vertical field of view of the perspective camera, degrees.
        turn: radians by which the camera is turned about z, anticlockwise seen from above; the rope
            appears turned the other way.
        zoom: magnification about the picture's centre.
        rope_radius: metres.
        width: factor on the rope's radius, in the picture alone.
        colours: "published" (see bead_colours) or one RGB for the whole rope, whose base bead stays
            white.
        background: RGB.
        renderer: "opencv" (needs no GL), "mujoco" (the same picture by OpenGL), or "auto", which is
            "opencv".
        supersampling: samples along each side of a pixel, averaged; 1 to 8.

    Raises:
        PictureError: a value is out of range.
    """

    size: int = 128
    view: float = 0.66
    camera: Literal["orthographic", "perspective"] = "orthographic"
    camera_height: float = 0.8
    fovy: float = 45.0
    turn: float = 0.0
    zoom: float = 1.0
    rope_radius: float = 0.005
    width: float = 1.0
    colours: Literal["published"] | RGB = "published"
    background: RGB = (0, 0, 0)
    renderer: Literal["auto", "opencv", "mujoco"] = "auto"
    supersampling: int = 4

    def __post_init__(self) -> None:
        _require(
            _is_int(self.size) and 16 <= self.size <= 4096,
            "size must be a whole number of pixels from 16 to 4096",
            self.size,
        )
        _require(
            _is_int(self.supersampling) and 1 <= self.supersampling <= 8,
            "supersampling must be a whole number from 1 to 8",
            self.supersampling,
        )
        for name in ("view", "camera_height", "zoom", "rope_radius", "width"):
            _require(
                0.0 < getattr(self, name) < math.inf,
                f"{name} must be positive and finite",
                getattr(self, name),
            )
        _require(0.0 < self.fovy < 180.0, "fovy must lie between 0 and 180 degrees", self.fovy)
        _require(math.isfinite(self.turn), "turn must be finite", self.turn)
        _require(
            self.camera in ("orthographic", "perspective"),
            "camera must be 'orthographic' or 'perspective'",
            self.camera,
        )
        _require(
            self.renderer in ("auto", "opencv", "mujoco"),
            "renderer must be 'auto', 'opencv' or 'mujoco'",
            self.renderer,
        )
        object.__setattr__(self, "background", _rgb("background", self.background))
        if self.colours != "published":
            object.__setattr__(self, "colours", _rgb("colours", self.colours))

    @property
    def pixels_per_metre(self) -> float:
        """Scale of the picture; under the perspective camera, at the height of the centre of
        mass.
        """
        if self.camera == "orthographic":
            return self.zoom * self.size / self.view
        return (
            self.zoom
            * self.size
            / (2.0 * self.camera_height * math.tan(math.radians(self.fovy) / 2.0))
        )

    @property
    def drawn_radius(self) -> float:
        """Radius of the rope as drawn, metres."""
        return self.rope_radius * self.width


DEFAULT = PictureConfig()


def bead_colours(beads: int) -> NDArray[np.uint8]:
    """Colour the beads round the colour circle, the base bead white.

    Returns:
        uint8, shape (beads, 3), RGB: 0.5 + 0.5 sin(2 pi (i / beads + (0, 0.33, 0.67))) of 255, to
        the nearest.

    >>> bead_colours(100)[[0, 25]].tolist()  # the base bead; red, a quarter of the way along
    [[255, 255, 255], [255, 66, 66]]
    """
    place = np.arange(beads)[:, None] / beads
    wave = 0.5 + 0.5 * np.sin(2.0 * np.pi * (place + np.array([0.0, 0.33, 0.67])))
    colours: NDArray[np.uint8] = np.rint(255.0 * wave).astype(np.uint8)
    colours[:1] = 255
    return colours


def rope_colours(beads: int, config: PictureConfig = DEFAULT) -> NDArray[np.uint8]:
    """The colours that config gives to a rope of so many beads: uint8, shape (beads, 3), RGB, the
    caller's to change.
    """
    if config.colours == "published":
        return bead_colours(beads)
    colours = np.tile(np.array(config.colours, dtype=np.uint8), (beads, 1))
    colours[:1] = 255
    return colours


def project(
    points: ArrayLike, config: PictureConfig = DEFAULT, center: ArrayLike | None = None
) -> NDArray[np.float64]:
    """Where points of the world appear in the picture.

    Args:
        points: float, shape (n, 3), metres, world frame.
        center: shape (3,), metres: the world point in the middle of the picture. By default the
            mean of the points; for anything but the whole rope, hand in the rope's mean.

    Returns:
        float64, shape (n, 2): pixel coordinates (x right, y down; see the module). They may lie
        outside the picture; they are NaN for points less than 1 cm in front of the perspective
        camera, or behind it.
    """
    points = np.asarray(points, dtype=np.float64)
    offset = points - (
        points.mean(axis=0) if center is None else np.asarray(center, dtype=np.float64)
    )
    right, up = offset[:, 0], offset[:, 1]
    if config.turn != 0.0:
        cos, sin = math.cos(config.turn), math.sin(config.turn)
        right, up = cos * right + sin * up, cos * up - sin * right
    scale = _pixels_per_metre(offset, config)
    return np.stack([0.5 * config.size + scale * right, 0.5 * config.size - scale * up], axis=-1)


def draw(
    points: ArrayLike, config: PictureConfig = DEFAULT, *, colours: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Draw a rope; the same points and config always give the same bytes.

    Args:
        points: float64, shape (beads, 3), metres, world frame, finite; at least 3 beads.
        colours: uint8, shape (beads, 3), RGB, instead of config's.

    Returns:
        uint8, shape (size, size, 3), RGB, row 0 at the top (largest y). What lies outside the
        picture is cut off.

    Raises:
        PictureError: points or colours have another shape, or points are not finite.
        GraphicsUnavailable: config.renderer is "mujoco" and there is no OpenGL here.
    """
    points = _checked(points, 2)
    images = _draw_all(points[None], config, colours)
    return images.reshape(images.shape[1:])


def draw_many(
    points: ArrayLike, config: PictureConfig = DEFAULT, *, colours: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Draw m ropes of equally many beads; picture k is draw(points[k], config).

    Args:
        points: float64, shape (m, beads, 3), metres; m may be 0.
        colours: as for draw, the same for all.

    Returns:
        uint8, shape (m, size, size, 3), RGB.

    Raises:
        PictureError, GraphicsUnavailable: as draw.
    """
    return _draw_all(_checked(points, 3), config, colours)


def average(canvas: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Average the samples of each pixel: uint8, shape (rows, columns, 3), to (rows / factor,
    columns / factor, 3).
    """
    while factor % 2 == 0:  # halving twice is three times as fast as quartering
        canvas = _shrink(canvas, 2)
        factor //= 2
    return canvas if factor == 1 else _shrink(canvas, factor)


def crossing_pixels(
    crossings: "Crossings", points: ArrayLike, config: PictureConfig = DEFAULT
) -> NDArray[np.float64]:
    """Where the over strand of each crossing appears in the picture of points: float64, shape (n,
    2), pixel coordinates as of project.
    """
    where = np.column_stack([crossings.position, crossings.over_z])
    return project(where, config, center=np.asarray(points, dtype=np.float64).mean(axis=0))


def shown_strands(
    image: NDArray[np.uint8],
    crossings: "Crossings",
    points: ArrayLike,
    config: PictureConfig = DEFAULT,
    *,
    colours: NDArray[np.uint8] | None = None,
    window: float = 2.0,
    colour_gap: float = 25.0,
) -> NDArray[np.str_]:
    """Read off a picture which strand lies on top at each crossing: the check that a picture tells
    the truth.

    The pixel that holds the crossing is compared with the colours of the two beads that cross and
    of their neighbours along the rope (all the blends of two neighbours count, for a pixel can
    straddle a joint); the nearer strand is the one shown.

    Args:
        image: uint8, shape (size, size, 3), drawn from points with config and colours,
            orthographic.
        crossings: those of points.
        points: float64, shape (beads, 3), metres.
        window: beads along the rope, either way, that count as the same strand.
        colour_gap: RGB levels (Euclidean) below which the colours of two crossing beads are too
            alike to tell; beads 1, 2, 3 apart along a published rope of 100 differ by 10, 20, 29.

    Returns:
        str, shape (n,): "over" (the picture is right), "under" (it is wrong), or "ambiguous" where
        the pixel cannot tell: it is outside the picture; the two beads' colours are within
        colour_gap; or a third strand that is higher than the over strand runs so near (its axis
        within the drawn radius and half a pixel's diagonal of the crossing) that it may cover the
        pixel.

    Raises:
        PictureError: config's camera is not orthographic, so that the picture's crossings are
            others; or its pixels are larger than 1.1 drawn radii, so that the over strand need not
            fill most of a crossing's pixel.
    """
    if config.camera != "orthographic":
        raise PictureError(
            "only an orthographic picture shows the crossings of the code; this one's camera is"
            f" {config.camera!r}"
        )
    pixel = 1.0 / config.pixels_per_metre
    if pixel > 1.1 * config.drawn_radius:
        raise PictureError(
            f"pixels of {1e3 * pixel:.1f} mm are too coarse to read a rope drawn"
            f" {1e3 * config.drawn_radius:.1f} mm in radius; draw it with size at least"
            f" {math.ceil(config.size * pixel / (1.1 * config.drawn_radius))}"
        )
    points = _checked(points, 2)
    palette = (rope_colours(len(points), config) if colours is None else colours).astype(np.float64)
    reach = config.drawn_radius + math.sqrt(0.5) * pixel
    shown = np.full(len(crossings.position), "ambiguous", dtype="<U9")
    for k, (column, row) in enumerate(
        np.floor(crossing_pixels(crossings, points, config)).astype(int)
    ):
        over, under = (
            float(place[k]) % len(points) for place in (crossings.over_place, crossings.under_place)
        )
        if not (0 <= row < config.size and 0 <= column < config.size):
            continue
        if np.linalg.norm(palette[int(over)] - palette[int(under)]) < colour_gap:
            continue
        if (
            _third_strand_height(points, crossings.position[k], (over, under), reach, window)
            > crossings.over_z[k]
        ):
            continue
        seen = image[row, column].astype(np.float64)
        shown[k] = (
            "over"
            if _distance_to_strand(seen, palette, int(over))
            < _distance_to_strand(seen, palette, int(under))
            else "under"
        )
    return shown


def _shrink(canvas: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    rows, columns = canvas.shape[0] // factor, canvas.shape[1] // factor
    return np.asarray(
        cv2.resize(canvas, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8
    )


def _checked(points: ArrayLike, axes: int) -> NDArray[np.float64]:
    points = np.asarray(points, dtype=np.float64)
    form = "(beads, 3)" if axes == 2 else "(m, beads, 3)"
    fits = points.ndim == axes and points.shape[-1] == 3 and points.shape[-2] >= 3
    _require(fits, f"points must have shape {form}, at least 3 beads", points.shape)
    if not np.isfinite(points).all():
        raise PictureError(
            f"points must be finite, got {int((~np.isfinite(points)).sum())} coordinates that"
            " are not"
        )
    return points


def _pixels_per_metre(offset: NDArray[np.float64], config: PictureConfig) -> NDArray[np.float64]:
    """Scale of the picture at points (n, 3) given from the centre of mass: shape (n,), NaN where
    the camera sees nothing.
    """
    if config.camera == "orthographic":
        return np.full(len(offset), config.pixels_per_metre)
    depth = config.camera_height - offset[:, 2]
    return config.pixels_per_metre * config.camera_height / np.where(depth > _NEAR, depth, np.nan)


@lru_cache(maxsize=16)
def _paint(beads: int, config: PictureConfig) -> list[RGB]:
    """The colours of config as OpenCV wants them."""
    return _as_scalars(rope_colours(beads, config))


def _as_scalars(colours: NDArray[np.uint8]) -> list[RGB]:
    return [(red, green, blue) for red, green, blue in colours.tolist()]


def _draw_all(
    points: NDArray[np.float64], config: PictureConfig, colours: NDArray[np.uint8] | None
) -> NDArray[np.uint8]:
    frames, beads = points.shape[:2]
    if colours is not None:
        colours = np.asarray(colours)
        fits = colours.shape == (beads, 3) and colours.dtype == np.uint8
        _require(
            fits, f"colours must be uint8 of shape {(beads, 3)}", (colours.dtype, colours.shape)
        )
    images = np.empty((frames, config.size, config.size, 3), dtype=np.uint8)
    if config.renderer == "mujoco":
        from knotgym.rendering import mujoco_renderer as picture_mujoco

        shades = rope_colours(beads, config) if colours is None else colours
        for image, rope in zip(images, points, strict=True):
            image[:] = picture_mujoco.draw(rope, shades, config)
        return images
    paint = _paint(beads, config) if colours is None else _as_scalars(colours)
    finer = config.supersampling
    canvas = np.empty((finer * config.size, finer * config.size, 3), dtype=np.uint8)
    for image, rope in zip(images, points, strict=True):
        _fill(image, config.background)
        outlines, owners = polygons(*_placed(rope, config), len(canvas))
        if not len(outlines):
            continue
        columns, rows = _touched(outlines, config)
        touched = canvas[
            finer * rows.start : finer * rows.stop, finer * columns.start : finer * columns.stop
        ]
        _fill(touched, config.background)
        for outline, bead in zip(outlines, owners.tolist(), strict=True):
            cv2.fillConvexPoly(canvas, outline, paint[bead], cv2.LINE_8, SHIFT)
        image[rows, columns] = average(touched, finer)
    return images


def _touched(outlines: NDArray[np.int32], config: PictureConfig) -> tuple[slice, slice]:
    """The columns and the rows of pixels that polygons on the canvas touch, and one more on each
    side.
    """
    x, y, width, height = cv2.boundingRect(outlines.reshape(-1, 2))
    spans = (
        [(low >> SHIFT) // config.supersampling for low in (x, y)],
        [(high >> SHIFT) // config.supersampling for high in (x + width, y + height)],
    )
    columns, rows = (
        slice(max(low - 1, 0), min(high + 2, config.size)) for low, high in zip(*spans, strict=True)
    )
    return columns, rows


def _fill(picture: NDArray[np.uint8], colour: RGB) -> None:
    # a tenth of the time that NumPy takes
    cv2.rectangle(picture, (0, 0), picture.shape[1::-1], colour, cv2.FILLED)


def _placed(
    points: NDArray[np.float64], config: PictureConfig
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """A rope on the supersampled canvas: pixels (beads, 2), heights (beads,), metres, and radii
    (beads,) or (1,), pixels.
    """
    offset = points - points.mean(axis=0)
    pixels = config.supersampling * project(points, config) - 0.5
    if config.camera == "orthographic":
        height = np.ascontiguousarray(offset[:, 2])
    else:
        height = -np.linalg.norm(offset - np.array([0.0, 0.0, config.camera_height]), axis=1)
    return (
        pixels,
        height,
        np.maximum(
            config.supersampling * config.drawn_radius * _pixels_per_metre(offset, config) - EDGE,
            EDGE,
        ),
    )


def _third_strand_height(
    points: NDArray[np.float64],
    position: NDArray[np.float64],
    places: tuple[float, float],
    reach: float,
    window: float,
) -> float:
    """Greatest height at which the rope, its stretches within window of the two places left out,
    comes within reach of a position; else -inf.
    """
    beads = len(points)
    fraction = np.linspace(0.0, 1.0, 5)[:-1]
    place = (np.arange(beads)[:, None] + fraction).ravel()
    away = np.min([np.abs((place - own + beads / 2) % beads - beads / 2) for own in places], axis=0)
    samples = (
        points[:, None] + fraction[:, None] * (np.roll(points, -1, axis=0) - points)[:, None]
    ).reshape(-1, 3)
    near = (np.hypot(*(samples[:, :2] - position).T) < reach) & (away > window)
    return float(samples[near, 2].max()) if near.any() else -math.inf


def _distance_to_strand(
    seen: NDArray[np.float64], palette: NDArray[np.float64], bead: int
) -> float:
    """RGB distance from a colour to the path through the colours of a bead and its two
    neighbours.
    """
    path = palette[np.arange(bead - 1, bead + 2) % len(palette)]
    step = np.diff(path, axis=0)
    fraction = np.clip(
        np.sum((seen - path[:-1]) * step, axis=1) / np.maximum(np.sum(step * step, axis=1), 1e-9),
        0.0,
        1.0,
    )
    return float(np.linalg.norm(seen - path[:-1] - fraction[:, None] * step, axis=1).min())
