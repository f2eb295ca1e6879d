"""What a picture's configuration keeps to, lest its label be in doubt or its picture untrue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knotgym.common.configuration import check_numbers
from knotgym.topology.crossings import Crossings, visit_spacing


@dataclass(frozen=True, kw_only=True)
class LabelLimits:
    """How far a configuration stays from one with another label.

    Attributes:
        visits: beads along the rope between two visits; 0.25 are 3 mm, and rounding moves visits by
            1e-12 of that.
        base: beads from either end of the white base bead to the nearest visit outside it.
        clearance: millimetres between the axes at a crossing, from which the order of painting is
            true (see `rendering.rasterizer`).
    """

    visits: float = 0.25
    base: float = 0.25
    clearance: float = 7.0

    def __post_init__(self) -> None:
        check_numbers(self, non_negative=("visits", "base", "clearance"))


LABEL_LIMITS = LabelLimits()


def visits_too_close(crossings: Crossings, beads: int, limits: LabelLimits = LABEL_LIMITS) -> bool:
    """Whether two visits lie so close that either could be the first."""
    return visit_spacing(crossings, beads) < limits.visits


def at_base(crossings: Crossings, beads: int, limits: LabelLimits = LABEL_LIMITS) -> bool:
    """Whether a crossing lies so near the white bead that it could be counted first or last."""
    places = np.concatenate([crossings.over_place, crossings.under_place])
    return bool(((places < 1 + limits.base) | (places > beads - limits.base)).any())


def pressed_together(clearance: float, limits: LabelLimits = LABEL_LIMITS) -> bool:
    """Whether strands that cross are so near, millimetres, that either could be painted on top."""
    return clearance < limits.clearance
