"""Measures of a state's quality, their units, and limits.

Lengths are in pixels of the 128 x 128 picture, 5.2 mm each; the rope is two pixels wide.
`knotgym.quality.measures` computes the measures.
"""

from dataclasses import dataclass, field, fields

from knotgym.common import NonNegative, Real, Share, configuration

# Scale of the reset noise, radians per joint and metres: the environment's default, and the scale
# at which `Quality.noise_survival` is measured.
RESET_NOISE = 0.015


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

    crossing_angle: float = field(metadata={"unit": "degrees"})
    crossing_spacing: float = field(metadata={"unit": "pixels"})
    base_spacing: float = field(metadata={"unit": "pixels"})
    strand_spacing: float = field(metadata={"unit": "pixels"})
    smallest_region: float = field(metadata={"unit": "square pixels"})
    smallest_face: float = field(metadata={"unit": "square pixels"})
    margin: float = field(metadata={"unit": "pixels"})
    clearance: float = field(metadata={"unit": "millimetres"})
    excess_crossing_number: float = field(metadata={"unit": "crossings"})
    total_curvature: float = field(metadata={"unit": "turns"})
    writhe: float = field(metadata={"unit": "crossings"})
    noise_survival: float = field(default=float("nan"), metadata={"unit": "share"})


UNITS = {measure.name: str(measure.metadata["unit"]) for measure in fields(Quality)}
# Limits that are upper bounds of their measure
_MAXIMA = ("excess_crossing_number", "total_curvature", "curvature_per_crossing")


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

    crossing_angle: NonNegative | None = 25.0
    crossing_spacing: NonNegative | None = 6.0
    base_spacing: NonNegative | None = 3.0
    strand_spacing: NonNegative | None = 3.0
    smallest_region: NonNegative | None = 9.0
    margin: Real | None = 3.0
    clearance: NonNegative | None = 8.0
    excess_crossing_number: NonNegative | None = 2.5
    total_curvature: NonNegative | None = None
    curvature_per_crossing: NonNegative | None = 2.0
    noise_survival: Share | None = 0.95

    def faults(self, quality: Quality, nx: int) -> list[str]:
        """Return the limits that a state with nx crossings misses; a measure of NaN passes."""
        missed = []
        for limit in fields(self):
            name, bound = limit.name, getattr(self, limit.name)
            if bound is None:
                continue
            if name == "curvature_per_crossing":
                value = quality.total_curvature / (nx + 1)
            else:
                value = getattr(quality, name)
            if value > bound if name in _MAXIMA else value < bound:
                missed.append(name)
        return missed


_NO_LIMITS: dict[str, None] = dict.fromkeys(limit.name for limit in fields(Limits))
LEGIBLE = Limits()
# Over-twisted ropes are left out, and nothing else. Total curvature counts the turns of a coil that
# the picture shows, the excess crossing number those that it hides. A reset draws noise up to
# twenty times at full scale: at 0.25 all draws lose the code in only 3 of 1,000 resets.
UNTWISTED = Limits(
    **{
        **_NO_LIMITS,
        "excess_crossing_number": 4.0,
        "total_curvature": 5.0,
        "noise_survival": 0.25,
    }
)
# Nothing but the Gauss code is required to be certain. A quarter of a bead is 0.64 pixels and
# rounding errors are 1e-12 of that; axes less than 7 mm apart are those of ropes, 10 mm thick, that
# lie in each other, so a picture of their surfaces shows no order.
UNAMBIGUOUS = Limits(
    **{
        **_NO_LIMITS,
        "crossing_spacing": 0.64,
        "base_spacing": 0.64,
        "margin": 0.0,
        "clearance": 7.0,
    }
)
