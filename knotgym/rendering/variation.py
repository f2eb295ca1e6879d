"""Varied appearance of perception pictures: colours, width, background, camera, noise, blur, size.

None of these changes the Gauss code. A turn or a zoom moves the crossings' pixels, which are
recomputed. Under colours "published" and "gradient" the picture shows the direction in which the
code is read: towards red, or from the bright end to the dark one. Under "single" only the white
base bead is marked, so the code and the code of the reversed rope fit the picture equally well.

Style "knotbench" draws the diagram as a line with gaps, as printed ones and those of KnotBench
(arXiv 2605.09900) are. It marks neither base nor direction, so a PD code fits the picture from any
base point and in both directions.

After a change run `pytest tests/rendering/test_variation.py`: without variation a picture must be
the published one, and crossings lie where it says.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.common import Stream, generator
from knotgym.rendering.appearance_config import LINE_SIZE, AppearanceConfig
from knotgym.rendering.camera import RGB, PictureConfig, bead_colours, project
from knotgym.rendering.diagram import draw_lines
from knotgym.rendering.picture import draw

Array = NDArray[np.float64]

LINE = 2.0  # half the width of its line, pixels of a picture of this size
MARGIN = 2.0  # smallest distance of a zoomed rope from the edge, pixels of a 128-pixel picture


@dataclass(frozen=True, kw_only=True)
class Appearance:
    """Appearance of one picture; with the points it determines every byte of the picture.

    Attributes:
        size: side of the picture, pixels.
        turn: rotation of the camera about z, radians, anticlockwise.
        zoom: magnification.
        width: factor on the rope's width.
        colours: "published"; "single", the whole rope in the RGB `first`; "gradient", from
            `first` to `last` along the rope; or "lines", a line drawing in style knotbench.
        first, last: RGB; 0 where not used.
        background: RGB.
        noise: standard deviation of the Gaussian noise, levels; added after the blur.
        blur: standard deviation of the Gaussian blur, pixels of this picture.
        seed: seed of the noise, in stream `IMAGE_GRAIN`.
    """

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
        return PictureConfig(
            size=self.size,
            turn=self.turn,
            zoom=self.zoom,
            width=self.width,
            background=self.background,
        )

    def bead_colours(self, beads: int) -> NDArray[np.uint8]:
        """Return the RGB of every bead, uint8 (beads, 3); the base bead is white."""
        if self.colours == "published":
            return bead_colours(beads)
        last = self.first if self.colours == "single" else self.last
        along = np.linspace(0.0, 1.0, beads)[:, None]
        blend = (1 - along) * np.array(self.first) + along * np.array(last)
        colours: NDArray[np.uint8] = np.rint(blend).astype(np.uint8)
        colours[0] = 255
        return colours


def appearance(points: Array, config: AppearanceConfig, rng: np.random.Generator) -> Appearance:
    """Sample an appearance for a configuration (beads, 3), metres."""
    # The order of the draws is part of every table: a new one belongs at the end.
    vary, plain = set(config.vary), Appearance()
    size = config.sizes[int(rng.integers(len(config.sizes)))]
    turn = float(rng.uniform(-math.pi, math.pi)) if "turn" in vary else 0.0
    width = float(rng.uniform(*config.width)) if "width" in vary else 1.0
    zoom, kind = 1.0, plain.colours
    if config.style == "knotbench":
        kind, zoom = "lines", _largest_zoom(points, turn, width)
        width *= line_look(size, zoom).width
    if "zoom" in vary:
        most = _largest_zoom(points, turn, width)
        low, high = config.zoom
        # a rope larger than the range allows for is shown as large as fits
        zoom = float(rng.uniform(min(low, most), min(high, most)))
    if "colours" in vary:
        kind = ("published", "single", "gradient")[int(rng.integers(3))]
    # dark, as every rope has a channel of 150 or more along all of it
    background = _rgb(rng.integers(0, 81, 3)) if "background" in vary else plain.background
    first, last = _rgb(rng.integers(150, 256, 3)), plain.last
    # a gradient ends dark but with one channel of 150 or more, so that it differs in hue from the
    # start and is brighter than any background (at most 80)
    if kind == "gradient":
        dark = rng.integers(20, 60, 3)
        dark[rng.integers(3)] = rng.integers(150, 200)
        last = _rgb(dark)
    noise = float(rng.uniform(0, config.noise)) if "noise" in vary else 0.0
    blur = float(rng.uniform(0, config.blur)) * size / plain.size if "blur" in vary else 0.0
    return Appearance(
        size=size,
        turn=turn,
        zoom=zoom,
        width=width,
        colours=kind,
        first=first if kind in ("single", "gradient") else plain.first,
        last=last,
        background=background,
        noise=noise,
        blur=blur,
        seed=int(rng.integers(2**62)) if noise else 0,
    )


def line_look(size: int, zoom: float = 1.0) -> Appearance:
    """Return the look of a line drawing, whose line is as wide at every zoom."""
    plain = PictureConfig(size=size, zoom=zoom)
    width = LINE * size / LINE_SIZE / (plain.rope_radius * plain.pixels_per_metre)
    return Appearance(size=size, zoom=zoom, width=width, colours="lines")


def render(points: Array, look: Appearance) -> NDArray[np.uint8]:
    """Draw a configuration (beads, 3): uint8 (size, size, 3), RGB."""
    if look.colours == "lines":
        image = draw_lines(points, look.picture())
    else:
        image = draw(points, look.picture(), colours=look.bead_colours(len(points)))
    # the lens before the sensor: noise isn't blurred
    if look.blur > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), look.blur), dtype=np.uint8)
    if look.noise > 0:
        grain = generator(Stream.IMAGE_GRAIN, look.seed).normal(0.0, look.noise, image.shape)
        image = np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)
    return image


def _largest_zoom(points: Array, turn: float, width: float) -> float:
    """Return the zoom at which the rope is MARGIN away from the picture's edge."""
    plain = PictureConfig(turn=turn, width=width)
    # in metres, from the middle to the rope's own edge
    outermost = np.abs(project(points, plain) - plain.size / 2).max() / plain.pixels_per_metre
    outermost += plain.drawn_radius
    return float((plain.size / 2 - MARGIN) / plain.pixels_per_metre / outermost)


def _rgb(levels: NDArray[np.integer]) -> RGB:
    red, green, blue = (int(level) for level in levels)
    return red, green, blue
