"""Measures of a state's quality, their units, and limits.

Lengths are in pixels of the 128 x 128 picture, 5.2 mm each; the rope is two pixels wide.
`knotgym.quality.measures` computes the measures.
"""

from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from typing import Annotated, Any, ClassVar

from pydantic import Field

from knotgym.common import InvalidInput, Mark, configuration

# Difficulty of reading a picture, in four grades. A single crossing that can't be made out spoils
# the whole code, so the worst of five measures, in units of its limit, decides. The other limits
# (margin, clearance, twist, survival of noise) concern the rope rather than the reading.
_READING = "crossing_angle crossing_spacing base_spacing strand_spacing smallest_region".split()
_EASES = {"easy": 1.5, "medium": 1.0, "hard": 0.5, "extreme": 0.0}  # grade -> smallest ease
GRADES = (*_EASES,)


def _measure(unit: str, doc: str, default: Any = MISSING) -> Any:
    """Return a field of Quality; every field is a column of state files, named and described so."""
    return field(default=default, metadata={"unit": unit, "doc": doc})


@dataclass(frozen=True)
class Quality:
    """Quality measures of one state.

    Without crossings, the measures of crossings have the best possible value.

    Attributes:
        crossing_angle: smallest angle at which two strands cross in the picture, degrees in [0,
            90].
        crossing_spacing: smallest distance between two crossings, pixels, at most the picture's
            side.
        base_spacing: distance along the rope from the white base bead to the nearest crossing,
            pixels, at most the picture's side.
        strand_spacing: smallest distance in the picture between two points of the axis that are
            more than `measures.WALK` pixels apart along the drawing, pixels.
        smallest_region: background area of the smallest region enclosed by the drawn rope, square
            pixels; 0 if the picture doesn't show the nx + 2 regions, outside included, that a
            diagram with nx crossings has.
        smallest_face: area of the smallest region enclosed by the rope's axis, ignoring the rope's
            width, square pixels.
        margin: distance from the rope to the edge of the picture, pixels; negative if the rope
            leaves the picture.
        clearance: smallest height of an over strand's axis above the under strand's, millimetres;
            two beads that touch have 10.
        excess_crossing_number: average crossing number over all directions of view minus the
            crossings seen from above; it counts turns of the rope about itself that this picture
            hides.
        total_curvature: total turning of the rope's direction, full turns; a flat loop has 1.
        writhe: sum of the crossing signs.
        noise_survival: fraction of `measures.NOISE_DRAWS` draws of reset noise that keep the Gauss
            code; NaN until measured.
    """

    UNITS: ClassVar[dict[str, str]]  # of the measures by name
    # Scale of the reset noise, radians per joint and metres: the environment's default, and the
    # scale at which `noise_survival` is measured.
    RESET_NOISE: ClassVar[float] = 0.015

    crossing_angle: float = _measure("degrees", "smallest angle between two crossing strands")
    crossing_spacing: float = _measure("pixels", "smallest distance between two crossings")
    base_spacing: float = _measure(
        "pixels", "distance along the rope from the base bead to the nearest crossing"
    )
    strand_spacing: float = _measure("pixels", "smallest distance between different strands")
    smallest_region: float = _measure(
        "square pixels", "area of the smallest enclosed region of background"
    )
    smallest_face: float = _measure(
        "square pixels", "area of the smallest region that the rope's axis encloses"
    )
    margin: float = _measure("pixels", "distance from the rope's edge to the picture's edge")
    clearance: float = _measure(
        "millimetres", "smallest height of an over strand above its under strand"
    )
    excess_crossing_number: float = _measure(
        "crossings", "average crossing number minus the crossings in the picture"
    )
    total_curvature: float = _measure("turns", "total turning of the rope's direction")
    writhe: float = _measure("crossings", "sum of the crossing signs")
    noise_survival: float = _measure(
        "share", "share of 64 draws of reset noise that keep the code", float("nan")
    )

    def ease(self) -> float:
        """Return the least of the _READING measures, each divided by its limit; 1 is acceptable."""
        limits = Limits()
        return float(min(getattr(self, name) / getattr(limits, name) for name in _READING))


Quality.UNITS = {measure.name: str(measure.metadata["unit"]) for measure in fields(Quality)}
# types of limits: what a measure must be at least, and at most
AtLeast = Annotated[float, Mark("at least")]
AtMost = Annotated[float, Mark("at most")]


