"""Varied appearance of perception pictures: colours, width, background, camera, noise, blur, size.

None of these changes the Gauss code. A turn or a zoom moves the crossings' pixels, which are
recomputed. Under colours "published" and "gradient" the picture shows the direction in which the
code is read: towards red, or from the bright end to the dark one. Under "single" only the white
base bead is marked, so the code and the code of the reversed rope fit the picture equally well.

An appearance is drawn by its `Drawer`, which `appearances` names. Line drawings are those of
printed diagrams and of KnotBench (arXiv 2605.09900). They mark neither base nor direction, so a PD
code fits the picture from any base point and in both directions.

After a change run `pytest tests/rendering/test_variation.py`: without variation a picture must be
the published one, and crossings lie where it says.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from pkgutil import resolve_name
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Stream
from knotgym.rendering.appearances import APPEARANCES, PUBLISHED, AppearanceConfig
from knotgym.rendering.camera import RGB, PictureConfig, bead_colours, project
from knotgym.rendering.diagram import draw_lines
from knotgym.rendering.picture import draw
from knotgym.topology import Crossings, find_crossings

Rng = np.random.Generator
Camera = tuple[float, float]  # tilt and heading, degrees

_LINE = 2.0  # half the width of a line drawing's line, pixels of a picture of its usual size
_MARGIN = 2.0  # smallest distance of a zoomed rope from the edge, pixels of a 128-pixel picture


@dataclass(frozen=True, kw_only=True)
class Appearance:
    """Appearance of one picture; with the points it determines every byte of the picture.

    Attributes:
        name: of the appearance, one of APPEARANCES.
        size: side of the picture, pixels.
        turn: rotation of the camera about z, radians, anticlockwise.
        zoom: magnification.
        width: factor on the rope's width.
        colours: "published"; "single", the whole rope in the RGB `first`; or "gradient", from
            `first` to `last` along the rope.
        first, last: RGB; 0 where not used.
        background: RGB.
        noise: standard deviation of the Gaussian noise, levels; added after the blur.
        blur: standard deviation of the Gaussian blur, pixels of this picture.
        seed: seed of the noise, in stream `IMAGE_GRAIN`.
    """

    name: str = PUBLISHED
    size: int = 128
    turn: float = 0.0
    zoom: float = 1.0
    width: float = 1.0
    colours: str = "published"
    first: RGB = (0, 0, 0)
    last: RGB = (0, 0, 0)
    background: RGB = (0, 0, 0)
    noise: float = 0.0
    blur: float = 0.0
    seed: int = 0

    def picture(self) -> PictureConfig:
        """Return the picture configuration; the rope's colours are in `bead_colours`."""
        return _config(self.size, self.turn, self.zoom, self.width, self.background)

    def _bead_colours(self, beads: int) -> NDArray[np.uint8]:
        """Return the RGB of every bead, uint8 (beads, 3); the base bead is white."""
        if self.colours == "published":
            return bead_colours(beads)
        last = self.first if self.colours == "single" else self.last
        along = np.linspace(0.0, 1.0, beads)[:, None]
        blend = (1 - along) * np.array(self.first) + along * np.array(last)
        colours: NDArray[np.uint8] = np.rint(blend).astype(np.uint8)
        colours[0] = 255
        return colours


@lru_cache(maxsize=256)
def _config(size: int, turn: float, zoom: float, width: float, background: RGB) -> PictureConfig:
    return PictureConfig(size=size, turn=turn, zoom=zoom, width=width, background=background)


@dataclass(frozen=True, eq=False)
class Drawn:
    """A picture of a table.

    Attributes:
        image: uint8 (size, size, 3), RGB.
        look: its appearance.
        pixels: float64 (n, 2), x and y of the crossings that are seen, in order of labels.
        seen: which of the rope's crossings these are.
    """

    image: NDArray[np.uint8]
    look: Any
    pixels: Array

    @property
    def seen(self) -> Any:
        return slice(None)

    @property
    def columns(self) -> dict[str, Any]:
        """Those that tables of the appearance alone have; PNG files as uint8 arrays."""
        return {}


