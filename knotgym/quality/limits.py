"""The measures of a state's quality, their units, and what a curated state must have of them.

Every unit is one that a person can check with a ruler: pixels are those of the 128 x 128 picture,
5.2 mm each; the rope is two of them wide. `knotgym.quality.measures` takes the measures.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

# square pixels inside the axes of an eye that shows some background; where none is shown it says
# which way is better
FACE = 20.0

# scale of the reset noise, radians per joint and metres: the environment's default, and the noise
# that `Quality.noise_survival` is measured at
RESET_NOISE = 0.015


@dataclass(frozen=True)
class Quality:
    """The measures of one state.

    Where there is no crossing, those about crossings have the value of a perfect one.

    Attributes:
        crossing_angle: smallest angle at which two strands cross in the picture, degrees in [0,
            90].
        crossing_spacing: smallest distance between two crossings, pixels, at most the picture's
            side.
        base_spacing: from the white base bead along the rope to the nearest crossing, pixels, at
            most the picture's side.
        strand_spacing: smallest distance in the picture between the axes of two places more than
            `quality.WALK` pixels of walk apart.
        smallest_region: background of the smallest region that the drawn rope encloses, square
            pixels; 0 if the picture doesn't show the nx + 2 regions, the outside among them, that a
            diagram with nx crossings has.
        smallest_face: of the regions that the rope's axis encloses, had the rope no width, square
            pixels.
        margin: from the rope's edge to the edge of the picture, pixels; negative if the rope leaves
            it.
        clearance: smallest height of an over strand's axis above the under strand's, millimetres;
            two beads that touch have 10.
        excess_crossing_number: average crossing number over all directions of view minus the
            crossings seen from above: turns of the rope about itself that this picture doesn't
            show.
        total_curvature: total turning of the rope's direction, in full turns; a flat loop has 1.
        writhe: sum of the crossing signs.
        noise_survival: share of `quality.NOISE_DRAWS` draws of reset noise that keep the Gauss
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


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What an accepted state keeps to.

    Attributes:
        crossing_angle: at least; under 25 degrees the two strands share more than five pixels of
            their width.
        crossing_spacing: at least; three widths of the rope leave a rope's width of background
            between two crossings.
        base_spacing: at least; a crossing nearer to the base bead could be counted first or last.
        strand_spacing: at least; half again the rope's width, so that a dark pixel parts two
            strands.
        smallest_region: at least; a kink's eye three pixels wide is the least that a person finds
            without looking for it.
        margin: at least; the rope stays in the picture after reset noise, which moves no bead by
            more than three pixels as a rule.
        clearance: at least, millimetres; beads that are pressed into each other spring apart when
            the episode begins.
        excess_crossing_number: at most; a coil seen end-on hides about one crossing a turn, and two
            turns of it still read well.
        total_curvature: at most, turns, per crossing and one more for the loop itself.
        noise_survival: at least.
    """

    crossing_angle: float = 25.0
    crossing_spacing: float = 6.0
    base_spacing: float = 3.0
    strand_spacing: float = 3.0
    smallest_region: float = 9.0
    margin: float = 3.0
    clearance: float = 8.0
    excess_crossing_number: float = 2.5
    total_curvature: float = 2.0
    noise_survival: float = 0.95

    def faults(self, quality: Quality, nx: int) -> list[str]:
        """Names of the measures that miss their limit; an unmeasured noise_survival passes."""
        missed = []
        for limit in fields(self):
            value, bound = getattr(quality, limit.name), getattr(self, limit.name)
            if limit.name == "excess_crossing_number":
                short = value > bound
            elif limit.name == "total_curvature":
                short = value > bound * (nx + 1)
            else:
                short = value < bound
            if short:
                missed.append(limit.name)
        return missed

    def objective(self, quality: Quality, nx: int) -> float:
        """How far from comfortable, to be made small.

        Nothing for a measure twice as good as its limit, 1 for each one just at it, more beyond.
        """
        total = max(0.0, 2 - quality.smallest_face / FACE) ** 2
        for limit in fields(self):
            value, bound = getattr(quality, limit.name), getattr(self, limit.name)
            if value != value:
                continue
            if limit.name in ("excess_crossing_number", "total_curvature"):
                allowed = bound if limit.name == "excess_crossing_number" else bound * (nx + 1)
                total += max(0.0, 2 * value / allowed - 1)
            elif limit.name == "clearance":
                total += max(0.0, 1 - (value - bound)) if value < bound + 1 else 0.0
            else:
                total += max(0.0, 2 - value / bound) ** 2
        return total
