"""Which appearances pictures take; nothing here computes, because the command line reads them."""

from typing import Annotated

from pydantic import Field

from knotgym.common import (
    Distinct,
    Int,
    InvalidInput,
    NonNegative,
    Ordered,
    Positive,
    Real,
    Share,
    choice,
    configuration,
)

VARIED = ("colours", "width", "background", "turn", "zoom", "noise", "blur")
SIZES = (64, 512)  # smallest and largest size of a picture, pixels
LINE_SIZE = 512  # usual size of a line drawing, pixels
STYLES = ("published", "knotbench", "photo")
TILT = 25.0  # largest tilt of a photo's camera, degrees
PUBLISHED_SIZE = 128  # pixels


@configuration
class AppearanceConfig:
    """Distribution of appearances; everything that doesn't vary is as published.

    Attributes:
        style: published, or knotbench for black lines on white with gaps, without marks of base
            and direction. These fill the picture, are 512 pixels large unless other sizes are
            given, and have no colours or background to vary; or photo for rope of one colour on a
            table, which a tilted camera sees; all of its appearance varies.
        vary: what to randomize: all, none, or some of
            colours,width,background,turn,zoom,noise,blur.
        sizes: side in pixels, 64 to 512; from several (64,128) one is drawn at random.
        width: range of the factor on the rope's width.
        zoom: range of the magnification, limited so that the rope stays in the picture.
        noise: largest standard deviation of the Gaussian noise, levels of 255.
        blur: largest standard deviation of the Gaussian blur, pixels of a 128-pixel picture;
            scaled with the size.
        tilt: largest tilt of a photo's camera, degrees.
        marked: share of photos in which tape marks the base bead, white, and the bead before it,
            red.
    """

    style: Annotated[str, choice(*STYLES)] = "published"
    vary: tuple[str, ...] = ()
    sizes: Annotated[tuple[Annotated[Int, Field(ge=SIZES[0], le=SIZES[1])], ...], Distinct] = (128,)
    width: Annotated[tuple[Positive, Positive], Ordered] = (0.7, 1.4)
    zoom: Annotated[tuple[Positive, Positive], Ordered] = (0.8, 1.5)
    noise: NonNegative = 8.0
    blur: NonNegative = 0.6
    tilt: Annotated[Real, Field(ge=0, le=TILT)] = TILT
    marked: Share = 0.2

    def __post_init__(self) -> None:
        if self.style == "photo" and self.vary:
            raise InvalidInput("all of a photo varies; leave out what to vary")
        if self.style == "knotbench":
            if fixed := {"colours", "background", "zoom"} & set(self.vary):
                raise InvalidInput(
                    f"style knotbench is black on white and fills the picture, so it can't vary"
                    f" {', '.join(sorted(fixed))}; leave it out"
                )
            if self.sizes == (PUBLISHED_SIZE,):
                object.__setattr__(self, "sizes", (LINE_SIZE,))
        for name in self.vary:
            if name not in VARIED:
                raise InvalidInput(
                    f"{name!r} can't be varied; choose from {', '.join(VARIED)}, or all, or none"
                )
        object.__setattr__(self, "vary", tuple(name for name in VARIED if name in self.vary))