class Drawer:
    """Draws pictures of one appearance: the published one. Others override what differs.

    Points are float64 (beads, 3), metres, and are left as they are.

    Attributes:
        look: class of the appearances of single pictures.
        colours: of the rope, where they don't vary, see `Appearance`.
        structs: own columns that hold the fields of `look` which the column `appearance` lacks.
    """

    look: ClassVar[type[Appearance]] = Appearance
    structs: ClassVar[tuple[str, ...]] = ()
    colours: ClassVar[str] = "published"

    def __init__(self, name: str) -> None:
        self.name = name

    @staticmethod
    def of(name: str) -> "Drawer":
        """Return the drawer of an appearance."""
        return resolve_name(APPEARANCES[name].drawer)(name)

    def seen(self, points: Array, config: AppearanceConfig, rng: Rng) -> tuple[Array, Camera]:
        """Draw the camera of a table's picture; return points (n, 3) in its axes, and it.

        A camera is its tilt and its heading, degrees.
        """
        return points, (0.0, 0.0)

    def image(self, points: Array, look: Any) -> NDArray[np.uint8]:
        """Draw a rope: uint8 (size, size, 3), RGB; the same arguments give the same bytes."""
        colours = look._bead_colours(len(points))
        return _through_lens(draw(points, look.picture(), colours=colours), look)

    def drawn(self, points: Array, look: Any, crossings: Crossings | None = None) -> Drawn:
        """Draw a picture of a table again from its appearance; crossings if they are known."""
        over = (crossings or find_crossings(points)).over_points
        pixels = project(over, look.picture(), points.mean(axis=0))
        return Drawn(self.image(points, look), look, pixels)

    def sampled(
        self,
        points: Array,
        config: AppearanceConfig,
        rng: Rng,
        camera: Camera = (0.0, 0.0),
        crossings: Crossings | None = None,
    ) -> Drawn:
        """Draw a picture of a table with an appearance drawn at random.

        Args:
            points: metres, in the axes of the camera.
            config: distribution of the appearance.
            rng: source of all draws.
            camera: tilt and heading of the camera, degrees; 0 unless the appearance is tilted.
            crossings: of the points, if they are known.
        """
        return self.drawn(points, self._drawn_look(points, config, rng), crossings)

    def _drawn_look(self, points: Array, config: AppearanceConfig, rng: Rng) -> Appearance:
        """Sample an appearance for a rope."""
        # The order of the draws is part of every table: a new one belongs at the end.
        vary, plain = set(config.vary), Appearance()
        size = config.sides[int(rng.integers(len(config.sides)))]

        def _varied(name: str, low: float, high: float, fixed: float = 0.0) -> float:
            return float(rng.uniform(low, high)) if name in vary else fixed

        turn = _varied("turn", -math.pi, math.pi)
        width, zoom = self._framed(points, size, turn, _varied("width", *config.width, 1.0))
        if "zoom" in vary:
            # a rope larger than the range allows for is shown as large as fits
            most = _largest_zoom(points, turn, width)
            zoom = _varied("zoom", *(min(bound, most) for bound in config.zoom))
        kind = self.colours
        if "colours" in vary:
            kind = ("published", "single", "gradient")[int(rng.integers(3))]
        # dark, as every rope has a channel of 150 or more along all of it
        background = levels_of(rng.integers(0, 81, 3)) if "background" in vary else plain.background
        first, last = levels_of(rng.integers(150, 256, 3)), plain.last
        # a gradient ends dark but with one channel of 150 or more, so that it differs in hue from
        # the start and is brighter than any background (at most 80)
        if kind == "gradient":
            dark = rng.integers(20, 60, 3)
            dark[rng.integers(3)] = rng.integers(150, 200)
            last = levels_of(dark)
        if kind == "published" or "colours" not in vary:
            first = plain.first
        noise, blur = _varied("noise", 0, config.noise), _varied("blur", 0, config.blur)
        return self.look(
            name=self.name,
            size=size,
            turn=turn,
            zoom=zoom,
            width=width,
            colours=kind,
            first=first,
            last=last,
            background=background,
            noise=noise,
            blur=blur * size / plain.size,
            seed=int(rng.integers(2**62)) if noise else plain.seed,
        )

    def _framed(self, points: Array, size: int, turn: float, width: float) -> tuple[float, float]:
        """Return the factor on the rope's width, and the zoom where it doesn't vary."""
        return width, 1.0

    def for_episode(self, points: Array, size: int, goal: int) -> Appearance | None:
        """Return the appearance of an episode's pictures of `size` pixels.

        Args:
            points: of the goal state.
            size: side of the pictures of rope and of goal.
            goal: row of the goal state, which seeds what is drawn at random.

        Returns:
            None if the pictures follow from the settings of the task alone.
        """
        if APPEARANCES[self.name].obeys:
            return None
        return self.look(name=self.name, size=size, colours=self.colours)

    def legible(self, points: Array, size: int, crossings: Crossings | None = None) -> bool:
        """Return whether a picture of a table can show these points; crossings if known."""
        return True

    def read(self, row: Mapping[str, Any]) -> Appearance:
        """Read the appearance of a picture from its row, as `read_rows` gives it."""
        own = [row[name] for name in ("appearance", *self.structs) if name in row]
        values = {name: value for one in own for name, value in one.items()}
        given: dict[str, Any] = {
            field.name: tuple(value) if isinstance(value := values[field.name], list) else value
            for field in fields(self.look)
            if field.name in values
        }
        return self.look(**given)