@configuration
class Limits:
    """Limits that a state must meet, in the units of `Quality`; None for no limit.

    Attributes:
        crossing_angle: minimum; below 25 degrees the two strands overlap over more than five
            pixels.
        crossing_spacing: minimum; three widths of the rope leave one width of background between
            two crossings.
        base_spacing: minimum; a crossing closer to the base bead could be counted first or last.
        strand_spacing: minimum; 1.5 widths of the rope, so that a dark pixel separates two
            strands.
        smallest_region: minimum; a kink's eye three pixels wide is the smallest that a person
            notices without searching.
        margin: minimum; reset noise usually moves no bead by more than three pixels, so the rope
            stays in the picture.
        clearance: minimum; beads that overlap deeply spring apart when the episode begins.
        excess_crossing_number: maximum; a coil seen end-on hides about one crossing per turn, and
            two turns are still readable.
        total_curvature: maximum.
        curvature_per_crossing: maximum of the total curvature, turns, for each crossing and once
            more for the loop itself.
        noise_survival: minimum.
    """

    UNTWISTED: ClassVar["Limits"]
    UNAMBIGUOUS: ClassVar["Limits"]

    crossing_angle: Annotated[AtLeast, Field(ge=0)] | None = 25.0
    crossing_spacing: Annotated[AtLeast, Field(ge=0)] | None = 6.0
    base_spacing: Annotated[AtLeast, Field(ge=0)] | None = 3.0
    strand_spacing: Annotated[AtLeast, Field(ge=0)] | None = 3.0
    smallest_region: Annotated[AtLeast, Field(ge=0)] | None = 9.0
    margin: AtLeast | None = 3.0
    clearance: Annotated[AtLeast, Field(ge=0)] | None = 8.0
    excess_crossing_number: Annotated[AtMost, Field(ge=0)] | None = 2.5
    total_curvature: Annotated[AtMost, Field(ge=0)] | None = None
    curvature_per_crossing: Annotated[AtMost, Field(ge=0)] | None = 2.0
    noise_survival: Annotated[AtLeast, Field(ge=0, le=1)] | None = 0.95

    def faults(self, quality: Quality, nx: int) -> list[str]:
        """Return the limits that a state with nx crossings misses; a measure of NaN passes."""
        measured = {**vars(quality), "curvature_per_crossing": quality.total_curvature / (nx + 1)}
        kind: Any = type(self)
        bounds = {name: bound for name, bound in vars(self).items() if bound is not None}
        return [
            name
            for name, bound in bounds.items()
            if (measured[name] > bound if _is_maximum(kind, name) else measured[name] < bound)
        ]

    @classmethod
    def only(cls, **bounds: float) -> "Limits":
        """Return these limits alone."""
        return cls(**{**dict.fromkeys(limit.name for limit in fields(cls)), **bounds})


# Over-twisted ropes are left out, and nothing else. Total curvature counts the turns of a coil that
# the picture shows, the excess crossing number those that it hides. A reset draws noise up to
# twenty times at full scale: at 0.25 all draws lose the code in only 3 of 1,000 resets.
Limits.UNTWISTED = Limits.only(excess_crossing_number=4.0, total_curvature=5.0, noise_survival=0.25)
# Nothing but the Gauss code is required to be certain. A quarter of a bead is 0.64 pixels and
# rounding errors are 1e-12 of that; axes less than 7 mm apart are those of ropes, 10 mm thick, that
# lie in each other, so a picture of their surfaces shows no order.
Limits.UNAMBIGUOUS = Limits.only(
    crossing_spacing=0.64, base_spacing=0.64, margin=0.0, clearance=7.0
)


def grade_of(ease: float) -> str:
    """Return the grade of an ease, one of GRADES."""
    return next((grade for grade, least in _EASES.items() if ease >= least), "extreme")


@cache
def _is_maximum(limits: Any, name: str) -> bool:
    """Whether a limit is the largest value of its measure, as its type says."""
    most, least = (
        {limit for limit, *_ in Mark.fields(limits, {}, word)} for word in ("at most", "at least")
    )
    if (name in most) == (name in least):
        raise InvalidInput(f"the type of {limits.__name__}.{name} must be AtLeast or AtMost")
    return name in most
