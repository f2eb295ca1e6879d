"""Appearances of pictures: one record each, from which help, settings, columns and cards follow.

A new appearance is a `Drawer` and a record in APPEARANCES. Nothing here draws, because the command
line reads it.
"""

import tomllib
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, Field, NonNegativeFloat, PositiveFloat

from knotgym.common import Distinct, InvalidInput, Share, choice, configuration

PUBLISHED = "published"
_SIZES = (64, 512)  # smallest and largest size of a picture of a table, pixels
TILT = 25.0  # largest tilt of a photo's camera, degrees


@dataclass(frozen=True, kw_only=True)
class AppearanceKind:
    """Everything in which one appearance differs from the others.

    Attributes:
        says: what a picture shows, for help and cards.
        drawer: "module:class" of its `Drawer`, imported when a picture is drawn.
        size: usual side of a picture of a table, pixels.
        vary: what `AppearanceConfig.vary` may name.
        marks: what every picture shows of the walk: "base", "direction", both or neither.
        obeys: whether pictures of environments can have views, depth, a perspective camera and
            MuJoCo's renderer.
        tilted: whether a tilted camera sees the ropes of a table; points are in its axes.
        columns: "package:file" of TOML files of the columns that its tables have beside the others,
            or that some have, in the notation of `knotgym/datasets/columns.toml`.
        grained: whether each pixel differs from the next, which PNG files are stored by.
    """

    says: str
    drawer: str
    size: int = 128
    vary: tuple[str, ...] = ()
    marks: tuple[str, ...] = ()
    obeys: bool = False
    tilted: bool = False
    columns: tuple[str, ...] = ()
    grained: bool = False

    @cached_property
    def own_columns(self) -> list[dict[str, Any]]:
        """The columns of each file: name -> type and doc."""
        places = [column.split(":") for column in self.columns]
        return [
            tomllib.loads((files(package) / file).read_text("utf-8")) for package, file in places
        ]


APPEARANCES: dict[str, AppearanceKind] = {
    PUBLISHED: AppearanceKind(
        says="a colour circle along the rope, on black",
        drawer="knotgym.rendering.variation:Drawer",
        vary=("colours", "width", "background", "turn", "zoom", "noise", "blur"),
        marks=("base", "direction"),
        obeys=True,
    ),
    "line": AppearanceKind(
        says="a black line on white, with gaps where a strand goes under, as diagrams are printed",
        drawer="knotgym.rendering.variation:LineDrawer",
        size=512,
        vary=("width", "turn", "noise", "blur"),
    ),
    "photo": AppearanceKind(
        says="rope of one colour on a table, as a camera sees it",
        drawer="knotgym.photos.photo:PhotoDrawer",
        tilted=True,
        columns=("knotgym.photos:photo_columns.toml", "knotgym.photos:phone_columns.toml"),
        grained=True,
    ),
}


def _appearance_help() -> str:
    """Return a sentence that names all appearances.

    >>> _appearance_help().partition("),")[0]
    'How it looks: published (a colour circle along the rope, on black'
    """
    each = ", ".join(f"{name} ({kind.says})" for name, kind in APPEARANCES.items())
    return f"How it looks: {each}."


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise InvalidInput("must have the smaller number first")
    return pair


_Range = Annotated[tuple[PositiveFloat, PositiveFloat], AfterValidator(_ordered)]
AppearanceName = Annotated[str, choice(growing=APPEARANCES, help=_appearance_help)]


_Few = Annotated[int, Field(ge=1, le=4)]
_Side = Annotated[int, Field(ge=_SIZES[0], le=_SIZES[1])]


@configuration
class AppearanceConfig:
    """Distribution of the appearances of a table; what doesn't vary is as in environments.

    Attributes:
        name: one of APPEARANCES.
        vary: What varies: all, none, or some of colours,width,background,turn,zoom,noise,blur.
        sizes: side in pixels, 64 to 512; from several (64,128) one is drawn at random; by default
            that of the appearance, 128 or for line 512.
        width: range of the factor on the rope's width.
        zoom: range of the magnification, limited so that the rope stays in the picture.
        noise: largest standard deviation of the Gaussian noise, levels of 255.
        blur: largest standard deviation of the Gaussian blur, pixels of a 128-pixel picture;
            scaled with the size.
        tilt: largest tilt of a photo's camera, degrees.
        marked: share of photos in which tape marks the base bead, white, and the bead before it,
            red.
        look: of photos: table (closed rope), or phone (what phones and laboratories take: open and
            several ropes, cropped, 3 to 30 pixels of 256 wide, crossing at 8 degrees or more).
        ropes: numbers of ropes of a photo of look phone: 2, 1,2 or 1-4; several are open.
        open: share of these photos of one rope in which it is open.
        cropped: share of them in which the picture's edge cuts the rope.
    """

    SIZES: ClassVar[tuple[int, int]] = _SIZES

    name: AppearanceName = PUBLISHED
    vary: tuple[str, ...] = ()
    sizes: Annotated[tuple[_Side, ...], Distinct] | None = None
    width: _Range = (0.7, 1.4)
    zoom: _Range = (0.8, 1.5)
    noise: NonNegativeFloat = 8.0
    blur: NonNegativeFloat = 0.6
    tilt: Annotated[float, Field(ge=0, le=TILT)] = TILT
    marked: Share = 0.2
    look: Annotated[str, choice("table", "phone")] = "table"
    ropes: Annotated[tuple[_Few, ...], Distinct] = (1,)
    open: Share = 0.5
    cropped: Share = 0.3

    def __post_init__(self) -> None:
        kind = APPEARANCES[self.name]
        vary = kind.vary if self.vary == ("all",) else () if self.vary == ("none",) else self.vary
        if fixed := [name for name in vary if name not in kind.vary]:
            known = f"choose from {', '.join(kind.vary)}, or all, or none"
            advice = known if kind.vary else "leave out what to vary"
            raise InvalidInput(f"appearance {self.name} can't vary {', '.join(fixed)}: {advice}")
        object.__setattr__(self, "vary", tuple(name for name in kind.vary if name in vary))

    def require_used(self) -> None:
        """Raise InvalidInput if a setting was changed that such pictures don't show."""
        kind, plain = APPEARANCES[self.name], AppearanceConfig(name=self.name)
        shown = {*self.vary, *("tilt", "marked") * kind.tilted}
        for name in ("tilt", "marked", "width", "zoom", "noise", "blur"):
            if name not in shown and getattr(self, name) != getattr(plain, name):
                advice = f"vary {name}, too" if name in kind.vary else "leave it out"
                raise InvalidInput(f"appearance {self.name} doesn't show {name}: {advice}")

    @property
    def sides(self) -> tuple[int, ...]:
        """The sizes, or the usual one of the appearance."""
        return self.sizes or (APPEARANCES[self.name].size,)