class LineDrawer(Drawer):
    """Draws diagrams as lines with gaps, as large as the picture."""

    colours = "single"

    def image(self, points: Array, look: Any) -> NDArray[np.uint8]:
        return _through_lens(draw_lines(points, look.picture()), look)

    def _framed(self, points: Array, size: int, turn: float, width: float) -> tuple[float, float]:
        zoom = _largest_zoom(points, turn, width)
        return width * self._width(size, zoom), zoom

    def for_episode(self, points: Array, size: int, goal: int) -> Appearance | None:
        return Appearance(name=self.name, size=size, width=self._width(size), colours=self.colours)

    def _width(self, size: int, zoom: float = 1.0) -> float:
        """Return the factor on the rope's width by which the line is as wide at every zoom."""
        plain = PictureConfig(size=size, zoom=zoom)
        half = _LINE * size / APPEARANCES[self.name].size
        return half / (plain.rope_radius * plain.pixels_per_metre)


def _through_lens(image: NDArray[np.uint8], look: Appearance) -> NDArray[np.uint8]:
    """Return a picture with the blur and the noise of its appearance."""
    # the lens before the sensor: noise isn't blurred
    if look.blur > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), look.blur), dtype=np.uint8)
    if look.noise > 0:
        grain = Stream.IMAGE_GRAIN.generator(look.seed).normal(0.0, look.noise, image.shape)
        image = np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)
    return image


def _largest_zoom(points: Array, turn: float, width: float) -> float:
    """Return the zoom at which the rope is _MARGIN away from the picture's edge."""
    plain = PictureConfig(turn=turn, width=width)
    # in metres, from the middle to the rope's own edge
    outermost = np.abs(project(points, plain) - plain.size / 2).max() / plain.pixels_per_metre
    outermost += plain.drawn_radius
    return float((plain.size / 2 - _MARGIN) / plain.pixels_per_metre / outermost)


def levels_of(colour: NDArray[Any]) -> RGB:
    """Round a colour (3,) to levels from 0 to 255."""
    red, green, blue = np.rint(np.clip(colour, 0, 255)).astype(int).tolist()
    return red, green, blue
