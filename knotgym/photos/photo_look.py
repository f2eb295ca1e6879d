"""What a photo looks like: rope, surface, things on it, light; drawn from a generator.

After a change run `pytest tests/photos/test_photo.py`: a photo must be taken again from its
points and appearance to the byte.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from knotgym.common import Array
from knotgym.rendering import Appearance, PictureConfig, levels_of

Rng = np.random.Generator
RGB = tuple[int, int, int]
DEFAULT = PictureConfig()
SURFACES = ("cloth", "wood", "gradient", "noise")
# fields of `Photo` that tables of free looks alone have
PHONE = ("look", "cuts", "squeeze", "weave", "whipping", "mixed", "corners")
WEAVES = ("plain", "laid", "braid", "flat")  # textures of ropes, as `photo_kernels` numbers them
_DYES = (4, 14, 30, 48, 130, 205, 222, 280, 335)  # hues of dyed ropes, degrees


# ranges, in the order of the draws
_GRAINS = {"cloth": (2.5, 6.0), "wood": (5.0, 14.0), "gradient": (256, 256), "noise": (8, 60)}
_EVENLY = {
    "pitch": (2.4, 4.5), "gloss": (0, 0.35), "light_turn": (0, 360), "light_height": (35, 75),
    "ambient": (0.35, 0.65), "shadow": (0.6, 0.9), "falloff": (0, 0.35), "warmth": (-0.12, 0.18),
    "exposure": (0.8, 1.15), "blur": (0, 0.9), "noise": (0, 8),
}  # fmt: skip


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
class Look:
    """What one look of photos draws; lengths are pixels of 256.

    Attributes:
        says: what it shows, for help.
        limits: what its pictures must show.
        widths: of the rope; those of a `free` look are drawn evenly in their logarithms.
        fill: share of the picture's side that the rope fills; beyond 1 the picture cuts it.
        kinds: what lies on the table beside the rope: a surface alone, clutter, or other ropes.
        dim: darkest first colour of a surface.
        occluded: share of photos in which things lie on the rope.
        evenly: ranges of other fields of `Photo`, in the order of the draws.
        free: whether ropes may be cut, of any weave, whipped, and of different colours.
    """

    says: str
    limits: Legibility = LIMITS
    widths: tuple[float, float] = (3.0, 12.0)
    fill: tuple[float, float] = (0.7, 1.0)
    kinds: tuple[str, ...] = (*SURFACES, "clutter", "ropes")
    dim: float = 0.15
    occluded: float = 0.25
    evenly: Mapping[str, tuple[float, float]] = field(default_factory=lambda: _EVENLY)
    free: bool = False


_ANY = {"falloff": (0, 0.9), "corners": (0, 0.35), "blur": (0, 0.4), "noise": (0, 1.6)}
LOOKS = {
    "table": Look(says="closed rope on a table"),
    "phone": Look(
        says="rope as phones and laboratories take it: cut, cropped, wide, crossing at flat angles",
        limits=LIMITS._replace(angle=8.0, region=8.0, contrast=14.0, order=8.0),
        widths=(3.0, 30.0),
        fill=(0.6, 1.0),
        kinds=("gradient", "noise", *SURFACES, "clutter"),  # most real tables are plain
        dim=0.03,
        occluded=0.0,
        evenly=_EVENLY | _ANY,
        free=True,
    ),
}


@dataclass(frozen=True, kw_only=True)
class Photo(Appearance):
    """Appearance of a photo; with the points it determines every byte.

    `first` and `last` are the colours of the two strands of the rope, `background` is one of the
    two of the surface. Angles are in degrees, px256 are pixels of a 256-pixel picture.

    Attributes:
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
        look: one of LOOKS.
        cuts: where each missing piece of the rope begins and ends, shares of its vertices.
        squeeze: factor on the rope's extent across the camera's picture, before its turn.
        weave: "braid", "flat", or "" for what `twisted` says.
        whipping: length of other colour at each end, widths of the rope.
        mixed: whether ropes have different colours.
        corners: light that the picture loses towards its corners, a share.
    """

    name: str = "photo"
    colours: str = "single"
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
    look: str = "table"
    cuts: tuple[float, ...] = ()
    squeeze: float = 1.0
    weave: str = ""
    whipping: float = 0.0
    mixed: bool = False
    corners: float = 0.0

    @property
    def free(self) -> bool:
        """Whether its look is free, see `Look`."""
        return LOOKS[self.look].free

    @property
    def scale(self) -> float:
        """Pixels per metre."""
        return self.zoom * self.size / DEFAULT.view

    @property
    def radius(self) -> float:
        """Radius of the rope, px."""
        return DEFAULT.rope_radius * self.width * self.scale

    @property
    def light(self) -> Array:
        """Direction towards the light, (3,); y points down."""
        turn, height = math.radians(self.light_turn), math.radians(self.light_height)
        flat = math.cos(height)
        return np.array([flat * math.cos(turn), flat * math.sin(turn), math.sin(height)])


def drawn_look(look: Photo, rng: Rng) -> Photo:
    """Draw everything but the frame and the rope's colours."""
    # The order of the draws is part of every photo: a new one belongs at the end.
    ranges = LOOKS[look.look]
    kind = ranges.kinds[rng.integers(len(ranges.kinds))]
    surface = kind if kind in SURFACES else SURFACES[rng.integers(len(SURFACES))]
    if surface == "wood":
        first = _hsv(rng.uniform(18, 36), rng.uniform(0.3, 0.65), rng.uniform(0.3, 0.9))
        # grain of the same hue, darker
        last = first * rng.uniform(0.55, 0.8)
    else:
        # the power makes pale surfaces more frequent than coloured ones
        first = _hsv(rng.uniform(0, 360), 0.65 * rng.random() ** 1.6, rng.uniform(ranges.dim, 0.95))
        last = first * rng.uniform(0.5, 0.92)
    look = replace(look, background=levels_of(first), ground=levels_of(last), surface=surface)
    drawn: dict[str, Any] = {"grain": rng.uniform(*_GRAINS[surface])}
    drawn["grain_turn"] = rng.uniform(0, 360)
    # the upper end is excluded: 2 to 8 things, 1 to 4 ropes
    drawn["clutter"] = rng.integers(2, 9) if kind == "clutter" else 0
    drawn["others"] = rng.integers(1, 5) if kind == "ropes" else 0
    drawn["occluders"] = rng.integers(1, 3) if rng.random() < ranges.occluded else 0
    drawn["twisted"] = rng.random() < 0.5
    drawn |= {name: rng.uniform(*ends) for name, ends in ranges.evenly.items()}
    drawn["blur"] *= look.size / 256
    drawn |= {"jpeg": rng.integers(45, 101), "seed": rng.integers(2**62)}
    if ranges.free:
        drawn["weave"] = ("", "", "braid", "flat")[rng.integers(4)]
        drawn["twisted"] &= not drawn["weave"]
        drawn["whipping"] = rng.uniform(0.7, 3) * (rng.random() < 0.4)
        drawn["mixed"] = rng.random() < 0.6
    plain = {name: type(getattr(look, name))(value) for name, value in drawn.items()}
    return replace(look, **plain)


def drawn_dyes(rng: Rng, count: int) -> Array:
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
    # Per channel V - V S max(0, min(k, 4 - k, 1)), k = (n + hue / 60) mod 6, n = 5, 3, 1 for R, G,
    # B.
    part = (hue / 60.0 + np.array([5.0, 3.0, 1.0])) % 6.0
    return 255 * value * (1 - saturation * np.clip(np.minimum(part, 4 - part), 0, 1))
