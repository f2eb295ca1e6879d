"""Varied appearance of perception pictures: colours, width, background, camera, noise, blur, size.

None of these changes the Gauss code. A turn or a zoom moves the crossings' pixels, which are
recomputed. Under colours "published" and "gradient" the picture shows the direction in which the
code is read: towards red, or from the bright end to the dark one. Under "single" only the white
base bead is marked, so the code and the code of the reversed rope fit the picture equally well.

Style "knotbench" draws the diagram as a line with gaps, as printed ones and those of KnotBench
(arXiv 2605.09900) are. It marks neither base nor direction, so a PD code fits the picture from any
base point and in both directions.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from knotgym.common.configuration import (
    Distinct,
    Int,
    NonNegative,
    Ordered,
    Positive,
    choice,
    configuration,
)
from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream, generator
from knotgym.rendering.diagram import draw_lines
from knotgym.rendering.picture import RGB, PictureConfig, draw, project, rope_colours

Array = NDArray[np.float64]

VARIED = ("colours", "width", "background", "turn", "zoom", "noise", "blur")
SIZES = (64, 512)  # smallest and largest size of a picture, pixels
LINE_SIZE = 512  # usual size of a line drawing, pixels
LINE = 2.0  # half the width of its line, pixels of a picture of this size
STYLES = ("published", "knotbench")
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
            return rope_colours(beads)
        last = self.first if self.colours == "single" else self.last
        along = np.linspace(0.0, 1.0, beads)[:, None]
        blend = (1 - along) * np.array(self.first) + along * np.array(last)
        colours: NDArray[np.uint8] = np.rint(blend).astype(np.uint8)
        colours[0] = 255
        return colours


@configuration
class AppearanceConfig:
    """Distribution of appearances; everything that doesn't vary is as published.

    Attributes:
        style: published, or knotbench for black lines on white with gaps, without marks of base
            and direction. These fill the picture, are 512 pixels large unless other sizes are
            given, and have no colours or background to vary.
        vary: what to randomize: all, none, or some of
            colours,width,background,turn,zoom,noise,blur.
        sizes: side in pixels, 64 to 512; from several (64,128) one is drawn at random.
        width: range of the factor on the rope's width.
        zoom: range of the magnification, limited so that the rope stays in the picture.
        noise: largest standard deviation of the Gaussian noise, levels of 255.
        blur: largest standard deviation of the Gaussian blur, pixels of a 128-pixel picture;
            scaled with the size.
    """

    style: Annotated[str, choice(*STYLES)] = "published"
    vary: tuple[str, ...] = ()
    sizes: Annotated[tuple[Annotated[Int, Field(ge=SIZES[0], le=SIZES[1])], ...], Distinct] = (128,)
    width: Annotated[tuple[Positive, Positive], Ordered] = (0.7, 1.4)
    zoom: Annotated[tuple[Positive, Positive], Ordered] = (0.8, 1.5)
    noise: NonNegative = 8.0
    blur: NonNegative = 0.6

    def __post_init__(self) -> None:
        if self.style == "knotbench":
            if fixed := {"colours", "background", "zoom"} & set(self.vary):
                raise InvalidInput(
                    f"style knotbench is black on white and fills the picture, so it can't vary"
                    f" {', '.join(sorted(fixed))}; leave it out"
                )
            if self.sizes == (Appearance.size,):
                object.__setattr__(self, "sizes", (LINE_SIZE,))
        for name in self.vary:
            if name not in VARIED:
                raise InvalidInput(
                    f"{name!r} can't be varied; choose from {', '.join(VARIED)}, or all, or none"
                )
        object.__setattr__(self, "vary", tuple(name for name in VARIED if name in self.vary))


def appearance(points: Array, config: AppearanceConfig, rng: np.random.Generator) -> Appearance:
    """Sample an appearance for a configuration (beads, 3), metres."""
    vary, plain = set(config.vary), Appearance()
    size = config.sizes[int(rng.integers(len(config.sizes)))]
    turn = float(rng.uniform(-math.pi, math.pi)) if "turn" in vary else 0.0
    width = float(rng.uniform(*config.width)) if "width" in vary else 1.0
    zoom, kind = 1.0, plain.colours
    if config.style == "knotbench":
        kind, zoom = "lines", _largest_zoom(points, turn, width)
        # the line is as wide at every zoom
        own = PictureConfig(size=size, zoom=zoom)
        width *= LINE * size / LINE_SIZE / (own.rope_radius * own.pixels_per_metre)
    if "zoom" in vary:
        most = _largest_zoom(points, turn, width)
        low, high = config.zoom
        zoom = float(rng.uniform(min(low, most), min(high, most)))
    if "colours" in vary:
        kind = ("published", "single", "gradient")[int(rng.integers(3))]
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


def render(points: Array, look: Appearance) -> NDArray[np.uint8]:
    """Draw a configuration (beads, 3): uint8 (size, size, 3), RGB."""
    if look.colours == "lines":
        image = draw_lines(points, look.picture())
    else:
        image = draw(points, look.picture(), colours=look.bead_colours(len(points)))
    if look.blur > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), look.blur), dtype=np.uint8)
    if look.noise > 0:
        grain = generator(Stream.IMAGE_GRAIN, look.seed).normal(0.0, look.noise, image.shape)
        image = np.clip(np.rint(image + grain), 0, 255).astype(np.uint8)
    return image


def _largest_zoom(points: Array, turn: float, width: float) -> float:
    """Return the zoom at which the rope is MARGIN away from the picture's edge."""
    plain = PictureConfig(turn=turn, width=width)
    outermost = np.abs(project(points, plain) - plain.size / 2).max() / plain.pixels_per_metre
    outermost += plain.drawn_radius
    return float((plain.size / 2 - MARGIN) / plain.pixels_per_metre / outermost)


def _rgb(levels: NDArray[np.integer]) -> RGB:
    red, green, blue = (int(level) for level in levels)
    return red, green, blue
